"""``optical-palpation thickness``: from an OCT volume to a map of the layer's thickness."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from optical_palpation.cli.options import Quiet, Untrusted, print_files
from optical_palpation.cli.progress import ProgressDisplay


class Scale(StrEnum):
    """What the samples of a volume are."""

    LINEAR = "linear"
    AMPLITUDE = "amplitude"
    INTENSITY = "intensity"
    DB = "dB"


class Edge(StrEnum):
    """How the sample side of the layer shows."""

    RISE = "rise"
    LINE = "line"
    FALL = "fall"


class Method(StrEnum):
    """How boundaries are found."""

    SURFACE = "surface"
    CANNY = "canny"


def thickness(
    volume: Annotated[
        Path,
        typer.Argument(
            metavar="VOLUME",
            help="OCT volume: .oct, .tif, a folder of images, .mat, .h5, .npy, .npz, raw...",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="Thickness map, NetCDF (.nc).")
    ],
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also draw maps and B-scans (.png, .pdf).")
    ] = None,
    variable: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Name of the array, where a file holds several."),
    ] = None,
    axes: Annotated[
        str | None,
        typer.Option(metavar="AXES", help="Order of the axes, slowest first, such as yzx."),
    ] = None,
    spacing: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="Z Y X", help="Distance between samples, mm."),
    ] = None,
    scale: Annotated[Scale | None, typer.Option(help="What the samples are.")] = None,
    refractive_index: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER", help="Divides the axial spacing, where it is an optical path."
        ),
    ] = None,
    window: Annotated[
        str,
        typer.Option(metavar="line|fall|rise|MM", help="How the window side shows, or its depth."),
    ] = "line",
    sample: Annotated[Edge, typer.Option(help="How the sample side shows.")] = Edge.RISE,
    window_range: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="FROM TO", help="Depths between which the window is, mm."),
    ] = None,
    sample_range: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="FROM TO", help="Depths between which the sample is, mm."),
    ] = None,
    corrections: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Text file of anchor points and excluded regions."),
    ] = None,
    method: Annotated[Method, typer.Option(help="How boundaries are found.")] = Method.SURFACE,
    untrusted: Untrusted = False,
    quiet: Quiet = False,
) -> None:
    """Find the layer in an OCT volume and write its thickness, quality and boundaries."""
    from optical_palpation import present
    from optical_palpation.study import Progress, find_boundaries
    from optical_palpation.thickness import write_thickness_map
    from optical_palpation.volume import open_volume

    outputs = {"result": output, "picture": plot}
    wanted = {kind: path for kind, path in outputs.items() if path is not None}
    present.check_outputs(wanted, [volume, *([corrections] if corrections else [])])
    look: dict[str, Any] = {"window": _number(window), "sample": sample.value}
    look |= {"window_range": window_range, "sample_range": sample_range, "method": method.value}
    with (
        open_volume(
            volume,
            variable=variable,
            axes=axes,
            spacing=None if spacing is None else dict(zip("zyx", spacing, strict=True)),
            scale=scale,
            refractive_index=refractive_index,
            untrusted=untrusted,
        ) as opened,
        ProgressDisplay(quiet) as progress,
    ):
        found = find_boundaries(
            opened,
            look,
            corrections,
            lambda share: progress(Progress("boundaries", share)),
        )
        write_thickness_map(found, output)
        if plot is not None:
            present.write_boundaries_figure(found, opened, plot)
    if (filled := float(found.attrs["filled_share"])) > 0.5:
        typer.echo(
            f"warning: the layer is seen in {present.percent(1.0 - filled)} of the pixels only; "
            "look at the picture (--plot), and check axes, spacing and how the boundaries look",
            err=True,
        )
    for doubt in json.loads(found.attrs["doubts"]):
        typer.echo(f"warning: {doubt}", err=True)
    if quiet:
        return
    measured = found["thickness"].values[~found["filled"].values]
    print(
        f"thickness: {measured.min():.4g} to {measured.max():.4g} mm, mean {measured.mean():.4g} mm"
        f"\ninterpolated pixels: {present.percent(found.attrs['filled_share'])}"
        f"\nmedian quality: {float(found['quality'].median()):.2f}"
    )
    print_files(wanted)


def _number(window: str) -> str | float:
    try:
        return float(window)
    except ValueError:
        return window.lower()
