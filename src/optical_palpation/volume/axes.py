"""Names of axes, as programs give them to the dimensions of arrays."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import permutations

from .units import split_unit

#: What else axes are called, by a name or a word of it.
SYNONYMS = {"column": "x", "columns": "x", "col": "x", "cols": "x", "row": "y", "rows": "y"}
SYNONYMS |= {"lon": "x", "longitude": "x", "easting": "x"}
SYNONYMS |= {"lat": "y", "latitude": "y", "northing": "y"}
#: The same of dimensions only: a variable of this name may hold anything.
_DIMENSIONS = {"width": "x", "height": "y", "depth": "z", "axial": "z"}
_DIMENSIONS |= {"pixel": "x", "pixels": "x", "sample": "x", "samples": "x", "ascan": "x"}
_DIMENSIONS |= {"ascans": "x", "aline": "x", "alines": "x", "bscan": "y", "bscans": "y"}
_DIMENSIONS |= {"bline": "y", "blines": "y", "frame": "y", "frames": "y"}
_OF_WORDS = SYNONYMS | _DIMENSIONS
# Rows of an image, or the A-lines of a B-scan: the other axis tells.
_LINES = {"line", "lines"}
_SCAN = re.compile(r"(?<![a-z])(n?[ab])[\W_]?((?:line|scan)s?)(?![a-z])")  # A-line, n_b_scans
# What stands before or after an axis in one word, such as nx, xdim, xc and nrows.
_BEFORE = "n|num|i|idx|index|dim|pos|coord|axis|pix|pixel|scan|lateral"
_AFTER = (
    "s|c|dim|pos|position|coord|coordinate|axis|axes|pix|pixel|pixels|px|size|grid|dir|idx|index|"
    "scan|lateral"
)
_LETTER = re.compile(rf"(?:{_BEFORE})?(?P<axis>[xyz])(?:{_AFTER}|(?P=axis))?")
_COUNTED = re.compile(
    r"n(?P<axis>columns?|cols?|rows?|[ab]?lines?|[ab]scans?|frames?|samples?|pixels?)"
)


def axes_of_dimensions(names: Sequence[str]) -> list[str | None]:
    """Return the axis that each dimension is: ``"x"``, ``"y"`` or ``"z"``; None if nothing says it.

    Names that differ in an ``x`` and a ``y`` only, or in what stands for them, are this pair.
    Otherwise it is said by a word of a name, such as ``x`` in ``scan_x``, or by an ``x`` with the
    usual letters before or after it, such as ``nx``. A-lines follow each other along x, frames and
    B-scans along y. Lines are the other one of x and y.
    """
    axes = _axes_by_words(names)
    plain = ["".join(_OF_WORDS.get(word, word) for word in _words(name)) for name in names]
    for (a, first), (b, second) in permutations(enumerate(plain), 2):
        if len(first) == len(second):
            differ = {(p, q) for p, q in zip(first, second, strict=True) if p != q}
            if differ in ({("x", "y")}, {("x", "z")}, {("y", "z")}):
                ((axes[a], axes[b]),) = differ
    return axes


def unclear_dimension(names: Sequence[str]) -> str | None:
    """Return the first name that may be of x as well as of y, None if there is none."""
    for name, axis in zip(names, axes_of_dimensions(names), strict=True):
        if axis is None and (_LINES.intersection(_words(name)) or len(_said(name)) > 1):
            return name
    return None


def axes_of_text(said: Sequence[str]) -> str:
    """Return the axes that a text such as ``"yx"``, ``"y, x"`` or ``"y:x"``, or a list, names.

    What is not understood comes as it is, names separated by commas.
    """
    names = [n for text in said for n in re.split(r"[\s,:;|]+", text.strip(" []()")) if n]
    if len(names) == 1 and set(names[0].lower()) <= set("zyx"):
        return names[0].lower()
    axes = axes_of_dimensions(names)
    return "".join(filter(None, axes)) if all(axes) else ",".join(names)


def _axes_by_words(names: Sequence[str]) -> list[str | None]:
    said = [_said(name) for name in names]
    axes = [next(iter(found)) if len(found) == 1 else None for found in said]
    lateral = {axis for axis in axes if axis in ("x", "y")}
    for number, name in enumerate(names):
        if not said[number] and len(lateral) == 1 and _LINES.intersection(_words(name)):
            axes[number] = "y" if lateral == {"x"} else "x"
    return axes


def _said(name: str) -> set[str]:
    """Axes that the words of a name are of."""
    words = _words(name)
    letters = {match["axis"] for word in words if (match := _LETTER.fullmatch(word))}
    return letters or {found for word in words if (found := _OF_WORDS.get(word))}


def _words(name: str) -> list[str]:
    stem = split_unit(name.rpartition("/")[2])[0]
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", stem).lower()
    words = [word for word in re.split(r"[^a-z]+", _SCAN.sub(r"\1\2", apart)) if word]
    return [match["axis"] if (match := _COUNTED.fullmatch(word)) else word for word in words]
