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
_DIMENSIONS |= {"pixel": "x", "pixels": "x", "sample": "x", "samples": "x", "line": "y"}
_DIMENSIONS |= {"lines": "y", "ascan": "x", "ascans": "x", "bscan": "y", "bscans": "y"}
# What stands before or after an axis in one word, such as nx, xdim, xc and nrows.
_BEFORE = "n|num|i|idx|index|dim|pos|coord|axis|pix|pixel|scan|lateral"
_AFTER = (
    "s|c|dim|pos|position|coord|coordinate|axis|axes|pix|pixel|pixels|px|size|grid|dir|idx|index|"
    "scan|lateral"
)
_LETTER = re.compile(rf"(?:{_BEFORE})?(?P<axis>[xyz])(?:{_AFTER}|(?P=axis))?")
_COUNTED = re.compile(r"n(?P<axis>columns?|cols?|rows?|lines?|samples?|pixels?)")


def axes_of_dimensions(names: Sequence[str]) -> list[str | None]:
    """Return the axis that each dimension is: ``"x"``, ``"y"`` or ``"z"``; None if nothing says it.

    Names that differ in an ``x`` and a ``y`` only, or in what stands for them, are this pair.
    Otherwise it is said by a word of a name, such as ``x`` in ``scan_x``, or by an ``x`` with the
    usual letters before or after it, such as ``nx``.
    """
    axes = [_axis_by_words(name) for name in names]
    plain = ["".join(SYNONYMS.get(w, _DIMENSIONS.get(w, w)) for w in _words(n)) for n in names]
    for (a, first), (b, second) in permutations(enumerate(plain), 2):
        if len(first) == len(second):
            differ = {(p, q) for p, q in zip(first, second, strict=True) if p != q}
            if differ in ({("x", "y")}, {("x", "z")}, {("y", "z")}):
                ((axes[a], axes[b]),) = differ
    return axes


def axes_of_text(said: Sequence[str]) -> str:
    """Return the axes that a text such as ``"yx"``, ``"y, x"`` or ``"y:x"``, or a list, names.

    What is not understood comes as it is, names separated by commas.
    """
    names = [n for text in said for n in re.split(r"[\s,:;|]+", text.strip(" []()")) if n]
    if len(names) == 1 and set(names[0].lower()) <= set("zyx"):
        return names[0].lower()
    axes = axes_of_dimensions(names)
    return "".join(filter(None, axes)) if all(axes) else ",".join(names)


def _axis_by_words(name: str) -> str | None:
    words = _words(name)
    letters = {match["axis"] for word in words if (match := _LETTER.fullmatch(word))}
    others = {SYNONYMS.get(word) or _DIMENSIONS.get(word) for word in words} - {None}
    found = letters or others
    return found.pop() if len(found) == 1 else None


def _words(name: str) -> list[str]:
    stem = split_unit(name.rpartition("/")[2])[0]
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", stem).lower()
    words = [word for word in re.split(r"[^a-z]+", apart) if word]
    return [match["axis"] if (match := _COUNTED.fullmatch(word)) else word for word in words]
