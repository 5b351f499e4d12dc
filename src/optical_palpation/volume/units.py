"""Units of length in files: in the names of variables, in attributes, in words."""

from __future__ import annotations

import re
from collections.abc import Mapping

from ..errors import InputError

#: mm per unit.
MM = {"m": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3, "nm": 1e-6}
_WORDS = {"meter": "m", "centimeter": "cm", "millimeter": "mm", "micrometer": "um"}
_WORDS |= {"micron": "um", "nanometer": "nm"}
_KNOWN = "m, cm, mm, um and nm"
# A bare m at the end of a name is more often a mean or a mask than a metre.
_SUFFIX = re.compile(
    r"(?P<stem>.*?)(?:[_\s.-]+|(?=[(\[]))[(\[]?"
    r"(?P<unit>[munc]m|microns?|(?:milli|micro|nano|centi)?met(?:er|re)s?)[)\]]?",
    re.IGNORECASE,
)
# L1um and thicknessUm, but no datum
_JOINED = re.compile(
    r"(?P<stem>.*(?:[0-9](?=[munc])|[a-z0-9](?=[MUNC])))"
    r"(?P<unit>[MUNCmunc]m|Microns?|(?:Milli|Micro|Nano)met(?:er|re)s?)"
)
# What else a name may end with: its numbers are no lengths, or need a factor.
_NO_LENGTH = re.compile(
    r".*[_\s.(\[-](?P<unit>px|pix|pixels?|voxels?|inch|inches|mils?|[kmg]?pa|percent)[)\]]?",
    re.IGNORECASE,
)
_KEY = re.compile(r"(?:(?:length|thickness|value|data|map|z)[ _]?)?units?(?:[ _]of[ _]length)?")
_IN_WORDS = ("long_name", "description")


def length_unit(text: str) -> str | None:
    """Return the unit of length, a key of ``MM``, that a text names, or None."""
    word = text.strip().strip("()[]").lower().replace("metre", "meter")
    for micro in ("\\u00b5", "\u00b5", "\u03bc"):  # the first is how ImageJ writes it
        word = word.replace(micro, "u")
    word = word if word in MM else word.removesuffix("s")
    word = _WORDS.get(word, word)
    return word if word in MM else None


def to_mm(value: float, unit: str, where: str) -> float:
    """Convert a length to mm."""
    known = length_unit(unit)
    if known is None:
        raise InputError(f"{where}: unknown unit of length {unit!r}; known are {_KNOWN}")
    return float(value) * MM[known]


def split_unit(name: str) -> tuple[str, str | None]:
    """Split a name like ``x_um`` or ``depth (microns)`` into what it names and its unit."""
    plain = name.strip().replace("\u00b5", "u").replace("\u03bc", "u")
    match = _SUFFIX.fullmatch(plain) or _JOINED.fullmatch(plain)
    return (match["stem"], length_unit(match["unit"])) if match else (name.strip(), None)


def unit_in_words(text: str) -> tuple[str, str | None]:
    """``split_unit`` of words, which may have the unit behind a solidus: ``thickness / um``."""
    words, solidus, last = text.rpartition("/")
    words = words.rstrip()
    unit = length_unit(last) if solidus else None
    quantity = re.search(r"[^\W_]*[^\W\d_][^\W_]*[)\]]?$", words)  # neither 1/mm nor um/mm
    if unit and quantity and not length_unit(quantity[0]):
        return words, unit
    return split_unit(text)


def stated_unit(
    name: str, attrs: Mapping[str, object], where: str, given: str | None = None
) -> str | None:
    """Return the unit of length that name, attributes and user agree on; None if none says one.

    Raises
    ------
    InputError
        If they contradict each other, or one of them is no unit of length.
    """
    stated = {}
    if other := _NO_LENGTH.fullmatch(name):
        raise InputError(
            f"{where}: its name ends with {other['unit']!r}; known units of length are {_KNOWN}"
        )
    suffix = split_unit(name)[1]
    if suffix:
        stated["its name"] = suffix
    for key in _IN_WORDS:  # "thickness (um)", but not "under a travel of 2 mm"
        words, unit = unit_in_words(str(attrs.get(key, "")))
        if unit and not words[-1:].isdigit():
            stated[f"its {key} attribute"] = unit
    texts = {f"its {key} attribute": str(attrs[key]) for key in attrs if is_unit_key(key)}
    if given is not None:
        texts["length_unit"] = given
    for origin, text in texts.items():
        unit = length_unit(text)
        if unit is None:
            raise InputError(f"{where}: {origin} is {text!r}; known units of length are {_KNOWN}")
        stated[origin] = unit
    if len(set(stated.values())) > 1:
        says = ", ".join(f"{origin} says {unit}" for origin, unit in stated.items())
        raise InputError(f"{where}: contradicting units of length: {says}")
    return next(iter(stated.values()), None)


def is_unit_key(key: str | bytes) -> bool:
    """Tell whether an attribute or a text beside an array states its unit."""
    # HDF5 has bytes for a name that is no text.
    return isinstance(key, str) and _KEY.fullmatch(key.lower()) is not None
