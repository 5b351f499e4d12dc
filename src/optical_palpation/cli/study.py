"""``optical-palpation new`` and ``run``: a whole study as one file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optical_palpation.cli.progress import ProgressDisplay


def new(
    file: Annotated[Path, typer.Argument(help="The study file to write.")] = Path("study.toml"),
) -> None:
    """Write a commented study file to begin with."""
    from optical_palpation.study import write_template

    write_template(file)
    print(f"{file}: fill it in, then: optical-palpation run {file}")


def run(
    file: Annotated[Path, typer.Argument(help="The study file.", show_default=False)],
    thickness_only: Annotated[
        bool, typer.Option("--thickness-only", help="Stop before the stress.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Do everything that a study file asks for; go on where an earlier run was interrupted."""
    from optical_palpation import present, study

    asked = study.read_study(file)
    with ProgressDisplay(quiet) as progress:
        done = study.run_study(asked, thickness_only=thickness_only, progress=progress)
    if quiet:
        return
    if not thickness_only:
        result = present.read_result(done.folder / "stress.nc")
        print(present.summarise(result))
        for warning in study.warnings_about(result):
            print(f"WARNING: {warning}")
    for name in done.files:
        print(f"{done.folder / name}{' (from an earlier run)' if name in done.earlier else ''}")
