"""``optical-palpation friction``: the coefficient at the window from a displacement profile."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optical_palpation.cli.law import (
    C01_HELP,
    C10_HELP,
    C20_HELP,
    C30_HELP,
    LAW_HELP,
    ComputedLaw,
)
from optical_palpation.cli.options import Quiet, Threads, each_on, print_files

_LAYER, _VOLUMES, _OUTPUT = "Layer and calibration", "Volumes", "Output"

if TYPE_CHECKING:
    import xarray as xr

    from optical_palpation.friction import FrictionEstimate


#: What curves that were saved were computed with.
_OF_CURVES = (
    *("coefficients", "layer_size", "initial_thickness", "law", "c10", "c01", "c20", "c30"),
    *("bulk_to_shear", "sample_friction", "step", "elements", "workers", "scheduler"),
)


def friction(
    context: typer.Context,
    measurement: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="PROFILE | BEFORE AFTER",
            help="A displacement profile (.csv), or complex OCT volumes before and after the "
            "step; nothing for the calibration curves alone.",
            show_default=False,
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Calibration curves that were saved (.nc), instead of new ones.",
            rich_help_panel=_LAYER,
        ),
    ] = None,
    coefficients: Annotated[
        str,
        typer.Option(
            metavar="NUMBERS",
            help="Coefficients of the calibration curves.",
            rich_help_panel=_LAYER,
        ),
    ] = "0.02,0.1,0.2,0.3,0.4",
    layer_size: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="X Y", help="Whole unloaded layer, mm.", rich_help_panel=_LAYER),
    ] = None,
    initial_thickness: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER", help="Thickness of the unloaded layer, mm.", rich_help_panel=_LAYER
        ),
    ] = None,
    loaded_thickness: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="Thickness under the preload, mm; of volumes, that between the faces.",
            rich_help_panel=_LAYER,
        ),
    ] = None,
    law: Annotated[
        ComputedLaw, typer.Option(help=LAW_HELP, rich_help_panel=_LAYER)
    ] = ComputedLaw.MOONEY_RIVLIN,
    c10: Annotated[
        float | None, typer.Option(metavar="NUMBER", help=C10_HELP, rich_help_panel=_LAYER)
    ] = None,
    c01: Annotated[
        float | None, typer.Option(metavar="NUMBER", help=C01_HELP, rich_help_panel=_LAYER)
    ] = None,
    c20: Annotated[
        float | None, typer.Option(metavar="NUMBER", help=C20_HELP, rich_help_panel=_LAYER)
    ] = None,
    c30: Annotated[
        float | None, typer.Option(metavar="NUMBER", help=C30_HELP, rich_help_panel=_LAYER)
    ] = None,
    bulk_to_shear: Annotated[
        float,
        typer.Option(metavar="NUMBER", help="Bulk over shear modulus.", rich_help_panel=_LAYER),
    ] = 1e4,
    sample_friction: Annotated[
        float,
        typer.Option(
            metavar="NUMBER",
            help="Friction coefficient between layer and sample.",
            rich_help_panel=_LAYER,
        ),
    ] = 0.1,
    region: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="Width of the square about the layer's centre over which the measurement is "
            "averaged, mm; of volumes, all that they hold.",
            rich_help_panel=_LAYER,
        ),
    ] = None,
    step: Annotated[
        float,
        typer.Option(metavar="NUMBER", help="Additional compression, mm.", rich_help_panel=_LAYER),
    ] = 5e-4,
    elements: Annotated[
        int,
        typer.Option(
            metavar="NUMBER", help="Elements through the depth.", min=2, rich_help_panel=_LAYER
        ),
    ] = 6,
    depth_in_mm: Annotated[
        bool,
        typer.Option(
            "--depth-in-mm",
            help="Depths of the profile are mm; without a unit they are so wherever "
            "--loaded-thickness is given.",
        ),
    ] = False,
    fit_offset: Annotated[
        bool, typer.Option("--fit-offset", help="The displacement at the window is unknown too.")
    ] = False,
    window_depth: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="Depth of the layer's face at the window, mm.",
            rich_help_panel=_VOLUMES,
        ),
    ] = None,
    sample_depth: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="Depth of the layer's face at the sample, mm.",
            rich_help_panel=_VOLUMES,
        ),
    ] = None,
    margin: Annotated[
        float,
        typer.Option(
            metavar="NUMBER",
            help="Depth next to both faces that is left out, mm.",
            rich_help_panel=_VOLUMES,
        ),
    ] = 0.01,
    wavelength: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER", help="Central wavelength in vacuum, mm.", rich_help_panel=_VOLUMES
        ),
    ] = None,
    refractive_index: Annotated[
        float | None, typer.Option(metavar="NUMBER", help="Of the layer.", rich_help_panel=_VOLUMES)
    ] = None,
    optical_depth: Annotated[
        bool,
        typer.Option(
            "--optical-depth",
            help="The volumes' axial spacing is an optical path.",
            rich_help_panel=_VOLUMES,
        ),
    ] = False,
    own_reference: Annotated[
        bool,
        typer.Option(
            "--own-reference",
            help="The window is not the interferometer's reference: phases are taken relative to "
            "its reflection.",
            rich_help_panel=_VOLUMES,
        ),
    ] = False,
    axes: Annotated[
        str | None,
        typer.Option(
            metavar="AXES",
            help="Order of the volumes' axes, slowest first, such as yzx.",
            rich_help_panel=_VOLUMES,
        ),
    ] = None,
    spacing: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="Z Y X",
            help="Distance between samples of the volumes, mm.",
            rich_help_panel=_VOLUMES,
        ),
    ] = None,
    variable: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Array of the volumes, where a file has several.",
            rich_help_panel=_VOLUMES,
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Also write the estimate (.json).",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also draw curves and profile (.png, .pdf).",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    save_calibration: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Also write the calibration curves (.nc).", rich_help_panel=_OUTPUT
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="NUMBER",
            help="Compute curves side by side on so many workers of this machine (extra batch).",
            min=1,
            rich_help_panel=_LAYER,
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Compute curves on the workers of a running Dask scheduler.",
            rich_help_panel=_LAYER,
        ),
    ] = None,
    threads: Threads = None,
    quiet: Quiet = False,
) -> None:
    """Estimate the friction at the window from the displacement under a small step.

    The layer was pressed flat, then by less than a micrometre more; friction bends the profile of
    displacement against depth. Calibration curves for the same layer tell the coefficient.
    """
    files = measurement or []
    each = each_on(workers, scheduler) or map
    if len(files) > 2:
        raise typer.BadParameter("give one profile, or two volumes (before and after)")
    outputs = {"record": output, "picture": plot, "calibration": save_calibration}
    wanted = {kind: path for kind, path in outputs.items() if path is not None}
    if not files and (output or not wanted):
        raise typer.BadParameter(
            "without a measurement there are only calibration curves: --plot or --save-calibration"
        )
    layer = {"--layer-size": layer_size, "--initial-thickness": initial_thickness, "--c10": c10}
    typed = [name for name in _OF_CURVES if _is_typed(context, name)]
    if calibration and typed:
        said = ", ".join(f"--{name.replace('_', '-')}" for name in typed)
        raise typer.BadParameter(f"--calibration already tells {said}")
    needed: dict[str, object] = {} if calibration else {**layer}
    if len(files) == 2:
        needed |= {"--window-depth": window_depth, "--sample-depth": sample_depth}
        needed |= {"--wavelength": wavelength, "--refractive-index": refractive_index}
    elif not calibration:
        needed |= {"--loaded-thickness": loaded_thickness, "--region": region}
    if depth_in_mm:
        needed["--loaded-thickness"] = loaded_thickness
    if absent := [name for name, value in needed.items() if value is None]:
        raise typer.BadParameter(f"also needed: {', '.join(absent)}")

    from optical_palpation import friction as library
    from optical_palpation import present
    from optical_palpation.material import make_law
    from optical_palpation.palpation.threads import limited_threads
    from optical_palpation.present.friction_figure import write_friction_figure
    from optical_palpation.present.record import write_friction

    present.check_outputs(wanted, [*files, calibration] if calibration else files)
    profile = None
    if len(files) == 1:
        made_for = None
        if calibration:
            made_for = library.read_calibration(calibration).attrs.get("loaded_thickness_mm")
        profile = library.read_profile(files[0], loaded_thickness, calibrated=made_for)
    elif files:
        before, after, spacing_z, region = library.read_pair(
            files[0],
            files[1],
            region,
            axes=axes,
            spacing=dict(zip("zyx", spacing, strict=True)) if spacing else None,
            variable=variable,
            refractive_index=refractive_index if optical_depth else None,
        )
        assert window_depth is not None  # refused above, as are the others
        assert sample_depth is not None
        assert wavelength is not None
        assert refractive_index is not None
        profile = library.displacement_profile(
            before,
            after,
            spacing=spacing_z,
            wavelength=wavelength,
            refractive_index=refractive_index,
            window_depth=window_depth,
            sample_depth=sample_depth,
            margin=margin,
            common_path=not own_reference,
        )
        if loaded_thickness is None:
            loaded_thickness = sample_depth - window_depth

    if calibration:
        curves = library.read_calibration(
            calibration, loaded_thickness=loaded_thickness, region=region
        )
    else:
        assert layer_size is not None
        assert initial_thickness is not None
        assert loaded_thickness is not None
        assert c10 is not None
        assert region is not None
        values = _numbers(coefficients)
        started = time.monotonic()

        def say(text: str) -> None:
            if not quiet:
                passed = time.monotonic() - started
                print(f"calibration: {text}, {passed:.0f} s", file=sys.stderr, flush=True)

        say(f"{len(values)} curves; the first run compiles for up to a minute")
        with limited_threads(threads):
            curves = library.calibration_curves(
                values,
                layer_size=layer_size,
                initial_thickness=initial_thickness,
                loaded_thickness=loaded_thickness,
                material=make_law(law.value, bulk_to_shear, c10=c10, c01=c01, c20=c20, c30=c30),
                region=region,
                sample_friction=sample_friction,
                step=step,
                elements=elements,
                on_curve=lambda mu: say(f"friction {mu:g} done"),
                each=each,
            )
    estimate, doubts = None, []
    if profile is not None:
        estimate = library.estimate_friction(profile, curves, fit_offset=fit_offset)
        doubts = library.doubts_about(estimate, curves)
    if save_calibration:
        library.write_calibration(curves, save_calibration)
    if plot:
        write_friction_figure(curves, plot, estimate)
    if output and estimate:
        named = [path.name for path in files]
        write_friction(estimate, output, measurement=named, doubts=doubts, **curves.attrs)
    if quiet:
        return
    if estimate:
        print(_describe(estimate, curves))
        for doubt in doubts:
            print(f"WARNING: {doubt}")
    print_files(wanted)


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise typer.BadParameter(
            f"--coefficients takes numbers with commas between, such as 0.1,0.2; found {text!r}"
        ) from None


def _describe(estimate: FrictionEstimate, curves: xr.DataArray) -> str:
    low, high = estimate.interval
    lines = [
        f"friction at the window: {estimate.coefficient:.3f} (95 %: {low:.3f} to {high:.3f})",
        f"profile and fitted curve differ by {estimate.residual:.2%} of the step (rms)",
        f"step: {_step(estimate)} at the sample",
    ]
    if (expected := curves.attrs.get("step_mm")) is not None:
        lines[-1] += f"; that of the calibration is {-1e3 * expected:.3g} um"
    if estimate.at_limit:
        mu = curves["friction"].values
        lines.append(
            f"WARNING: this is the end of the calibrated range, {mu.min():g} to {mu.max():g}: the "
            "coefficient is a bound (--coefficients widens the range)"
        )
    return "\n".join(lines)


def _step(estimate: FrictionEstimate) -> str:
    from optical_palpation.volume.units import MM

    if estimate.unit is None:
        return f"{estimate.step:.3g} in the unit of the profile"
    return f"{1e3 * MM[estimate.unit] * estimate.step:.3g} um"


def _is_typed(context: typer.Context, name: str) -> bool:
    """Whether an option that has a default was given."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"
