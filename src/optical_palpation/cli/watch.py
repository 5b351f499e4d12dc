"""``optical-palpation watch``: the stress of each volume or map that arrives in a folder."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from optical_palpation.cli.options import Threads
from optical_palpation.cli.progress import ProgressDisplay


def watch(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where volumes or maps arrive.")],
    study: Annotated[
        Path,
        typer.Argument(
            metavar="STUDY",
            help="Study file (.toml) that says all but the loaded layer; each file that arrives "
            "takes the place of its loaded volume or map.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            help="Result folder; FOLDER-stress beside the watched one by default.",
            show_default=False,
        ),
    ] = None,
    pattern: Annotated[
        str, typer.Option(metavar="PATTERN", help="Names of the files that count.")
    ] = "*",
    settle: Annotated[
        float,
        typer.Option(
            metavar="SECONDS", help="A file is complete once it has not changed for so long.", min=0
        ),
    ] = 1.0,
    idle: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Stop once nothing has arrived for so long; Ctrl-C stops it anyhow.",
            min=0,
            show_default=False,
        ),
    ] = None,
    estimates: Annotated[
        bool,
        typer.Option(
            "--estimates",
            help="Also estimate the errors by mesh, sides and inputs, as run does; takes up to "
            "three times as long again.",
        ),
    ] = False,
    workers: Annotated[
        int,
        typer.Option(
            metavar="NUMBER",
            help="Processes that solve a file each, and share the cores: for many small maps.",
            min=1,
        ),
    ] = 1,
    threads: Threads = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print nothing but failures.")
    ] = False,
) -> None:
    """Compute the stress of each volume or map as it arrives in a folder, until Ctrl-C.

    Every file gets a result, FILE.stress.nc, and a row in arrived.csv. One that fails is told and
    does not stop the watch; it is tried again if it changes.
    """
    from optical_palpation.study.crew import Crew
    from optical_palpation.study.watch import TABLE, Watch

    watching = Watch(
        study,
        folder,
        output,
        pattern=pattern,
        settle=settle,
        estimates=estimates,
        threads=threads,
    )
    counts = {"done": 0, "failed": 0, "earlier": 0}

    def tell_all(crew: Crew) -> bool:
        """Print a line for each file that has been solved; whether there was one."""
        before = sum(counts.values())
        for arrival in crew.solved():
            counts[arrival.status] += 1
            _tell(arrival, quiet)
        return sum(counts.values()) > before

    try:
        started = time.monotonic()
        with ProgressDisplay(quiet) as progress:
            watching.prepare(progress)
        with Crew(watching, workers) as crew:
            if not quiet:
                ready = time.monotonic() - started
                print(f"watching {folder}, ready after {ready:.1f} s; Ctrl-C stops", flush=True)
            last = time.monotonic()
            while idle is None or crew.busy or time.monotonic() < last + idle:
                news = False
                for path in watching.arrived():
                    crew.solve(path)
                    news |= tell_all(crew)
                if tell_all(crew) or news or crew.busy:
                    last = time.monotonic()
                time.sleep(min(0.1, max(settle / 4, 0.02)))
    except KeyboardInterrupt:
        pass
    if not quiet:
        earlier = f", {counts['earlier']} by an earlier watch" if counts["earlier"] else ""
        print(f"{counts['done']} done{earlier}, {counts['failed']} failed")
        if sum(counts.values()):
            print(watching.output / TABLE)


def _tell(arrival: object, quiet: bool) -> None:
    from optical_palpation.present.terms import plain, rounded
    from optical_palpation.study.watch import Arrival

    assert isinstance(arrival, Arrival)
    if arrival.status == "failed":
        print(f"{arrival.file}: failed: {arrival.message}", flush=True)
    elif not quiet:
        row = arrival.row
        force, mean = (rounded(row[key]) for key in ("sample_force_mN", "mean_axial_stress_kPa"))
        said = plain(f"{arrival.file}: force {force} mN, mean axial stress {mean} kPa")
        took = " (earlier)" if arrival.status == "earlier" else f", {arrival.seconds:.2f} s"
        print(said + took, flush=True)
        if row.get("warnings"):
            print(f"WARNING: {arrival.file}: {row['warnings']}", flush=True)
