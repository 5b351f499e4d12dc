"""``optical-palpation new`` and ``run``: a whole study as one file."""

from __future__ import annotations

import hashlib
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optical_palpation.cli.options import Quiet, Threads
from optical_palpation.cli.progress import ProgressDisplay
from optical_palpation.errors import ConvergenceError, InputError, OpticalPalpationError

if TYPE_CHECKING:
    from optical_palpation.study import Study

#: Letters of the changed values in the name of a result folder.
_LONGEST = 100


def new(
    file: Annotated[
        Path, typer.Argument(metavar="STUDY", help="The study file to write (.toml).")
    ] = Path("study.toml"),
    quiet: Quiet = False,
) -> None:
    """Write a commented study file to begin with."""
    from optical_palpation.study import write_template

    write_template(file)
    if not quiet:
        print(f"{file}: fill it in, then: optical-palpation run {file}")


def run(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="STUDY...", help="One or more study files.", show_default=False),
    ],
    thickness_only: Annotated[
        bool, typer.Option("--thickness-only", help="Stop before the stress.")
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Read everything, compute and write nothing.")
    ] = False,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="A value instead of the file's, such as friction.window=0.2; may be repeated. The "
            "results go to a separate folder.",
            show_default=False,
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            help="Result folder, of a single study; after the study file by default.",
            show_default=False,
        ),
    ] = None,
    threads: Threads = None,
    quiet: Quiet = False,
) -> None:
    """Do everything that study files ask for; continue where an earlier run was interrupted."""
    from optical_palpation.study import read_study

    if output is not None and len(files) > 1:
        raise typer.BadParameter("--output is the folder of one study; leave it out of several")
    values: dict[str, Any] = {}
    for name, value in map(_change, changes or ()):
        if name in values:
            raise typer.BadParameter(f"--set {name}: is given more than once")
        values[name] = value
    options: dict[str, Any] = {}
    for option, key, asked_for in (
        ("--output", "outputs.folder", None if output is None else str(output.resolve())),
        ("--threads", "grid.threads", threads),
    ):
        if asked_for is None:
            continue
        if key in values:
            raise typer.BadParameter(f"{option} and --set {key} say the same: leave one out")
        options[key] = asked_for
    failed: list[OpticalPalpationError] = []

    def several(error: OpticalPalpationError) -> None:
        """Tell of one study of several; the others go on."""
        if len(files) == 1:
            raise error
        print(f"error: {error}", file=sys.stderr)
        failed.append(error)

    studies = []
    for file in files:  # all are read before the first is run
        try:
            studies.append(read_study(file, _with_folder(values, file) | options))
        except OpticalPalpationError as error:
            if not check:
                raise
            several(error)
    folders = [asked.folder.resolve() for asked in studies]
    for k, folder in enumerate(folders):
        if folder in folders[:k]:
            raise InputError(
                f"{studies[k].file}: has the same result folder as another study, {folder}"
            )
    for asked in studies:
        if len(files) > 1 and not (quiet or check):
            print(f"{asked.file}:", flush=True)
        try:
            if check:
                _check(asked, quiet)
            else:
                _run(asked, thickness_only, quiet)
        except OpticalPalpationError as error:
            several(error)
    if failed:
        kind = next((e for e in failed if not isinstance(e, ConvergenceError)), failed[0])
        raise type(kind)(f"{len(failed)} of {len(files)} studies failed, see above")


def _check(asked: Study, quiet: bool) -> None:
    from optical_palpation.palpation.plausibility import unusual_layer
    from optical_palpation.study import describe_inputs

    said = describe_inputs(asked)
    if not quiet:
        print(f"{asked.file}: can be run; {said}; results would go to {asked.folder}")
    for warning in unusual_layer(asked.material.make()):
        print(f"WARNING: {asked.file}, [material]: {warning}")


def _run(asked: Study, thickness_only: bool, quiet: bool) -> None:
    from optical_palpation import present, study
    from optical_palpation.palpation.plausibility import unusual_layer

    told = unusual_layer(asked.material.make())
    for warning in () if quiet else told:  # before minutes of work
        print(f"WARNING: {asked.file}, [material]: {warning}", flush=True)
    with ProgressDisplay(quiet) as progress:
        done = study.run_study(asked, thickness_only=thickness_only, progress=progress)
    if quiet:
        return
    warnings = done.warnings()
    if not thickness_only:
        for line in present.summarise(done.stress()).splitlines():
            # what is a warning in a study is told once
            if not any(text.startswith(line.removeprefix("WARNING: ")) for text in warnings):
                print(line)
    for warning in warnings:
        if warning in told:
            continue
        print(f"WARNING: {warning}")
    for name in done.files:
        print(f"{done.folder / name}{' (from an earlier run)' if name in done.earlier else ''}")


def _change(text: str) -> tuple[str, Any]:
    """Name and value of a ``--set``, the value as a study file would give it."""
    name, equals, value = text.partition("=")
    if not (equals and name.strip() and value.strip()):
        raise typer.BadParameter(f"--set takes KEY=VALUE, such as friction.window=0.2; not {text}")
    try:
        read = tomllib.loads(f"value = {value}")["value"]
    except (tomllib.TOMLDecodeError, KeyError):
        read = value.strip()  # text, for which a shell takes the quotes away
    if name.strip() == "title" and not isinstance(read, str):
        read = value.strip()
    return name.strip(), read


def _with_folder(values: dict[str, Any], file: Path) -> dict[str, Any]:
    """Give changed values a result folder that tells them, unless they name one."""
    if not values or "outputs.folder" in values:
        return dict(values)
    said = "-".join(f"{name}={value}" for name, value in values.items())
    safe = "".join(c if c.isalnum() or c in "=.-_," else "_" for c in said)
    if len(safe) > _LONGEST:  # what is cut off still tells one folder from another
        safe = f"{safe[: _LONGEST - 9]}-{hashlib.sha256(said.encode()).hexdigest()[:8]}"
    return values | {"outputs.folder": f"{file.stem}-{safe}-results"}
