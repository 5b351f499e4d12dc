"""``optical-palpation submodel``: a region of a result again, on finer elements."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optical_palpation.cli.progress import ProgressDisplay
from optical_palpation.cli.stress import element_size_of, is_number

if TYPE_CHECKING:
    import xarray as xr


def submodel(
    result: Annotated[
        Path, typer.Argument(metavar="RESULT", help="Result for the whole map, NetCDF (.nc).")
    ],
    map: Annotated[
        Path, typer.Argument(metavar="MAP", help="The map of the loaded thickness behind it.")
    ],
    initial_thickness: Annotated[
        str, typer.Option(metavar="NUMBER|MAP", help="Unloaded thickness: mm, or a map.")
    ],
    region: Annotated[
        tuple[float, float, float, float],
        typer.Option(metavar="X0 X1 Y0 Y1", help="Region, mm in the coordinates of the map."),
    ],
    element_size: Annotated[
        str,
        typer.Option(metavar="SIZE | X Y Z", help="Size of the elements, mm: one value or three."),
    ],
    output: Annotated[Path, typer.Option(metavar="FILE", help="Result, NetCDF (.nc).")],
    margin: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="What is computed around the region, mm; half of the thickness by default.",
        ),
    ] = None,
    imprint_smoothing: Annotated[
        float | None,
        typer.Option(metavar="NUMBER", help="Smoothing of the imprint, mm; half an element."),
    ] = None,
    variable: Annotated[
        str | None,
        typer.Option(metavar="TEXT", help="Variable of the map, where a file has several."),
    ] = None,
    initial_variable: Annotated[
        str | None,
        typer.Option(metavar="TEXT", help="Variable of the map of the unloaded thickness."),
    ] = None,
    length_unit: Annotated[
        str | None,
        typer.Option(metavar="TEXT", help="Unit of the thickness in the file: mm or um."),
    ] = None,
    field_of_view: Annotated[
        tuple[float, float] | None, typer.Option(metavar="X Y", help="Size of the map, mm.")
    ] = None,
    pixel_spacing: Annotated[
        tuple[float, float] | None, typer.Option(metavar="X Y", help="Size of a pixel, mm.")
    ] = None,
    layer_extent: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            metavar="X0 X1 Y0 Y1",
            help="Part of the map's own coordinates that the layer covers, mm.",
        ),
    ] = None,
    untrusted: Annotated[
        bool,
        typer.Option("--untrusted", help="Try HDF5 files out in a process of its own first."),
    ] = False,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also draw a picture (.png, .pdf).")
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(
            metavar="NUMBER", help="Number of threads; all available cores by default.", min=1
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Compute a region of a result again, on finer elements.

    Material, friction and edges are those of the result. The maps must be those behind it.
    """
    sizes = element_size_of(element_size)
    assert sizes is not None

    from optical_palpation import present, thickness
    from optical_palpation.palpation import submodel_stress
    from optical_palpation.present.output import write_each

    thickness_is_map = not is_number(initial_thickness)
    inputs = [result, map, *([Path(initial_thickness)] if thickness_is_map else [])]
    wanted = {"result": output} | ({"picture": plot} if plot else {})
    present.check_outputs(wanted, inputs)

    def read(path: Path, variable: str | None, **layer: Any) -> xr.DataArray:
        given = thickness.read_thickness_map(
            path,
            variable=variable,
            length_unit=length_unit,
            field_of_view=field_of_view,
            pixel_spacing=pixel_spacing,
            untrusted=untrusted,
            **layer,
        )
        return thickness.clean_thickness(given)["thickness"]

    coarse = present.read_result(result)
    loaded = read(map, variable, layer_extent=layer_extent)
    initial: Any = float(initial_thickness) if not thickness_is_map else None
    if thickness_is_map:
        initial = read(Path(initial_thickness), initial_variable)
    with ProgressDisplay(quiet) as progress:
        part = submodel_stress(
            coarse,
            loaded,
            initial,
            region,
            element_size=sizes,
            margin=margin,
            imprint_smoothing=imprint_smoothing,
            threads=threads,
            progress=progress,
        )
    writers = {"result": present.write_result, "picture": present.write_panel}
    if not quiet:
        print(present.summarise(part))
    write_each({path: partial(writers[kind], part) for kind, path in wanted.items()})
    if not quiet:
        for kind, path in wanted.items():
            print(f"{kind}: {path}")
