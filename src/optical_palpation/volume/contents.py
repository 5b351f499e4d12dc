"""What a file holds: its arrays, unread, and what it says about them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..errors import InputError
from .arrays import Array, View
from .metadata import Access, Stated
from .units import is_unit_key


@dataclass(frozen=True)
class Variable:
    """One array of a file.

    Attributes
    ----------
    shape, dtype
        As its author saw them: MATLAB's order of axes is undone, scale and offset are applied.
    open
        Gives the samples, which are read by slices. Missing ones are NaN. Raises an InputError
        where they cannot be read.
    access
        How the samples are reached; None where `open` has to tell: mapped or loaded.
    dims
        Names of its axes, empty where the file has none, or for a single axis that has none.
    attrs
        Its attributes, without those that `open` has applied.
    stated
        What the file says about it as a volume.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    open: Callable[[], Array]
    access: Access | None = "mapped"
    dims: tuple[str, ...] = ()
    attrs: Mapping[str, object] = field(default_factory=dict)
    stated: Stated = field(default_factory=Stated)

    def as_map(self) -> Variable:
        """Leave out axes of length one, of time or a band, where two others remain."""
        kept = tuple(axis for axis, n in enumerate(self.shape) if n != 1)
        if len(self.shape) <= 2 or len(kept) != 2:
            return self

        def of_kept(values: Any) -> Any:
            if values is None or len(values) != len(self.shape):
                return values
            return tuple(values[axis] for axis in kept)

        stated = replace(
            self.stated,
            axes=self.stated.axes and "".join(of_kept(self.stated.axes)),
            spacing=of_kept(self.stated.spacing),
            origin=of_kept(self.stated.origin),
        )
        return replace(
            self,
            shape=of_kept(self.shape),
            open=lambda: View(self.open(), kept),
            dims=of_kept(self.dims),
            stated=stated,
        )


@dataclass
class Contents:
    """The arrays of a file by name, ``""`` where it holds a single one without a name.

    ``texts`` are those that state a unit, beside an array or of a group that holds it, the whole
    file among these; named like arrays. ``unread`` names what is neither numbers nor text.
    ``unclear_unit`` says why the unit must be given, where the file has one of who knows what.
    """

    variables: Mapping[str, Variable]
    close: Callable[[], None] = lambda: None
    texts: Mapping[str, str] = field(default_factory=dict)
    unread: Collection[str] = ()
    unclear_unit: str | None = None

    def unit_texts(self, name: str) -> dict[str, str]:
        """Texts that state the unit of an array: beside it, or of the nearest group."""
        group = name
        while group:
            group = group.rpartition("/")[0]
            found = {
                key.rpartition("/")[2]: text
                for key, text in self.texts.items()
                if key.rpartition("/")[0] == group and is_unit_key(key.rpartition("/")[2])
            }
            if found:
                return found
        return {key: text for key, text in self.texts.items() if is_unit_key(key)}

    def passed_over(self) -> str:
        """Say which parts are not read, for the end of an error; empty if there are none."""
        if not self.unread:
            return ""
        return (
            f". Not read: {', '.join(list(self.unread)[:20])} (a structure, a cell, an object or "
            "text); save an array that is in it as a variable of its own"
        )

    @classmethod
    def single(
        cls,
        array: Array,
        stated: Stated,
        access: Access,
        close: Callable[[], None] = lambda: None,
        dims: tuple[str, ...] = (),
        texts: Mapping[str, str] | None = None,
    ) -> Contents:
        """Contents of a format that holds one array."""
        variable = Variable(array.shape, array.dtype, lambda: array, access, dims, stated=stated)
        return cls({"": variable}, close, texts or {})

    def __enter__(self) -> Contents:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Reader(Protocol):
    """What the module of a format offers."""

    FORMAT: str

    def recognises(self, path: Path, head: bytes) -> bool:
        """Tell whether a file, by its first bytes, or a folder (no bytes) is of this format."""

    def contents(self, path: Path, wanted: str | None) -> Contents:
        """Find the arrays, unread; those that are not `wanted` may be left out."""


def unit_texts(attributes: Mapping[str, Any], group: str) -> dict[str, str]:
    """Attributes of a group that state a unit, by their path in the file."""
    said = {key: text for key, text in attributes.items() if is_unit_key(key)}
    return {f"{group}/{key}".lstrip("/"): str(text) for key, text in said.items()}


def unit_texts_above(
    name: str, attributes_of: Callable[[str], Mapping[str, Any]]
) -> dict[str, str]:
    """``unit_texts`` of the groups that hold an array, but for the root."""
    texts: dict[str, str] = {}
    group = name.rpartition("/")[0]
    while group:
        texts |= unit_texts(attributes_of(group), group)
        group = group.rpartition("/")[0]
    return texts


@contextmanager
def translated_errors(path: Path, fmt: str) -> Iterator[None]:
    """Turn whatever a format's library raises on a damaged file into an InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # parsers raise anything on damaged input
        detail = f"{type(error).__name__}: {error}"[:300]
        raise InputError(
            f"{path}: cannot be read as {fmt}; damaged, truncated or unsupported ({detail})"
        ) from error
