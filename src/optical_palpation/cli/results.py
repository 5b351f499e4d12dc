"""``figure``, ``regions``, ``compare``, ``report``, ``convert``: what a result is shown as."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optical_palpation.cli.options import Quiet, print_files
from optical_palpation.errors import InputError, OutputError

if TYPE_CHECKING:
    from optical_palpation.palpation import StressResult

_Result = Annotated[
    Path,
    typer.Argument(metavar="RESULT", help="A result (.nc), or the result folder of a study."),
]
_Regions = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Regions of interest: ImageJ's .roi or .zip, .csv of napari or of name, x_mm, y_mm, "
        "or a mask or labels (.tif, .png, .npy) on the points of the map.",
        show_default=False,
    ),
]


def result_file(path: Path) -> Path:
    """File of a result, which in the result folder of a study is its stress."""
    return path / "stress.nc" if os.path.isdir(path) else path


def read(path: Path) -> StressResult:
    """Read a result, or that in the result folder of a study."""
    from optical_palpation.present import read_result

    file = result_file(path)
    if path.suffix.lower() == ".toml" or (os.path.isdir(path) and not os.path.isfile(file)):
        inside = sorted((path if os.path.isdir(path) else path.parent).glob("*/stress.nc"))
        made = f"such as {inside[0].parent}" if inside else "which 'optical-palpation run' makes"
        raise InputError(f"{path}: is no result; give the result folder of a study, {made}")
    return read_result(file)


def figure(
    result: _Result,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="Figure (.png, .pdf, .svg).")
    ],
    map: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Map to show, such as axial_stress; may be repeated. All panels by default.",
            show_default=False,
        ),
    ] = None,
    width: Annotated[
        str, typer.Option(metavar="WIDTH", help="single or double column, or mm.")
    ] = "double",
    columns: Annotated[
        int | None, typer.Option(metavar="NUMBER", help="Maps beside each other.", min=1)
    ] = None,
    limits: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="LOW HIGH", help="Limits of the colours, in the unit of the map."),
    ] = None,
    colours: Annotated[
        str | None, typer.Option(metavar="NAME", help="Another colour map, such as magma.")
    ] = None,
    scale_bar: Annotated[
        bool, typer.Option("--scale-bar", help="A scale bar instead of axes.")
    ] = False,
    regions: _Regions = None,
    quiet: Quiet = False,
) -> None:
    """Draw a figure for a paper: maps of a result, true to scale, with units."""
    from optical_palpation import present
    from optical_palpation.analysis import read_regions

    present.check_outputs({"picture": output}, [result_file(result)])
    read_one = read(result)
    size = float(width) if width.replace(".", "", 1).isdigit() else width
    if map:
        present.write_maps(
            read_one,
            output,
            map,
            width=size,  # type: ignore[arg-type]
            columns=columns,
            limits=limits,
            colours=colours,
            scale_bar=scale_bar,
            regions=read_regions(regions, read_one.maps) if regions else (),
        )
    else:
        chosen = {
            "--columns": columns,
            "--limits": limits,
            "--colours": colours,
            "--scale-bar": scale_bar or None,
            "--regions": regions,
        }
        if given := [option for option, value in chosen.items() if value is not None]:
            raise typer.BadParameter(f"{', '.join(given)}: only of maps, which --map names")
        present.write_panel(read_one, output, width=size)  # type: ignore[arg-type]
    if not quiet:
        print(f"picture: {output}")


def regions(
    result: _Result,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="REGIONS",
            help="ImageJ's .roi or .zip, .csv of napari or of name, x_mm, y_mm, or a mask or "
            "labels (.tif, .png, .npy) on the points of the map.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Also write the table (.csv)."),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also draw map and regions (.png, .pdf, .svg)."),
    ] = None,
    map: Annotated[str, typer.Option(metavar="NAME", help="Map to look at.")] = "axial_stress",
    quiet: Quiet = False,
) -> None:
    """Print the mean, extremes, force and contrast of regions of interest."""
    from optical_palpation import present
    from optical_palpation.analysis import read_regions, region_statistics
    from optical_palpation.present.tables import table_in_words, write_table

    wanted = {"table": output, "picture": plot}
    present.check_outputs(
        {k: p for k, p in wanted.items() if p is not None}, [result_file(result), file]
    )
    read_one = read(result)
    found = read_regions(file, read_one.maps)
    table = region_statistics(read_one.maps, found, map)
    if output:
        write_table(table, output)
    if plot:
        present.write_maps(read_one, plot, [map], regions=found)
    if quiet:
        return
    print(table_in_words(table))
    print_files(wanted)


def compare(
    results: Annotated[
        list[Path],
        typer.Argument(
            metavar="RESULT RESULT...",
            help="Two or more results (.nc) or result folders of studies, the reference first.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Also write the differences (.nc)."),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also draw maps and differences (.png, .pdf, .svg)."),
    ] = None,
    map: Annotated[str, typer.Option(metavar="NAME", help="Map to compare.")] = "axial_stress",
    register: Annotated[
        bool, typer.Option("--register", help="Correct lateral shifts, found from the relief.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Compare results on one grid and one scale: differences, with their error where known."""
    from optical_palpation import present
    from optical_palpation.analysis import compare_results
    from optical_palpation.present.comparison import comparison_in_words, write_comparison
    from optical_palpation.present.comparison import write_comparison_figure as draw

    if len(results) < 2:
        raise typer.BadParameter("give two results at least")
    wanted = {"result": output, "picture": plot}
    files = [result_file(path) for path in results]
    present.check_outputs({k: p for k, p in wanted.items() if p is not None}, files)
    maps = {name: read(path).maps for name, path in _named(results).items()}
    found = compare_results(maps, map, register=register)
    if output:
        write_comparison(found, output)
    if plot:
        draw(found, plot)
    if quiet:
        return
    print(comparison_in_words(found))
    print_files(wanted)


def _named(results: Sequence[Path]) -> dict[str, Path]:
    """What to call results: by their files, by the folders of these, or by both."""
    whole = [path.resolve() for path in results]
    if len(set(whole)) < len(whole):
        raise typer.BadParameter("the same result is given twice")
    files = [_study_name(path) if os.path.isdir(path) else path.stem for path in whole]
    folders = [path.name if os.path.isdir(path) else path.parent.name for path in whole]
    for names in (files, folders, [str(path) for path in results]):
        if len(set(names)) == len(names):
            break
    return dict(zip(names, results, strict=True))


def _study_name(folder: Path) -> str:
    """What to call the result folder of a study: by the study."""
    name = folder.parent.name if folder.name == "results" else folder.name.removesuffix("-results")
    return name or folder.name


def _heading(result: Path) -> str:
    """What to call a result alone: by its file, unless that says nothing, by its folder."""
    whole = result.resolve()
    if os.path.isdir(whole):
        return _study_name(whole)
    folder = _study_name(whole.parent)
    return (
        f"{folder}: {whole.stem}" if whole.stem in ("stress", "result") and folder else whole.stem
    )


def report(
    result: _Result,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="Report (.html).")],
    compare: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RESULT",
            help="Another result, whose difference is shown; may be repeated.",
            show_default=False,
        ),
    ] = None,
    regions: _Regions = None,
    title: Annotated[str | None, typer.Option(metavar="TEXT", help="Heading.")] = None,
    quiet: Quiet = False,
) -> None:
    """Write the report of a result as one HTML file, with other results and regions on request.

    A study's own report also shows its B-scans.
    """
    from optical_palpation import present, study
    from optical_palpation.analysis import read_regions

    present.check_outputs({"report": output}, [result_file(result)])
    one = read(result)
    source = result_file(result)
    beside = source.resolve().parent == output.resolve().parent
    named = _named([result, *(compare or ())])
    others = {name: read(path) for name, path in named.items() if path != result}
    path = str(source)
    present.write_report(
        output,
        one,
        loaded=None,
        unloaded=None,
        volumes=None,
        parameters={},
        python=f"import optical_palpation as op\n\nresult = op.read_result({path!r})\n",
        title=title or _heading(result),
        warnings=study.warnings_about(one),
        others=others,
        regions=read_regions(regions, one.maps) if regions else (),
        result_file=source.name if beside else None,
    )
    if not quiet:
        print(f"report: {output}")


def convert(
    result: _Result,
    output: Annotated[
        list[Path],
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="What to write, by its ending: .mat (MATLAB, Octave), .tif (ImageJ), .vts "
            "(ParaView), .csv (profiles), .nc, .png, .pdf, .svg; may be repeated.",
        ),
    ],
    quiet: Quiet = False,
) -> None:
    """Write a result for other programs: MATLAB, Octave, ImageJ, ParaView, a spreadsheet."""
    from optical_palpation import present

    one = read(result)
    for path in output:
        if path.resolve() == result_file(result).resolve():
            raise OutputError(f"{path}: is the result itself; choose another name")
    for path in output:
        present.write(one, path)
        if not quiet:
            print(path)
