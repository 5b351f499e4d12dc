"""The page: a table and the pictures of every part, in Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from optical_palpation.files import replacing
from optical_palpation.reproduce.record import load_part

PAGE = "index.md"
_INTRODUCTION = """\
# Validation

What the paper (Wijesinghe, Sampson and Kennedy, *J. R. Soc. Interface* **14**, 20160878, 2017) and
other sources say, and what this software finds. This page and its pictures are made by

```text
optical-palpation reproduce --output FOLDER --data FOLDER_OF_THIRD_PARTY_DATA
```

Units: mm, kPa, mN; stress negative where the layer is pressed, contact pressure positive.
"""
_QUICK = "**Made with `--quick`: the coarsest grids that run at all. The numbers say nothing.**"


def write_page(folder: Path, titles: Mapping[str, str], missing: Mapping[str, Exception]) -> Path:
    """Write the page of the parts that lie in a folder.

    Parameters
    ----------
    folder
        Folder of the parts' records and pictures.
    titles
        Titles of all parts by name, in the order of the page.
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
    parts = {name: load_part(name, folder) for name in titles}
    blocks = [_INTRODUCTION]
    if any(part and part["quick"] for part in parts.values()):
        blocks.append(_QUICK)
    for name, title in titles.items():
        part = parts[name]
        blocks.append(f"## {title}")
        if part is None:
            blocks.append(f"Not made: {missing.get(name, f'choose it by `--only {name}`')}.")
            continue
        if part["quick"]:
            blocks.append(_QUICK)
        blocks += [part["text"], _table(part["rows"])]
        blocks += [f"![{caption}]({file})\n\n*{caption}*" for file, caption in part["pictures"]]
        blocks.append(
            f"*`{name}`, version {part['software_version']}, {part['seconds']:.0f} s on "
            f"{part['processors']} processors ({part['processor']}).*"
        )
    path = folder / PAGE
    with replacing(path) as temporary:
        temporary.write_text("\n\n".join(block.strip() for block in blocks) + "\n", "utf-8")
    return path


def _table(rows: list[dict[str, str]]) -> str:
    lines = ["| where | what | there | here | why |", "| --- | --- | --- | --- | --- |"]
    for row in rows:
        cells = (row[key] for key in ("where", "statement", "reference", "ours", "why"))
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)
