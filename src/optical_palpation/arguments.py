"""Checks of arguments: errors name the argument, its right type, and what was given."""

from __future__ import annotations

import difflib
import functools
import inspect
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Set
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from optical_palpation.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")

_SHOWN = 60  # characters of a value

#: Coefficient of friction that no interface exceeds; a layer that cannot slip is glued.
LARGEST_FRICTION = 2.0


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


def toml_fault(error: Exception, text: str) -> str:
    """Say what the parser found wrong with a text in TOML, on which line, and what may be meant."""
    # names of tables are tuples to the parser
    said = re.sub(
        r"\(((?:'[^']*',? ?)+)\)",
        lambda it: "[" + ".".join(re.findall("'([^']*)'", it[1])) + "]",
        str(error),
    )
    found = re.search(r"line (\d+)", said)
    line = text.split("\n")[int(found[1]) - 1].strip() if found else ""
    hints = {
        r'=.*"[^"]*\\': "write / for \\ in a path",
        r"=[\s\[]*-?\d+,\d": "decimals have a point",
        r"=\s*(?!true|false|nan|inf)[A-Za-z./~]": "text stands in quotes",
    }
    hint = next((f" ({hint})" for sign, hint in hints.items() if re.search(sign, line)), "")
    return said + (f": {line[:80]}{hint}" if line else "")


def numbers(value: object, count: int, name: str, what: str) -> tuple[float, ...]:
    """Return so many finite numbers as floats.

    Raises
    ------
    InputError
        If they are no such numbers.
    """
    try:
        if isinstance(value, str | bytes | Mapping | Set):
            raise TypeError
        found = tuple(number(part, name, what) for part in value)  # type: ignore[attr-defined]
    except (TypeError, InputError):
        found = ()
    if len(found) != count:
        raise InputError(f"{name}: {what}, not {in_words(value)}")
    return found


def choice(value: object, name: str, *known: str) -> str:
    """Return one of some words.

    Raises
    ------
    InputError
        If it is none of them.
    """
    if isinstance(value, str) and value in known:
        return value
    *others, last = (repr(word) for word in known)
    raise InputError(f"{name}: {', '.join(others)} or {last}, not {in_words(value)}")


def flag(value: object, name: str) -> bool:
    """Return True or False.

    Raises
    ------
    InputError
        If it is neither.
    """
    if isinstance(value, bool) or type(value).__name__ in ("bool_", "bool"):
        return bool(value)
    raise InputError(f"{name}: True or False, not {in_words(value)}")


def explained(function: Callable[P, R]) -> Callable[P, R]:
    """Make a call that does not fit a function an error that says how it is called.

    The function is called as ever; the error names what is missing or unknown, and the types of
    what must be given.
    """
    signature = inspect.signature(function)
    name = function.__qualname__.removesuffix(".__init__")
    known = [p for p in signature.parameters.values() if p.name not in ("self", "cls")]
    others = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    needed = [p for p in known if p.default is p.empty and p.kind not in others]

    def unknown(given: Iterable[str]) -> str:
        if any(p.kind is p.VAR_KEYWORD for p in known):
            return ""
        free = [p.name for p in known if p.name not in given]
        for word in given:
            if word not in signature.parameters:
                near = difflib.get_close_matches(word, free, 1)
                hint = f"; did you mean {near[0]}?" if near else "."
                return f"there is no argument {word!r}{hint}"
        return ""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            signature.bind(*args, **kwargs)
        except TypeError as error:
            problem = unknown(kwargs) or f"{error}."
            needs = ", ".join(str(p).replace("'", "") for p in needed)
            raise InputError(f"{name}: {problem} It needs ({needs})") from None
        return function(*args, **kwargs)

    return call


def explained_fields(kind: type[R]) -> type[R]:
    """Make a dataclass whose arguments do not fit say how it is made (:func:`explained`)."""
    kind.__init__ = explained(kind.__init__)  # type: ignore[misc, method-assign]
    return kind
