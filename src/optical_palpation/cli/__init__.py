"""The command line: parse, call the Python interface, show progress; it computes nothing.

Exit status: 0 done, 2 something the user supplied cannot be used, or there is too little memory
(nothing was written; a study keeps the stages that were finished), 3 the mechanical solution did
not reach the full load, 4 computed, but not every file could be written (the message says which
were), 5 pages do not say what a fresh run does (``reproduce --check``), 130 interrupted by Ctrl-C,
143 by SIGTERM.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Annotated

import typer

from optical_palpation.cli.batch import batch
from optical_palpation.cli.demo import demo
from optical_palpation.cli.experiment import experiment
from optical_palpation.cli.friction import friction
from optical_palpation.cli.grammar import Command, Group, epilog
from optical_palpation.cli.material import material
from optical_palpation.cli.options import SeveralNumbersCommand
from optical_palpation.cli.reproduce import reproduce
from optical_palpation.cli.results import compare, convert, figure, regions, report
from optical_palpation.cli.sample import sample
from optical_palpation.cli.stress import stress
from optical_palpation.cli.study import new, run
from optical_palpation.cli.submodel import submodel
from optical_palpation.cli.thickness import thickness
from optical_palpation.cli.uncertainty import uncertainty
from optical_palpation.cli.watch import watch
from optical_palpation.errors import (
    ConvergenceError,
    IncompleteOutputError,
    OpticalPalpationError,
)
from optical_palpation.runtime import software_version
from optical_palpation.runtime.environment import check_address_space, check_environment

_INTERRUPTED = "interrupted; no file is left half-written"

app = typer.Typer(
    name="optical-palpation",
    cls=Group,
    help="Tactile stress maps from the thickness of a compliant layer imaged by OCT.",
    epilog="A study from end to end: optical-palpation new study.toml, fill it in, then "
    "optical-palpation run study.toml. Shell completion: optical-palpation --install-completion.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,  # its boxes show types of Python
    pretty_exceptions_enable=False,
)

# The commands in the order of the help; of each, examples, and what long ones cost.
_EPILOGS: dict[Callable[..., None], str] = {
    sample: epilog(["sample relief", "sample nodule --output mine"], "some seconds."),
    new: epilog(["new study.toml"]),
    run: epilog(
        [
            "run study.toml",
            "run study.toml --check",
            "run study.toml --set friction.window=0.2",
            "run A.toml B.toml",
        ],
        "seconds to minutes, by element size; the first run on a machine compiles for up to two "
        "minutes.",
    ),
    batch: epilog(
        ["batch scans.csv --output results"], "that of each study, shared among the workers."
    ),
    watch: epilog(
        ["watch scans study.toml --pattern '*.oct'"],
        "for a map a second or less at 5,000 elements; of volumes, finding the layer comes first.",
    ),
    thickness: epilog(
        ["thickness loaded.oct --output loaded.nc --plot loaded.png"],
        "some seconds for 500 x 500 A-scans.",
    ),
    stress: epilog(
        [
            "stress map.mat --field-of-view 5 5 --initial-thickness 0.5 --c10 2.23 --c01 0.703 "
            "--window-friction 0.15 --sample-friction 0.05 --element-size 0.125 "
            "--output stress.nc --plot stress.png"
        ],
        "seconds for 10,000 elements, minutes for a million; the first run on a machine compiles "
        "for up to two minutes.",
    ),
    submodel: epilog(
        [
            "submodel stress.nc map.mat --field-of-view 5 5 --initial-thickness 0.5 "
            "--region 1 2 2 3 --element-size 0.025 --output part.nc"
        ],
        "that of as many elements as the region and its margin have.",
    ),
    material: epilog(["material test.csv --law mooney-rivlin --plot fit.png"]),
    friction: epilog(
        [
            "friction profile.csv --layer-size 10 10 --initial-thickness 0.5 "
            "--loaded-thickness 0.45 --region 1 --c10 2.23 --plot friction.png"
        ],
        "a minute or so for new calibration curves; --save-calibration keeps them.",
    ),
    uncertainty: epilog(
        ["uncertainty study.toml --modulus 0.02 --thickness-noise 0.001 --probes 2"],
        "that of the study, and two solutions more for each probe of noise.",
    ),
    figure: epilog(
        [
            "figure stress.nc --output figure.pdf",
            "figure stress.nc --map axial_stress --width single --limits -5 0 --scale-bar "
            "--output map.pdf",
        ]
    ),
    regions: epilog(["regions stress.nc RoiSet.zip --output table.csv --plot regions.png"]),
    compare: epilog(["compare before.nc after.nc --register --plot both.png"]),
    report: epilog(["report stress.nc --compare other.nc --output report.html"]),
    convert: epilog(["convert stress.nc --output stress.mat --output stress.tif"]),
    experiment: epilog(
        ["experiment sinusoid --output sinusoid"], "minutes; a larger --element-size is quicker."
    ),
    demo: epilog(["demo --output demo-output"], "about a minute."),
    reproduce: epilog(
        ["reproduce --output validation --only material"],
        "all parts take an hour or more; --quick shows that they run.",
    ),
}
for command, text in _EPILOGS.items():
    kind = SeveralNumbersCommand if command in (stress, submodel) else Command
    app.command(cls=kind, epilog=text)(command)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(software_version())
        raise typer.Exit


@app.callback()
def _about(
    _: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print version."),
    ] = False,
) -> None:
    """Tactile stress maps from the thickness of a compliant layer imaged by OCT."""
    check_environment()
    check_address_space()


def _status(error: OpticalPalpationError) -> int:
    if isinstance(error, ConvergenceError):
        return 3
    return 4 if isinstance(error, IncompleteOutputError) else 2


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit status."""
    try:
        app(None if arguments is None else list(arguments), prog_name="optical-palpation")
    except OpticalPalpationError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(_status(error))
    except KeyboardInterrupt:  # outside of a command: typer sees to those inside
        print(_INTERRUPTED, file=sys.stderr)
        sys.exit(130)
    except MemoryError as error:
        print(
            f"error: out of memory ({error or 'in a library'}); free some, or give a larger "
            "element_size",
            file=sys.stderr,
        )
        sys.exit(2)
    except SystemExit as leaving:
        if leaving.code == 130:  # Ctrl-C, about which typer says nothing
            print(_INTERRUPTED, file=sys.stderr)
        raise
