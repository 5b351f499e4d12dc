"""Checks of arguments: errors name the argument, its right type, and what was given."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

from optical_palpation.errors import InputError

_SHOWN = 60  # characters of a value


def check_instance(value: object, kinds: Any, name: str, what: str) -> None:
    """Refuse a value that is of none of some types.

    Parameters
    ----------
    value
        What was given.
    kinds
        Types, as :func:`isinstance` takes them.
    name
        Of the argument.
    what
        The right type in words, and how to come by one.

    Raises
    ------
    InputError
        If it is of another type.
    """
    if not isinstance(value, kinds):
        raise InputError(f"{name}: {what}, not {in_words(value)}")


def number(value: object, name: str, what: str = "a number") -> float:
    """Return a finite number as a float; text is none.

    Raises
    ------
    InputError
        If it is no such number.
    """
    try:
        if isinstance(value, str | bytes | bool):
            raise TypeError
        found = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        found = math.nan
    if not math.isfinite(found):
        raise InputError(f"{name}: {what}, not {in_words(value)}")
    return found


def file_path(value: object, name: str = "path") -> Path:
    """Return the name of a file as a path.

    Raises
    ------
    InputError
        If it is no name.
    """
    check_instance(value, (str, os.PathLike), name, "the name of a file")
    return Path(os.fsdecode(value))  # type: ignore[arg-type]


def in_words(value: object) -> str:
    """Type and beginning of a value, for an error."""
    text = " ".join(repr(value).split())
    shown = text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
    kind = type(value).__name__
    return "None" if value is None else shown if isinstance(value, str) else f"{kind} {shown}"
