"""Making the parts, skipping what is done, and the pages of them all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from optical_palpation.errors import ConvergenceError, InputError, OutputError
from optical_palpation.reproduce.experiments import columns, cube, sinusoid
from optical_palpation.reproduce.friction import friction
from optical_palpation.reproduce.layers import coin, independent_code
from optical_palpation.reproduce.material import material, phase
from optical_palpation.reproduce.page import Chapter, Page, write_page
from optical_palpation.reproduce.record import Setting, load_part, run_part
from optical_palpation.reproduce.resolution import resolution
from optical_palpation.reproduce.soft_samples import soft_samples
from optical_palpation.reproduce.total_stress import total_stress
from optical_palpation.reproduce.verification import VERIFICATION
from optical_palpation.runtime import software_version

_VALIDATION = Page(
    name="validation",
    introduction="""\
# Validation

What the paper (Wijesinghe, Sampson and Kennedy, *J. R. Soc. Interface* **14**, 20160878, 2017) and
other sources say, and what this software finds. This page and its pictures are made by

```text
optical-palpation reproduce --only validation --output FOLDER --data FOLDER_OF_THIRD_PARTY_DATA
```

With `--check` the same command changes nothing and compares every number with a fresh run, but for
computing times: within 1 %, or a point of a percentage; the exit status is 5 if one differs.

Units: mm, kPa, mN; stress negative where the layer is pressed, contact pressure positive.
""",
    columns=("source", "quantity", "published", "ours", "remarks"),
    chapters={
        "material": Chapter("The layer's material", material),
        "friction": Chapter("Friction from displacement profiles", friction),
        "total-stress": Chapter("Total stress of a flat layer", total_stress),
        "sinusoid": Chapter("Virtual experiment: five ridges", sinusoid),
        "columns": Chapter("Virtual experiment: a soft and a stiff column", columns),
        "cube": Chapter("Virtual experiment: a stiff cube", cube),
        "soft-samples": Chapter("Soft samples of unknown motion", soft_samples),
        "resolution": Chapter("Lateral resolution", resolution),
        "coin": Chapter("A coin", coin),
        "independent-code": Chapter("An independent code", independent_code),
        "phase": Chapter("Strain from phase", phase),
    },
)
#: The pages and the parts of each, in order.
PAGES = (_VALIDATION, VERIFICATION)


def reproduce(
    folder: str | Path,
    *,
    only: Sequence[str] = (),
    data: str | Path | None = None,
    references: str | Path | None = None,
    quick: bool = False,
    again: bool = False,
    threads: int | None = None,
    tell: Callable[[str, float, str], None] | None = None,
) -> tuple[list[Path], dict[str, InputError | ConvergenceError]]:
    """Make the pages, or the parts of them that are not made yet.

    Parameters
    ----------
    folder
        Where the pages go, and beside each, in a folder of its name, its pictures and its parts'
        records; made if need be. Parts that are there already, made by this version and with the
        same `quick`, are kept.
    only
        Names of the pages and parts to make; all by default. A page shows its other parts as they
        are.
    data
        Folder of third-party data; without it the parts that need them are left out.
    references
        Folder of the references by independent codes, as ``tests/data/references`` of the
        repository; without it the parts that need them are left out.
    quick
        Use the coarsest grids that run at all: shows that everything runs, and nothing else.
    again
        Make parts anew even if they are there.
    threads
        Number of threads; all by default.
    tell
        Called with the part's name, the share of it that is done, and what comes next.

    Returns
    -------
    pages : list of pathlib.Path
        The pages on which there is something new or asked for.
    missing : dict
        Why parts that were asked for could not be made, by name.

    Raises
    ------
    InputError
        If there is no such page or part, or no such folder of data.
    OutputError
        If the folder cannot be written.
    """
    names = {page.name: tuple(page.chapters) for page in PAGES}
    known_names = {*names, *(name for parts in names.values() for name in parts)}
    if unknown := [name for name in only if name not in known_names]:
        raise InputError(
            f"no part {', '.join(unknown)}; the pages and their parts are "
            + "; ".join(f"{page}: {', '.join(parts)}" for page, parts in names.items())
        )
    if data is not None and not Path(data).is_dir():
        raise InputError(f"{data}: there is no such folder of third-party data")
    if references is not None and not Path(references).is_dir():
        raise InputError(f"{references}: there is no such folder of references")
    folder = Path(folder)
    written: list[Path] = []
    missing: dict[str, InputError | ConvergenceError] = {}
    for page in PAGES:
        wanted = [name for name in page.chapters if not only or name in only or page.name in only]
        if not wanted:
            continue
        try:
            (folder / page.name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = error.strerror or error
            raise OutputError(f"{folder}: the folder cannot be made ({reason})") from error
        for name in wanted:
            known = load_part(name, folder / page.name)
            current = known is not None and (
                known["quick"] == quick and known["software_version"] == software_version()
            )
            if again or not current:
                setting = Setting(
                    folder / page.name,
                    quick,
                    Path(data) if data else None,
                    partial(tell or _silent, name),
                    threads,
                    Path(references) if references else None,
                )
                setting.tell(0.0, "starts")
                try:
                    run_part(name, page.chapters[name].make, setting)
                except (InputError, ConvergenceError) as failure:
                    missing[name] = failure
            path = write_page(folder, page, missing)  # should the rest be interrupted
        written.append(path)
    return written, missing


def _silent(part: str, share: float, what: str) -> None:
    """Report nothing."""
