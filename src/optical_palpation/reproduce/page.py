"""A page: a table and the pictures of every part, in Markdown."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from optical_palpation.files import replacing
from optical_palpation.reproduce.record import Part, Setting, load_part

_QUICK = "**Made with `--quick`: the coarsest grids that run at all. The numbers say nothing.**"


@dataclass(frozen=True)
class Chapter:
    """A part of a page: its title, and what makes it."""

    title: str
    make: Callable[[Setting], Part]


@dataclass(frozen=True)
class Page:
    """A page of the folder, ``NAME.md``; its records and pictures lie in ``NAME/`` beside it.

    ``columns`` heads the five columns of its tables; ``chapters`` are its parts by name, in order.
    """

    name: str
    introduction: str
    columns: tuple[str, str, str, str, str]
    chapters: Mapping[str, Chapter]


def write_page(folder: Path, page: Page, missing: Mapping[str, Exception]) -> Path:
    """Write a page of the parts that are made.

    Parameters
    ----------
    folder
        Folder of the pages.
    page
        Which page.
    missing
        Why a part was not made, by name.

    Returns
    -------
    pathlib.Path
        The page.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    path = folder / f"{page.name}.md"
    with replacing(path) as temporary:
        temporary.write_text(page_text(folder, page, missing), "utf-8")
    return path


def page_text(folder: Path, page: Page, missing: Mapping[str, Exception]) -> str:
    """Return what a page says; the parameters are those of :func:`write_page`."""
    parts = {name: load_part(name, folder / page.name) for name in page.chapters}
    blocks = [page.introduction]
    if any(part and part["quick"] for part in parts.values()):
        blocks.append(_QUICK)
    for name, chapter in page.chapters.items():
        part = parts[name]
        blocks.append(f"## {chapter.title}")
        if part is None:
            blocks.append(f"Not made: {missing.get(name, f'choose it by `--only {name}`')}.")
            continue
        if part["quick"]:
            blocks.append(_QUICK)
        blocks += [part["text"], _table(page.columns, part["rows"])]
        blocks += [
            f"![{caption}]({page.name}/{file})\n\n*{caption}*" for file, caption in part["pictures"]
        ]
        blocks.append(
            f"*`{name}`, version {part['software_version']}, {part['seconds']:.0f} s on "
            f"{part['processors']} processors ({part['processor']}).*"
        )
    return "\n\n".join(block.strip() for block in blocks) + "\n"


def _table(columns: tuple[str, ...], rows: list[dict[str, str]]) -> str:
    lines = [f"| {' | '.join(columns)} |", "| --- | --- | --- | --- | --- |"]
    for row in rows:
        cells = (row[key] for key in ("where", "statement", "reference", "ours", "why"))
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)
