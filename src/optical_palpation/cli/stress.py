"""``optical-palpation stress``: from a map of the loaded thickness to maps of tactile stress."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optical_palpation.cli.law import (
    ALPHA_HELP,
    C01_HELP,
    C10_HELP,
    C20_HELP,
    C30_HELP,
    LAW_HELP,
    MU_HELP,
    LawChoice,
)
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
    ThicknessFiles,
    Threads,
    Untrusted,
    Variable,
    element_size_of,
    is_number,
    mark_filled,
    numbers_of,
    write_outputs,
)
from optical_palpation.cli.progress import ProgressDisplay

if TYPE_CHECKING:
    from optical_palpation.palpation import InputErrors


class Method(StrEnum):
    """How stress is computed."""

    ALGEBRAIC = "algebraic"
    COMPUTATIONAL = "computational"


class Edges(StrEnum):
    """What the layer does at the borders of the field of view."""

    FREE = "free"
    ROLLER = "roller"
    PADDED = "padded"


class Hold(StrEnum):
    """What holds a face of the layer."""

    FRICTION = "friction"
    GLUED = "glued"


class SampleLaw(StrEnum):
    """How the stress of the sample grows with strain."""

    NEO_HOOKEAN = "neo-hookean"
    LAYER = "layer"


def stress(
    maps: Annotated[
        list[Path],
        typer.Argument(
            metavar="MAP...",
            help="Loaded thickness: .mat, .npy, .npz, .csv, .txt, .tif or .nc. Several: a series "
            "of loads of a deformable sample, in the order of loading.",
            show_default=False,
        ),
    ],
    initial_thickness: InitialThickness,
    output: Output,
    law: Annotated[LawChoice, typer.Option(help=LAW_HELP)] = LawChoice.MOONEY_RIVLIN,
    c10: Annotated[float | None, typer.Option(metavar="NUMBER", help=C10_HELP)] = None,
    c01: Annotated[float | None, typer.Option(metavar="NUMBER", help=C01_HELP)] = None,
    c20: Annotated[float | None, typer.Option(metavar="NUMBER", help=C20_HELP)] = None,
    c30: Annotated[float | None, typer.Option(metavar="NUMBER", help=C30_HELP)] = None,
    mu: Annotated[float | None, typer.Option(metavar="NUMBER", help=MU_HELP)] = None,
    alpha: Annotated[float | None, typer.Option(metavar="NUMBER", help=ALPHA_HELP)] = None,
    bulk_to_shear: Annotated[
        float, typer.Option(metavar="NUMBER", help="Bulk over shear modulus.")
    ] = 1e4,
    method: Annotated[Method, typer.Option(help="How to compute stress.")] = Method.COMPUTATIONAL,
    window_friction: Annotated[
        float | None,
        typer.Option(metavar="NUMBER", help="Friction coefficient between window and layer."),
    ] = None,
    sample_friction: Annotated[
        float | None,
        typer.Option(metavar="NUMBER", help="Friction coefficient between layer and sample."),
    ] = None,
    window: Annotated[
        Hold, typer.Option(help="What holds the layer at the window; glued: it can't slip or open.")
    ] = Hold.FRICTION,
    sample: Annotated[
        Hold, typer.Option(help="What holds the layer at the sample; a glued one can pull.")
    ] = Hold.FRICTION,
    sample_motion: Annotated[
        str | None,
        typer.Option(
            metavar="STRAIN|FILE",
            help="How the sample's surface moves sideways: the strain by which it spreads, or a "
            "file of sample_displacement_x, sample_displacement_y, x, y. By default it does not.",
        ),
    ] = None,
    sample_thickness: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="Unloaded thickness of a deformable sample, mm. With it the sample is in the "
            "model, and its stiffness is found too; takes a minute.",
        ),
    ] = None,
    compression: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBER...",
            help="Travel of the plate below the sample after layer and sample have met, mm; one "
            "for each map.",
        ),
    ] = None,
    total_force: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBER...",
            help="Total force on the window, mN, in place of --compression or as a check of it; "
            "one for each map.",
        ),
    ] = None,
    plate_friction: Annotated[
        float | None,
        typer.Option(metavar="NUMBER", help="Friction coefficient between sample and plate."),
    ] = None,
    sample_relief: Annotated[
        Path | None,
        typer.Option(
            metavar="MAP",
            help="Height of the sample's unloaded surface, mm, towards the layer, or the word "
            "flat. If not given it is flat, or found from several maps.",
        ),
    ] = None,
    sample_size: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="X Y", help="Width of the sample, mm; that of the layer if not given."
        ),
    ] = None,
    sample_law: Annotated[
        SampleLaw, typer.Option(help="Law of the sample: how its stress grows with strain.")
    ] = SampleLaw.NEO_HOOKEAN,
    stiffness_smoothing: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="Smoothing of the sample's stiffness, 0.001 (hardly) to 10 (much); by default "
            "what the noise demands.",
        ),
    ] = None,
    element_size: Annotated[
        str | None,
        typer.Option(metavar="SIZE | X Y Z", help="Size of the elements, mm: one value or three."),
    ] = None,
    accuracy: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="In place of --element-size: error of the total force that the mesh may leave, "
            "0.02 for 2 %. Elements are made finer until the estimate is below that.",
        ),
    ] = None,
    edges: Annotated[
        Edges,
        typer.Option(
            help="Sides of the layer: free ends at them, padded goes on beyond the map, roller "
            "lets nothing move through them."
        ),
    ] = Edges.FREE,
    imprint_smoothing: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER", help="Smoothing of the imprint, mm; a small default is reported."
        ),
    ] = None,
    slip_length: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="Slip over which friction builds up, mm; by default 0.002 of the thickness, in "
            "proportion less where that is compressed by less than 10 %.",
        ),
    ] = None,
    input_error: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=NUMBER",
            help="Half-width of the 95 % interval of an input, instead of the default: "
            "window_friction (0.05), sample_friction (0.05), modulus (0.05, a fraction), thickness "
            "(0.002 mm), initial_thickness (0.002 mm); with a deformable sample also "
            "plate_friction (0.05), compression, sample_thickness and total_force (each 0.05, a "
            "fraction). May be repeated.",
            show_default=False,
        ),
    ] = None,
    estimates: Annotated[
        bool,
        typer.Option(
            help="Estimate the errors by inputs, mesh and sides of the layer. Without, the stress "
            "takes a third to two thirds of the time."
        ),
    ] = True,
    variable: Variable = None,
    initial_variable: InitialVariable = None,
    length_unit: LengthUnit = None,
    field_of_view: FieldOfView = None,
    pixel_spacing: PixelSpacing = None,
    layer_extent: LayerExtent = None,
    untrusted: Untrusted = False,
    plot: Plot = None,
    vtk: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write the layer for ParaView (.vts).")
    ] = None,
    profiles: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write the profiles through the centre (.csv)."),
    ] = None,
    deck: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write the problem for Abaqus or CalculiX (.inp)."),
    ] = None,
    threads: Threads = None,
    quiet: Quiet = False,
) -> None:
    """Compute the tactile stress behind a map of the loaded thickness of the layer."""
    holds: dict[str, Any] = {}
    for face, hold, friction in (
        ("window", window, window_friction),
        ("sample", sample, sample_friction),
    ):
        if hold is Hold.GLUED and friction is not None:
            raise typer.BadParameter(f"--{face} glued leaves no place for --{face}-friction")
        holds[face] = "glued" if hold is Hold.GLUED else friction
    needed = {
        "--window-friction (or --window glued)": holds["window"],
        "--sample-friction (or --sample glued)": holds["sample"],
        "--element-size (or --accuracy)": element_size if accuracy is None else accuracy,
    }
    about_sample = {
        "--compression": compression,
        "--total-force": total_force,
        "--plate-friction": plate_friction,
        "--sample-relief": sample_relief,
        "--sample-size": sample_size,
        "--stiffness-smoothing": stiffness_smoothing,
    }
    if sample_thickness is None:
        if asked := [name for name, value in about_sample.items() if value is not None]:
            raise typer.BadParameter(
                f"{', '.join(asked)}: with a deformable sample --sample-thickness is needed too"
            )
    else:
        _check_sample_options(
            {
                "--compression or --total-force": compression or total_force,
                "--plate-friction": plate_friction,
            },
            {
                "--method algebraic": method is Method.ALGEBRAIC,
                "--sample-motion": sample_motion is not None,
                "--window glued": window is Hold.GLUED,
                "--sample glued": sample is Hold.GLUED,
                f"--edges {edges.value}": edges is not Edges.FREE,
                "--imprint-smoothing": imprint_smoothing is not None,
                "--slip-length": slip_length is not None,
                "--deck": deck is not None,
            },
        )
    layer_outputs = {"--vtk": vtk, "--deck": deck}
    if method is Method.COMPUTATIONAL:
        if absent := [name for name, value in needed.items() if value is None]:
            raise typer.BadParameter(f"the computational method also needs {', '.join(absent)}")
    else:
        if asked := [name for name, path in layer_outputs.items() if path]:
            absent_layer = f"the algebraic method has no layer to write: {', '.join(asked)}"
            raise typer.BadParameter(absent_layer)
        if sample_motion:
            raise typer.BadParameter("the algebraic method makes no use of --sample-motion")
    if deck and "glued" in holds.values():
        raise typer.BadParameter("--deck: a deck has friction and no glued faces")
    if accuracy is not None and element_size is not None:
        raise typer.BadParameter("--accuracy chooses the --element-size: give one of them")
    sizes = element_size_of(element_size)
    travels = numbers_of("--compression", compression)
    forces = numbers_of("--total-force", total_force)
    if len(maps) > 1 and sample_thickness is None:
        raise typer.BadParameter("several maps are a series of loads: --sample-thickness is needed")

    from optical_palpation import present, thickness
    from optical_palpation.material import make_law
    from optical_palpation.palpation import algebraic_stress
    from optical_palpation.palpation.plausibility import check_field, check_layer, check_stress

    *earlier, last = maps
    files = ThicknessFiles(
        last,
        initial_thickness,
        variable,
        initial_variable,
        length_unit,
        field_of_view,
        pixel_spacing,
        layer_extent,
        untrusted,
    )
    inputs = [*files.paths, *earlier]
    motion_is_file = sample_motion is not None and not is_number(sample_motion)
    if motion_is_file:
        inputs.append(Path(str(sample_motion)))
    flat = str(sample_relief) == "flat"
    if sample_relief is not None and not flat:
        inputs.append(sample_relief)
    outputs = {"result": output, "picture": plot, "ParaView file": vtk}
    outputs |= {"profiles": profiles, "deck": deck}
    wanted = {kind: path for kind, path in outputs.items() if path is not None}
    present.check_outputs(wanted, inputs)

    wanted_errors = _input_errors(input_error or [], sample_thickness is not None)
    errors = wanted_errors if estimates else None
    material = make_law(
        law.value, bulk_to_shear, c10=c10, c01=c01, c20=c20, c30=c30, mu=mu, alpha=alpha
    )
    check_layer(material)
    cleaned = files.loaded()
    loaded = cleaned["thickness"]
    width, height = (float(loaded[axis][-1] - loaded[axis][0]) for axis in "xy")
    check_field(width, height, str(last))
    initial = files.initial()
    glued = sample is Hold.GLUED
    check_stress(algebraic_stress(loaded, initial, material, glued=glued))
    if method is Method.ALGEBRAIC:
        from optical_palpation.palpation import algebraic_result

        result = algebraic_result(loaded, initial, material, glued=glued)
    elif sample_thickness is not None:
        from optical_palpation.stiffness import Sample, sample_stress

        if not isinstance(sizes, float):
            raise typer.BadParameter("--element-size: one number with a deformable sample")
        assert plate_friction is not None  # refused above
        relief: Any = "flat" if flat else None
        if sample_relief is not None and not flat:
            relief = thickness.read_height_map(sample_relief)
        loads = [replace(files, map=path).loaded() for path in earlier]
        # What was filled says nothing of the sample.
        measured = [each["thickness"].where(~each["filled"]) for each in (*loads, cleaned)]
        law_of_sample = material if sample_law is SampleLaw.LAYER else None
        with ProgressDisplay(quiet) as progress:
            result = sample_stress(
                measured,
                initial,
                material,
                Sample(
                    sample_thickness,
                    travels,
                    plate_friction,
                    relief,
                    sample_size,
                    law_of_sample,
                    forces,
                ),
                window_friction=holds["window"],
                sample_friction=holds["sample"],
                element_size=sizes,
                smoothing=stiffness_smoothing,
                input_errors=errors,
                threads=threads,
                progress=progress,
            )
    else:
        from optical_palpation.palpation import (
            computational_stress,
            read_sample_motion,
            uniform_motion,
        )

        motion = None
        if sample_motion is not None:
            motion = (
                read_sample_motion(sample_motion, untrusted=untrusted)
                if motion_is_file
                else uniform_motion(loaded, float(sample_motion))
            )
        with ProgressDisplay(quiet) as progress:
            result = computational_stress(
                loaded,
                initial,
                material,
                window_friction=holds["window"],
                sample_friction=holds["sample"],
                element_size=sizes,
                accuracy=accuracy,
                sample_motion=motion,
                edges=edges.value,
                imprint_smoothing=imprint_smoothing,
                slip_length=slip_length,
                threads=threads,
                mesh_check=estimates,
                edge_check=estimates,
                input_errors=errors,
                progress=progress,
            )
    mark_filled(result, cleaned, files)
    if not isinstance(initial, float):
        result.maps.attrs["initial_thickness_input"] = initial.attrs["source"]
        result.maps.attrs["initial_thickness_input_sha256"] = initial.attrs["source_sha256"]

    write_outputs(result, wanted, quiet)


def _input_errors(given: list[str], modelled: bool) -> InputErrors:
    """Errors of the inputs as the options give them."""
    from optical_palpation.palpation import InputErrors
    from optical_palpation.palpation.input_errors import OF_SAMPLE

    errors = InputErrors.parsed(given)
    named = {text.partition("=")[0].strip().replace("-", "_") for text in given}
    if not modelled and (of_sample := [name for name in OF_SAMPLE if name in named]):
        raise typer.BadParameter(
            f"--input-error {', '.join(of_sample)}: only with --sample-thickness"
        )
    return errors


def _check_sample_options(needed: dict[str, Any], in_the_way: dict[str, bool]) -> None:
    """Refuse what is missing with a deformable sample, and what makes no sense with it."""
    if absent := [name for name, value in needed.items() if value is None]:
        raise typer.BadParameter(f"--sample-thickness also needs {', '.join(absent)}")
    if asked := [name for name, given in in_the_way.items() if given]:
        raise typer.BadParameter(f"--sample-thickness cannot go with {', '.join(asked)}")
