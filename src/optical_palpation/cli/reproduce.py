"""``optical-palpation reproduce``: the validation and the verification page."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from optical_palpation.cli.options import Quiet, Threads
from optical_palpation.cli.progress import ProgressDisplay


def reproduce(
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            help="Folder of pages and pictures; made if need be.",
        ),
    ],
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="PART", help="Page or part to make; may be repeated; else all."),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder of third-party data; parts that need them are else left out.",
        ),
    ] = None,
    references: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder of the references by independent codes, tests/data/references of the "
            "repository; parts that need them are else left out.",
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Coarsest grids: shows only that everything runs.")
    ] = False,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Change nothing: compare every number of the pages with a fresh run.",
        ),
    ] = False,
    again: Annotated[
        bool, typer.Option("--again", help="Recompute parts that are there already.")
    ] = False,
    threads: Threads = None,
    quiet: Quiet = False,
) -> None:
    """Make the validation page (the paper's figures and ours) and the verification page.

    The second compares the solver with closed forms and an independent code. Parts that the folder
    holds already are kept, so that an interrupted run goes on. With --check the exit status is 5 if
    a number is not within the tolerance of a fresh run; parts without their data are named and left
    out.
    """
    from optical_palpation.errors import ConvergenceError
    from optical_palpation.reproduce import PAGES, check_pages
    from optical_palpation.reproduce import reproduce as make
    from optical_palpation.study import Progress

    if check:
        if again:
            raise typer.BadParameter("--check changes nothing, so nothing can be made --again")
        with ProgressDisplay(quiet) as progress:
            found = check_pages(
                output,
                PAGES,
                only=only or (),
                data=data,
                references=references,
                quick=quick,
                threads=threads,
                tell=lambda part, share, what: progress(Progress(part, share, None, what)),
            )
        if not quiet:
            for name, why in found.left_out.items():
                print(f"left out: {name} ({why})")
            print(f"compared: {found.numbers} numbers")
        for name, said in found.differences.items():
            for text in said:
                print(f"{name}: {text}", file=sys.stderr)
        if found.differences:
            raise typer.Exit(5)
        return
    with ProgressDisplay(quiet) as progress:
        pages, missing = make(
            output,
            only=only or (),
            data=data,
            references=references,
            quick=quick,
            again=again,
            threads=threads,
            tell=lambda part, share, what: progress(Progress(part, share, None, what)),
        )
    if not quiet:
        for page in pages:
            print(f"page: {page}")
    for name, why in missing.items():
        # What was asked for by name, and what should have worked, is a failure of the command.
        if only or isinstance(why, ConvergenceError):
            raise why
        if not quiet:
            print(f"left out: {name} ({why})")
