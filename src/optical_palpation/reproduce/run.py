"""Making the parts, skipping what is done, and the page of them all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from optical_palpation.errors import ConvergenceError, InputError, OutputError
from optical_palpation.reproduce.experiments import columns, cube, sinusoid
from optical_palpation.reproduce.friction import friction
from optical_palpation.reproduce.layers import coin, independent_code
from optical_palpation.reproduce.material import material, phase
from optical_palpation.reproduce.page import write_page
from optical_palpation.reproduce.record import Part, Setting, load_part, run_part
from optical_palpation.reproduce.resolution import resolution
from optical_palpation.reproduce.total_stress import total_stress
from optical_palpation.runtime import software_version


@dataclass(frozen=True)
class _Chapter:
    title: str
    make: Callable[[Setting], Part]


_CHAPTERS = {
    "material": _Chapter("The layer's material", material),
    "friction": _Chapter("Friction from displacement profiles", friction),
    "total-stress": _Chapter("Total stress of a flat layer", total_stress),
    "sinusoid": _Chapter("Virtual experiment: five ridges", sinusoid),
    "columns": _Chapter("Virtual experiment: a soft and a stiff column", columns),
    "cube": _Chapter("Virtual experiment: a stiff cube", cube),
    "resolution": _Chapter("Lateral resolution", resolution),
    "coin": _Chapter("A coin", coin),
    "independent-code": _Chapter("An independent code", independent_code),
    "phase": _Chapter("Strain from phase", phase),
}
#: Names of the parts, in the order of the page.
PARTS = tuple(_CHAPTERS)


def reproduce(
    folder: str | Path,
    *,
    only: Sequence[str] = (),
    data: str | Path | None = None,
    quick: bool = False,
    again: bool = False,
    threads: int | None = None,
    tell: Callable[[str, float, str], None] | None = None,
) -> tuple[Path, dict[str, InputError | ConvergenceError]]:
    """Make the validation page, or the parts of it that are not made yet.

    Parameters
    ----------
    folder
        Where page, pictures and the parts' records go; made if need be. Parts that are there
        already, made by this version and with the same `quick`, are kept.
    only
        Names of the parts to make; all by default. The page shows the others as they are.
    data
        Folder of third-party data; without it the parts that need them are left out.
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
    page : pathlib.Path
    missing : dict
        Why parts that were asked for could not be made, by name.

    Raises
    ------
    InputError
        If there is no such part, or no such folder of data.
    OutputError
        If the folder cannot be written.
    """
    if unknown := [name for name in only if name not in _CHAPTERS]:
        raise InputError(f"no part {', '.join(unknown)}; the parts are {', '.join(PARTS)}")
    if data is not None and not Path(data).is_dir():
        raise InputError(f"{data}: there is no such folder of third-party data")
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{folder}: the folder cannot be made ({reason})") from error
    titles = {name: chapter.title for name, chapter in _CHAPTERS.items()}
    missing: dict[str, InputError | ConvergenceError] = {}
    for name in only or PARTS:
        known = load_part(name, folder)
        current = known is not None and (
            known["quick"] == quick and known["software_version"] == software_version()
        )
        if current and not again:
            continue

        def say(share: float, what: str, name: str = name) -> None:
            if tell:
                tell(name, share, what)

        setting = Setting(folder, quick, Path(data) if data else None, say, threads)
        say(0.0, "starts")
        try:
            run_part(name, _CHAPTERS[name].make, setting)
        except (InputError, ConvergenceError) as failure:
            missing[name] = failure
        write_page(folder, titles, missing)  # as far as it goes, should the rest be interrupted
    return write_page(folder, titles, missing), missing
