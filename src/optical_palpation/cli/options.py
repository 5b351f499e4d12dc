"""Options that several commands take, and how maps are read and results are written by them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optical_palpation.cli.grammar import Command

if TYPE_CHECKING:
    import xarray as xr

    from optical_palpation.palpation import StressResult

InitialThickness = Annotated[
    str,
    typer.Option(metavar="NUMBER|MAP", help="Unloaded thickness: mm, or a map like the first one."),
]
Variable = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Variable of the map, where a file has several."),
]
InitialVariable = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Variable of the map of the unloaded thickness."),
]
LengthUnit = Annotated[
    str | None,
    typer.Option(metavar="UNIT", help="Unit of the thickness in the file: mm or um."),
]
FieldOfView = Annotated[
    tuple[float, float] | None, typer.Option(metavar="X Y", help="Size of the map, mm.")
]
PixelSpacing = Annotated[
    tuple[float, float] | None, typer.Option(metavar="X Y", help="Size of a pixel, mm.")
]
LayerExtent = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option(
        metavar="X0 X1 Y0 Y1",
        help="Part of the map's own coordinates that the layer covers, mm.",
    ),
]
Untrusted = Annotated[
    bool, typer.Option("--untrusted", help="Read HDF5 files in a separate process first.")
]
Output = Annotated[
    Path, typer.Option("--output", "-o", metavar="FILE", help="Result, NetCDF (.nc).")
]
Plot = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Also draw a picture (.png, .pdf).")
]
Workers = Annotated[
    int | None,
    typer.Option(
        metavar="NUMBER", help="Workers on this machine.  [default: as cores and memory allow]"
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Address of a running Dask scheduler, or its scheduler file (.json).",
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(
        metavar="NUMBER", help="Number of threads; all available cores by default.", min=1
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]


#: Options that take one number or several.
_SEVERAL = ("--element-size", "--compression", "--total-force")


class SeveralNumbersCommand(Command):
    """Lets options take one number or several, which option parsers cannot express."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join the numbers that follow such an option with commas, then parse as usual."""
        joined: list[str] = []
        for argument in args:
            option = joined[-1].partition("=")[0] if joined else ""
            if option in _SEVERAL and is_number(argument):
                separator = "," if "=" in joined[-1] else "="
                joined[-1] += separator + argument
            else:
                joined.append(argument)
        return super().parse_args(ctx, joined)


def element_size_of(text: str | None) -> float | tuple[float, ...] | None:
    """Read ``--element-size``."""
    if text is None:
        return None
    parts = text.split(",")
    if len(parts) not in (1, 3) or not all(map(is_number, parts)):
        raise typer.BadParameter(
            f"--element-size takes one number of mm, or three for x, y, z; found {text!r}"
        )
    sizes = tuple(float(part) for part in parts)
    return sizes if len(sizes) == 3 else sizes[0]


def numbers_of(option: str, text: str | None) -> tuple[float, ...] | None:
    """Read an option that takes a number for each map."""
    if text is None:
        return None
    if not all(map(is_number, text.split(","))):
        raise typer.BadParameter(f"{option} takes a number for each map; found {text!r}")
    return tuple(float(part) for part in text.split(","))


def is_number(text: str) -> bool:
    """Whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class ThicknessFiles:
    """The map of the loaded thickness and the unloaded thickness, as options name them."""

    map: Path
    initial_thickness: str
    variable: str | None
    initial_variable: str | None
    length_unit: str | None
    field_of_view: tuple[float, float] | None
    pixel_spacing: tuple[float, float] | None
    layer_extent: tuple[float, float, float, float] | None
    untrusted: bool

    @property
    def paths(self) -> list[Path]:
        """The files."""
        initial = [] if is_number(self.initial_thickness) else [Path(self.initial_thickness)]
        return [self.map, *initial]

    def loaded(self) -> xr.Dataset:
        """Read and clean the loaded thickness."""
        return self._cleaned(self.map, self.variable, layer_extent=self.layer_extent)

    def initial(self) -> float | xr.DataArray:
        """Read the unloaded thickness: a number, or a map without gaps."""
        if is_number(self.initial_thickness):
            return float(self.initial_thickness)
        return self._unloaded["thickness"]

    def initial_filled_share(self, loaded: xr.DataArray) -> float:
        """Fraction of the layer on whose pixels the unloaded thickness is interpolated."""
        from optical_palpation.thickness.frames import inside_layer
        from optical_palpation.thickness.initial import filled_there

        inside = inside_layer(loaded)
        if is_number(self.initial_thickness) or not inside.any():
            return 0.0
        return float(filled_there(self._unloaded["filled"], loaded).values[inside].mean())

    @cached_property
    def _unloaded(self) -> xr.Dataset:
        return self._cleaned(Path(self.initial_thickness), self.initial_variable)

    def _cleaned(self, path: Path, variable: str | None, **layer: Any) -> xr.Dataset:
        from optical_palpation.thickness import clean_thickness, read_thickness_map

        return clean_thickness(
            read_thickness_map(
                path,
                variable=variable,
                length_unit=self.length_unit,
                field_of_view=self.field_of_view,
                pixel_spacing=self.pixel_spacing,
                untrusted=self.untrusted,
                **layer,
            )
        )


def mark_filled(result: StressResult, cleaned: xr.Dataset, files: ThicknessFiles) -> None:
    """Let what was filled in loaded and unloaded thickness go with a result."""
    from optical_palpation.analysis.maps import area_mean

    # The maps of the computational method lie on the nodes of its elements, not on the pixels.
    here = {axis: result.maps[axis] for axis in "yx"}
    result.maps["filled"] = cleaned["filled"].reindex(here, method="nearest")
    result.maps.attrs |= cleaned.attrs
    loaded = cleaned["thickness"]
    if "submodel_region_mm" in result.maps.attrs:  # the shares are those of the whole
        loaded = loaded.assign_attrs(layer_extent=list(result.maps.attrs["submodel_region_mm"]))
        for share in ("missing_share", "spike_share"):
            del result.maps.attrs[share]
        result.maps.attrs["filled_share"] = area_mean(result.maps["filled"])
    result.maps.attrs["initial_filled_share"] = files.initial_filled_share(loaded)


def each_on(workers: int | None, scheduler: str | None) -> Callable[..., Iterator[Any]] | None:
    """Give a ``map`` whose calls run side by side on workers, None where there are none.

    The workers start with the first call and end with it.
    """
    if workers is not None and scheduler is not None:
        raise typer.BadParameter("--workers are for this machine, --scheduler has its own")
    if workers is None and scheduler is None:
        return None

    def each(function: Callable[[Any], Any], values: Iterable[Any]) -> Iterator[Any]:
        from optical_palpation.batch import worker_map

        with worker_map(workers=workers, scheduler=scheduler) as apply:
            yield from apply(function, values)

    return each


def write_outputs(result: StressResult, wanted: Mapping[str, Path], quiet: bool) -> None:
    """Write a result to files by their kinds, and print what it says and where they are."""
    from optical_palpation.present import summarise
    from optical_palpation.present.output import write_each
    from optical_palpation.present.writing import WRITERS

    if not quiet:
        print(summarise(result))
    write_each({path: partial(WRITERS[kind], result) for kind, path in wanted.items()})
    if not quiet:
        print_files(wanted)


def print_files(wanted: Mapping[str, Path | None]) -> None:
    """Print which files were written, by their kinds."""
    for kind, path in wanted.items():
        if path is not None:
            print(f"{kind}: {path}")
