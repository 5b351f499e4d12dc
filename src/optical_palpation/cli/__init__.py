"""The command line: parse, call the Python interface, show progress; it computes nothing.

Exit status: 0 done, 2 something the user supplied cannot be used (nothing was written), 3 the
mechanical solution did not reach the full load, 130 interrupted by Ctrl-C.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated

import typer

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
from optical_palpation.errors import ConvergenceError, OpticalPalpationError

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
app.command()(thickness)
app.command()(friction)
app.command()(material)
app.command()(experiment)
app.command()(uncertainty)
app.command()(reproduce)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(version("optical-palpation"))
        raise typer.Exit


@app.callback()
def _about(
    _: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print version."),
    ] = False,
) -> None:
    """Tactile stress maps from the thickness of a compliant layer imaged by OCT."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit status."""
    try:
        app(None if arguments is None else list(arguments), prog_name="optical-palpation")
    except OpticalPalpationError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(3 if isinstance(error, ConvergenceError) else 2)
    except SystemExit as leaving:
        if leaving.code == 130:  # Ctrl-C, about which typer says nothing
            print("interrupted; no file is left half-written", file=sys.stderr)
        raise
