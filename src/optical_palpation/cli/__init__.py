"""The command line: parse, call the Python interface, show progress; it computes nothing.

Exit status: 0 done, 2 something the user supplied cannot be used, or there is too little memory
(nothing was written; a study keeps the stages that were finished), 3 the mechanical solution did
not reach the full load, 4 computed, but not every file could be written (the message says which
were), 130 interrupted by Ctrl-C, 143 by SIGTERM.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from optical_palpation.cli.batch import batch
from optical_palpation.cli.demo import demo
from optical_palpation.cli.experiment import experiment
from optical_palpation.cli.friction import friction
from optical_palpation.cli.material import material
from optical_palpation.cli.reproduce import reproduce
from optical_palpation.cli.sample import sample
from optical_palpation.cli.stress import StressCommand, stress
from optical_palpation.cli.study import new, run
from optical_palpation.cli.thickness import thickness
from optical_palpation.cli.uncertainty import uncertainty
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
    help="Tactile stress maps from the thickness of a compliant layer imaged by OCT.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command(cls=StressCommand)(stress)
app.command()(demo)
app.command()(sample)
app.command()(new)
app.command()(run)
app.command()(batch)
app.command()(thickness)
app.command()(friction)
app.command()(material)
app.command()(experiment)
app.command()(uncertainty)
app.command()(reproduce)


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
