"""``optical-palpation material``: the law of the layer from a uniaxial test."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optical_palpation.cli.law import LawChoice
from optical_palpation.cli.options import Quiet, print_files

if TYPE_CHECKING:
    from optical_palpation.material import UniaxialFit


class Measure(StrEnum):
    """What stress and strain refer to."""

    ENGINEERING = "engineering"
    TRUE = "true"


class Loading(StrEnum):
    """Direction of a test."""

    COMPRESSION = "compression"
    TENSION = "tension"


def material(
    test: Annotated[
        Path,
        typer.Argument(
            metavar="TEST",
            help="Table (.csv) of strain and stress, or of displacement and force.",
            show_default=False,
        ),
    ],
    law: Annotated[
        list[LawChoice] | None,
        typer.Option(
            metavar="LAW",
            help="Law to fit: mooney-rivlin, neo-hookean, yeoh or ogden; may be repeated; all if "
            "not given.",
            show_default=False,
        ),
    ] = None,
    strain_column: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Column of strain or displacement, if not found by name."
        ),
    ] = None,
    stress_column: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Column of stress or force, if not found by name."),
    ] = None,
    measure: Annotated[
        Measure | None, typer.Option(help="Measure, where a table has both or says nothing.")
    ] = None,
    loading: Annotated[
        Loading | None, typer.Option(help="Direction of the test, where signs leave it open.")
    ] = None,
    height: Annotated[
        float | None,
        typer.Option(metavar="NUMBER", help="Unloaded height, mm, for a table of displacement."),
    ] = None,
    area: Annotated[
        float | None,
        typer.Option(metavar="NUMBER", help="Unloaded area, mm2, for a table of force."),
    ] = None,
    contact: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="Recorded strain at which the platen meets the specimen, positive in the "
            "direction of loading; found if not given, and 0 trusts the recorded zero.",
            show_default=False,
        ),
    ] = None,
    toe_end: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="Recorded strain up to which points are left out; by default the end of the toe "
            "that was found, or the contact that was given.",
            show_default=False,
        ),
    ] = None,
    strain_range: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="LOW HIGH", help="Strains since contact to fit, both positive."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Also write the fits (.json)."),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also draw test and fits (.png, .pdf).")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Fit hyperelastic laws to a uniaxial test of the layer's material."""
    from optical_palpation import present
    from optical_palpation.material import find_contact, fit_uniaxial, read_uniaxial_test
    from optical_palpation.material.contact import Contact
    from optical_palpation.present.material_figure import write_material_figure
    from optical_palpation.present.record import write_fits

    outputs = {"record": output, "picture": plot}
    wanted = {kind: path for kind, path in outputs.items() if path is not None}
    present.check_outputs(wanted, [test])

    recorded = read_uniaxial_test(
        test,
        strain=strain_column,
        stress=stress_column,
        measure=measure.value if measure else None,
        loading=loading.value if loading else None,
        height=height,
        area=area,
    )
    sign = -1.0 if recorded.loading == "compression" else 1.0
    if contact is None:
        found = find_contact(recorded)
        error = f" ± {1.96 * found.standard_error:.2g} (95 %)"
    else:
        found = Contact(sign * contact, 0.0, sign * contact)
        error = " (given)"
    if toe_end is not None:
        found = replace(found, toe_end=sign * toe_end)
    points = recorded.from_contact(found.strain, found.toe_end)
    if strain_range is not None:
        points = points.between(*strain_range)
    fits = [fit_uniaxial(points, each.value) for each in dict.fromkeys(law or LawChoice)]

    if output:
        write_fits(fits, output, contact_strain=found.strain, toe_end_strain=found.toe_end)
    if plot:
        write_material_figure(fits, plot, recorded=recorded, contact=found)
    if quiet:
        return
    print(
        f"{test.name}: {recorded.loading} to a strain of {abs(recorded.strain).max():.3g}, "
        f"{recorded.measure} stress, {recorded.stress.size} points"
    )
    print(
        f"contact at a recorded strain of {sign * found.strain:.4g}{error}, left out up to "
        f"{sign * found.toe_end:.4g}: {points.stress.size} points fitted"
    )
    for fit in fits:
        print(_describe(fit))
    best = fits[0]
    if best.stable:
        options = [f"--{name} {value:.4g}" for name, value in best.parameters.items()]
        if best.law != LawChoice.MOONEY_RIVLIN:
            options.insert(0, f"--law {best.law}")
        print(f"for the layer: {' '.join(options)}")
    print_files(wanted)


def _describe(fit: UniaxialFit) -> str:
    """Return a fit as a few lines of words."""
    quantities = {
        name: (number, fit.intervals[name], "" if name == "alpha" else " kPa")
        for name, number in fit.parameters.items()
    }
    quantities["initial Young's modulus"] = (
        fit.initial_youngs_modulus,
        fit.initial_youngs_modulus_interval,
        " kPa",
    )
    lines = [f"{fit.law}: {'stable' if fit.stable else 'UNSTABLE'}, rms {fit.rms:.2g} kPa"]
    for name, (number, (low, high), unit) in quantities.items():
        lines.append(f"  {name} {number:.4g}{unit} (95 %: {low:.4g} to {high:.4g})")
    if not fit.stable:
        low = max(stretches[0] for stretches in fit.stable_stretches.values()) - 1
        high = min(stretches[1] for stretches in fit.stable_stretches.values()) - 1
        lines.append(
            f"  WARNING: stable only for strains from {low:.2g} to {high:.2g}, and the test goes "
            "beyond: do not use this law, or fit less of the test (--strain-range)"
        )
    return "\n".join(lines)
