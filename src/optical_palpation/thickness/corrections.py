"""Corrections by hand: points that a boundary passes through and regions that say nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from optical_palpation.errors import InputError
from optical_palpation.files import replacing

Boundary = Literal["window", "sample"]
Lengths = tuple[float, float, float]


class Anchor(NamedTuple):
    """Point through which a boundary passes.

    Attributes
    ----------
    boundary
        ``"window"`` or ``"sample"``.
    x, y, z
        Its position, mm.
    """

    boundary: Boundary
    x: float
    y: float
    z: float


class Exclusion(NamedTuple):
    """Rectangle in which a boundary is not looked for but interpolated.

    Attributes
    ----------
    boundary
        ``"window"`` or ``"sample"``.
    x_min, x_max, y_min, y_max
        Its sides, mm.
    """

    boundary: Boundary
    x_min: float
    x_max: float
    y_min: float
    y_max: float


@dataclass(frozen=True)
class Corrections:
    """Anchor points and excluded regions."""

    anchors: tuple[Anchor, ...] = ()
    exclusions: tuple[Exclusion, ...] = ()

    def __iter__(self) -> Iterator[Anchor | Exclusion]:
        """Go through anchors, then excluded regions."""
        yield from self.anchors
        yield from self.exclusions

    def check_inside(self, origin: Lengths, spacing: Lengths, shape: tuple[int, int, int]) -> None:
        """Refuse corrections that lie outside a volume, given along (z, y, x): they do nothing.

        Raises
        ------
        InputError
            Naming the correction and what the volume spans.
        """
        low = [start - 0.5 * step for start, step in zip(origin, spacing, strict=True)]
        high = [a + n * step for a, n, step in zip(low, shape, spacing, strict=True)]
        spans = [(a.z, a.z, a.y, a.y, a.x, a.x) for a in self.anchors]
        spans += [(low[0], low[0], e.y_min, e.y_max, e.x_min, e.x_max) for e in self.exclusions]
        for correction, span in zip(self, spans, strict=True):
            ends = zip(span[::2], span[1::2], low, high, strict=True)
            if any(to < lowest or start > highest for start, to, lowest, highest in ends):
                volume = ", ".join(
                    f"{axis} {a:.4g} to {b:.4g}"
                    for axis, a, b in zip("zyx", low, high, strict=True)
                )
                raise InputError(
                    f"corrections: {_line(correction, '{:g}'.format)} lies outside the volume "
                    f"({volume} mm). Lengths are in mm, in the coordinates of the volume"
                )

    def anchor_pixels(
        self, boundary: str, origin: Lengths, spacing: Lengths
    ) -> list[tuple[float, float, float]]:
        """Anchors (y, x, z) of a boundary in pixels."""
        (oz, oy, ox), (dz, dy, dx) = origin, spacing
        return [
            ((a.y - oy) / dy, (a.x - ox) / dx, (a.z - oz) / dz)
            for a in self.anchors
            if a.boundary == boundary
        ]

    def excluded_pixels(
        self, boundary: str, origin: Lengths, spacing: Lengths, shape: tuple[int, int]
    ) -> NDArray[np.bool_]:
        """Excluded pixels `[y, x]` of a boundary."""
        y = (origin[1] + spacing[1] * np.arange(shape[0]))[:, None]
        x = (origin[2] + spacing[2] * np.arange(shape[1]))[None, :]
        mask = np.zeros(shape, bool)
        for e in self.exclusions:
            if e.boundary == boundary:
                mask |= (e.x_min <= x) & (x <= e.x_max) & (e.y_min <= y) & (y <= e.y_max)
        return mask


def read_corrections(path: str | Path) -> Corrections:
    """Read a text file of corrections, lengths in mm, one per line; # starts a comment.

    ::

        anchor   sample  1.20 3.40 0.512        # x y z
        exclude  window  0.0 0.5  2.0 2.5       # x from, to; y from, to

    Raises
    ------
    InputError
        If the file cannot be read, or naming the line that cannot be understood.
    """
    kinds = {"anchor": 3, "exclude": 4}
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise InputError(f"{path}: corrections cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no file of corrections, which is UTF-8 text") from error
    anchors, exclusions = [], []
    for number, line in enumerate(lines, start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        where = f"{path}, line {number}: {line.strip()!r}"
        if words[0] not in kinds or len(words) < 2 or words[1] not in get_args(Boundary):
            raise InputError(
                f"{where}: a line begins with anchor or exclude, then window or sample"
            )
        try:
            values = [float(word) for word in words[2:]]
        except ValueError:
            values = []
        if len(values) != kinds[words[0]] or not np.all(np.isfinite(values)):
            raise InputError(f"{where}: {words[0]} takes {kinds[words[0]]} numbers in mm")
        boundary: Boundary = "window" if words[1] == "window" else "sample"
        if words[0] == "anchor":
            anchors.append(Anchor(boundary, *values))
        elif values[0] > values[1] or values[2] > values[3]:
            raise InputError(f"{where}: x and y each run from the smaller to the larger number")
        else:
            exclusions.append(Exclusion(boundary, *values))
    return Corrections(tuple(anchors), tuple(exclusions))


def _line(correction: Anchor | Exclusion, said: Callable[[float], str]) -> str:
    """A correction as its file says it."""
    boundary, *numbers = correction
    kind = "anchor" if isinstance(correction, Anchor) else "exclude"
    return " ".join([kind, boundary, *map(said, numbers)])


def write_corrections(corrections: Corrections, path: str | Path) -> None:
    """Write a text file of corrections, which :func:`read_corrections` reads to the last digit.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    lines = ["# mm; anchor: x y z, exclude: x from, to, y from, to"]
    for correction in corrections:
        lines.append(_line(correction, lambda n: repr(float(n))))
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
