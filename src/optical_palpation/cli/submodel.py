"""``optical-palpation submodel``: a region of a result again, on finer elements; or all of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from optical_palpation.cli.batch import BatchDisplay
from optical_palpation.cli.options import (
    FieldOfView,
    InitialThickness,
    InitialVariable,
    LayerExtent,
    LengthUnit,
    Output,
    PixelSpacing,
    Plot,
    Quiet,
    Scheduler,
    ThicknessFiles,
    Threads,
    Untrusted,
    Variable,
    Workers,
    element_size_of,
    mark_filled,
    write_outputs,
)
from optical_palpation.cli.progress import ProgressDisplay


def submodel(
    result: Annotated[
        Path, typer.Argument(metavar="RESULT", help="Result for the whole map, NetCDF (.nc).")
    ],
    map: Annotated[
        Path, typer.Argument(metavar="MAP", help="The map of the loaded thickness behind it.")
    ],
    initial_thickness: InitialThickness,
    element_size: Annotated[
        str,
        typer.Option(metavar="SIZE | X Y Z", help="Size of the elements, mm: one value or three."),
    ],
    output: Output,
    region: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            metavar="X0 X1 Y0 Y1",
            help="Region, mm in the coordinates of the map; with --tile by default the whole "
            "layer.",
        ),
    ] = None,
    tile: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="Compute the region in overlapping tiles of this width, mm, each by a worker "
            "with memory for one of them, and blend their maps.",
        ),
    ] = None,
    overlap: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER", help="What neighbouring tiles share, mm; as wide as the margin."
        ),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    margin: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="What is computed around a region or tile, mm; half of the thickness by default.",
        ),
    ] = None,
    imprint_smoothing: Annotated[
        float | None,
        typer.Option(metavar="NUMBER", help="Smoothing of the imprint, mm; half an element."),
    ] = None,
    variable: Variable = None,
    initial_variable: InitialVariable = None,
    length_unit: LengthUnit = None,
    field_of_view: FieldOfView = None,
    pixel_spacing: PixelSpacing = None,
    layer_extent: LayerExtent = None,
    untrusted: Untrusted = False,
    plot: Plot = None,
    threads: Threads = None,
    quiet: Quiet = False,
) -> None:
    """Compute a region of a result again, on finer elements; with --tile, of any size.

    Material, friction and edges are those of the result. The maps must be those behind it.
    Tiles are kept beside the output until all of them are there, so that the same command
    continues after an interruption. Exit status 1: some tiles have no solution, and the maps no
    value there.
    """
    sizes = element_size_of(element_size)
    assert sizes is not None
    about_tiles = {"--overlap": overlap, "--workers": workers, "--scheduler": scheduler}
    if tile is None:
        if asked := [name for name, value in about_tiles.items() if value is not None]:
            raise typer.BadParameter(f"{', '.join(asked)}: for tiles, --tile is needed too")
        if region is None:
            raise typer.BadParameter("--region is needed, or --tile for the whole layer")
    elif threads is not None:
        raise typer.BadParameter("--threads: tiles share all cores among --workers")

    from optical_palpation import present
    from optical_palpation.palpation import submodel_stress

    files = ThicknessFiles(
        map,
        initial_thickness,
        variable,
        initial_variable,
        length_unit,
        field_of_view,
        pixel_spacing,
        layer_extent,
        untrusted,
    )
    wanted = {"result": output} | ({"picture": plot} if plot else {})
    present.check_outputs(wanted, [result, *files.paths])
    coarse = present.read_result(result)
    cleaned, initial = files.loaded(), files.initial()
    loaded = cleaned["thickness"]
    settings: dict[str, Any] = {
        "element_size": sizes,
        "margin": margin,
        "imprint_smoothing": imprint_smoothing,
    }
    if tile is None:
        assert region is not None
        with ProgressDisplay(quiet) as progress:
            part = submodel_stress(
                coarse, loaded, initial, region, threads=threads, progress=progress, **settings
            )
        mark_filled(part, cleaned, files)
        write_outputs(part, wanted, quiet)
        return
    from optical_palpation.batch.field import field_stress, remove_tiles

    tiles = output.with_name(f"{output.stem}-tiles")
    with BatchDisplay(quiet) as display:
        field = field_stress(
            coarse,
            loaded,
            initial,
            tile=tile,
            region=region,
            overlap=overlap,
            workers=workers,
            scheduler=scheduler,
            folder=tiles,
            progress=display,
            **settings,
        )
    mark_filled(field, cleaned, files)
    write_outputs(field, wanted, quiet)
    if "tiles_failed" in field.maps.attrs:
        if not quiet:
            print(f"the tiles that were computed are kept in {tiles}")
        raise typer.Exit(1)
    remove_tiles(tiles)
