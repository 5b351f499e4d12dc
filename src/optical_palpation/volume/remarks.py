"""Units of length in the comments of a table: which are those of the thickness."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from .units import length_unit, split_unit

_LONGEST = 1000  # characters of a comment that are searched
_NAME = re.compile(r"\s*name:\s*(\S+)", re.IGNORECASE)  # of Octave: # name: L1_um
# Units that numbers have and a thickness in a file has not, if nothing else is meant by the word.
_NO_LENGTH = r"(?:px|pix|pixels?|voxels?|inch|inches|mils?|å|angstroms?)"
# Anything after "unit:", else a unit of length.
_UNIT = re.compile(
    r"(?:(?<![a-z])units?|\b\w*einheit(?:en)?)(?![a-z])[^:=,;]{0,40}[:=]\s*"
    r"(?P<said>(?!(?:[xyz]|lateral|axial)\b)[^\s,;0-9=]+)(?![^\s,;])"
    r"|(?<![\w-])(?P<length>[munc]m|[µμ]m|microns?|(?:milli|micro|nano|centi)met(?:er|re)s?"
    r"|(?<=[\[(])m(?=[\])])|(?<=\bin )m"
    rf"|(?<=[\[(]){_NO_LENGTH}(?=[\])])|(?<=\bin ){_NO_LENGTH})(?![\w-])",
    re.IGNORECASE,
)
_NUMBER_BEFORE = re.compile(r"(?<![\w.])[-+]?\.?[0-9][0-9.e+-]*\s*/?\s*$", re.IGNORECASE)  # 1/mm
_NUMBER_AFTER = re.compile(r"\s*[)\]]*\s*[:=]\s*[-+]?\.?[0-9]")
_PER = re.compile(r"\s*[)\]]?\s*(?:/|\^|²|per\b)", re.IGNORECASE)  # mm/s, mm per count
_SCALE = re.compile(r"\b(?:scale|scaling|factor|counts?|digits?|units?)\b", re.IGNORECASE)
_QUANTITY = re.compile(
    r"\b(?:(?P<thickness>z|axial|thickness(?:es)?|depths?|heights?|values?|data|maps?|lengths"
    r"|l_?[01]|\w*dicken?|höhen?|werte)"
    r"|(?P<lateral>[xy]|xy|lateral|(?<!each )(?<!every )(?<!per )pixels?|spacing|pitch|steps?|width"
    r"|field|fov|view|positions?|coordinates?)"
    r"|(?P<other>wavelengths?|radius|radii|diameters?|indenter|resolution|speed|velocity|stage"
    r"|motor|travel|displacement|compression|indentation|bandwidth|precision|accuracy|noise|std"
    r"|uncertainty|laser|source|objective|lens|focal|focus|aperture|coherence))\b",
    re.IGNORECASE,
)
_FILLER = re.compile(r"\b(?:units?|\w*einheit(?:en)?|of|all|in|is|are)\b|[\W_]", re.IGNORECASE)


def units_of_remarks(remarks: Iterable[str]) -> tuple[set[str], dict[str, str]]:
    """Units that comments state for the thickness, and those that may be of something else.

    A unit belongs to the quantity named last before it in its clause. One of another quantity (a
    wavelength, the radius of the indenter) says nothing, nor does that of an amount (``500 um``).

    Returns
    -------
    set of str
        Units of the thickness, some perhaps unknown.
    dict
        Other units than mm of which it is unclear whether they are those of the thickness, with
        the comment that has them.
    """
    stated: set[str] = set()
    unclear: dict[str, str] = {}
    for remark in remarks:
        if named := _NAME.match(remark):
            if unit_of_name := split_unit(named[1])[1]:
                stated.add(unit_of_name)
            continue
        for clause in re.split(r";|\.\s", remark[:_LONGEST].replace("_", " ")):
            for unit, kind in _units(clause):
                if kind == "thickness":
                    stated.add(unit)
                elif length_unit(unit) != "mm" and (
                    kind == "unclear" or (kind == "lateral" and length_unit(unit))
                ):
                    unclear[unit] = remark.strip()
    return stated, unclear


def unclear_unit(path: Path, unclear: Mapping[str, str]) -> str:
    """Say that the thickness may have the unit of a comment, or not; `unclear` has at least one."""
    unit, said = next(iter(unclear.items()))
    return (
        f"{path}: {said[:80]!r} states {unit}, perhaps for the positions only or for something "
        "else; give length_unit, the unit of the thickness"
    )


def _units(clause: str) -> Iterator[tuple[str, str]]:
    """Units of a clause, each with what it is of."""
    matches = list(_UNIT.finditer(clause))
    bounds = [0, *(match.end() for match in matches)]
    starts = [*(match.start() for match in matches[1:]), len(clause)]
    for match, start, end in zip(matches, bounds, starts, strict=False):
        group = str(match.lastgroup)
        before, after = clause[start : match.start(group)], clause[match.end() : end]
        unit = match[group].strip(".()[]")
        if _NUMBER_BEFORE.search(before) or (group == "length" and _PER.match(after)):
            # The values may be counts: 1 count = 0.5 um
            yield (f"{unit} per unit", "unclear") if _SCALE.search(clause) else (unit, "other")
            continue
        kind = _kind(before, after)
        if _NUMBER_AFTER.match(after) and kind != "lateral":
            unknown = kind == "unclear" and not _QUANTITY.search(before)
            kind = "other" if kind == "other" or unknown else "unclear"
        yield unit, kind


def _kind(before: str, after: str) -> str:
    """What the words around a unit are about: thickness, lateral, other or unclear."""
    found = list(_QUANTITY.finditer(before)) or list(_QUANTITY.finditer(after))[:1]
    if not found:
        return "unclear" if _FILLER.sub("", before + after) else "thickness"
    kinds = [str(match.lastgroup) for match in found]
    others = [match for match in found if match.lastgroup != "thickness"]
    if kinds[-1] == "thickness" and others:  # the resolution of the map
        between = before[others[-1].end() : found[-1].start()]
        return "unclear" if re.search(r"\bof\b", between) else "thickness"
    if kinds[-1] == "lateral" and "thickness" in kinds:
        return "unclear"
    return kinds[-1]
