"""A field of view as tiles that overlap, and one map of what was computed tile by tile."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.errors import InputError
from optical_palpation.mechanics.grid import node_positions

Array = NDArray[np.float64]

#: Fewest elements that neighbours share.
_LEAST_OVERLAP = 4


@dataclass(frozen=True)
class Tile:
    """One tile: which points of the field's maps it holds.

    Attributes
    ----------
    name
        Row and column, counted from 1.
    rows, columns
        First and last point along y and x.
    """

    name: str
    rows: tuple[int, int]
    columns: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Tiling:
    """A field in tiles.

    Attributes
    ----------
    y, x
        Points of the field's maps, mm, evenly spaced.
    overlap
        Elements that neighbours share, (y, x).
    shape
        Numbers of tiles, (y, x).
    tiles
        Row by row.
    """

    y: Array
    x: Array
    overlap: tuple[int, int]
    shape: tuple[int, int]
    tiles: tuple[Tile, ...]

    def region(self, tile: Tile) -> tuple[float, float, float, float]:
        """Return x0, x1, y0, y1 of a tile, mm."""
        (j0, j1), (i0, i1) = tile.rows, tile.columns
        return float(self.x[i0]), float(self.x[i1]), float(self.y[j0]), float(self.y[j1])

    def weights(self, tile: Tile) -> Array:
        """Weights [y, x] of a tile where maps are blended: smooth ramps over the overlaps.

        Those of neighbours add up to 1.
        """
        along_y, along_x = (
            _ramps(ends, len(points), overlap)
            for ends, points, overlap in (
                (tile.rows, self.y, self.overlap[0]),
                (tile.columns, self.x, self.overlap[1]),
            )
        )
        return along_y[:, None] * along_x


def tiled(
    region: tuple[float, float, float, float],
    sizes: tuple[float, float, float],
    width: float,
    overlap: float,
) -> Tiling:
    """Divide a region into tiles.

    Parameters
    ----------
    region
        x0, x1, y0, y1, mm.
    sizes
        Element sizes (x, y, z), mm.
    width
        Largest width of a tile without what it shares with its neighbours, mm.
    overlap
        Width of what neighbours share, mm.

    Raises
    ------
    InputError
        If overlaps are narrower than four elements, or wider than half a tile.
    """
    x0, x1, y0, y1 = region
    largest = max(sizes[:2])
    if not overlap >= _LEAST_OVERLAP * largest * (1 - 1e-6):
        raise InputError(
            f"overlap must be at least {_LEAST_OVERLAP * largest:g} mm, {_LEAST_OVERLAP} elements, "
            f"not {overlap:g} mm"
        )
    if not np.isfinite(width) or width < 2 * overlap:
        raise InputError(
            f"tile must be at least {2 * overlap:g} mm, twice the overlap, not {width:g} mm"
        )
    axes = []
    for start, end, size in ((y0, y1, sizes[1]), (x0, x1, sizes[0])):
        points = node_positions(end - start, size, start)
        cells = len(points) - 1
        count = max(1, int(np.ceil((end - start) / width - 1e-6)))
        borders = [round(n * cells / count) for n in range(count + 1)]
        shared = 2 * int(np.ceil(overlap / size / 2 - 1e-6))
        half = shared // 2
        ends = [(max(a - half, 0), min(b + half, cells)) for a, b in pairwise(borders)]
        axes.append((points, shared, ends))
    (y, shared_y, rows), (x, shared_x, columns) = axes
    tiles = tuple(
        Tile(f"tile-{j}-{i}", row, column)
        for j, row in enumerate(rows, 1)
        for i, column in enumerate(columns, 1)
    )
    return Tiling(y, x, (shared_y, shared_x), (len(rows), len(columns)), tiles)


class Blend:
    """Maps of a field, to which those of its tiles are added one by one.

    Parameters
    ----------
    tiling
        The tiles.
    """

    def __init__(self, tiling: Tiling) -> None:
        self._tiling = tiling
        shape = len(tiling.y), len(tiling.x)
        self._sums: dict[str, Array] = {}
        self._weights: dict[str, Array] = {}
        self._classes: dict[str, NDArray[Any]] = {}
        self._strongest = np.zeros(shape)
        self._lowest, self._highest = np.full(shape, np.inf), np.full(shape, -np.inf)
        self._count = np.zeros(shape, dtype=np.int16)
        self._attrs: dict[str, dict[str, Any]] = {}

    def add(self, tile: Tile, maps: xr.Dataset) -> None:
        """Add the maps of a tile, on its points of the field.

        Raises
        ------
        ValueError
            If the maps lie on other points.
        """
        tiling = self._tiling
        here = tuple(slice(first, last + 1) for first, last in (tile.rows, tile.columns))
        for points, axis, ends in ((tiling.y, "y", here[0]), (tiling.x, "x", here[1])):
            wanted, slack = points[ends], 1e-3 * (points[1] - points[0])
            given = maps[axis].values
            if given.shape != wanted.shape or np.abs(given - wanted).max() > slack:
                raise ValueError(f"{tile.name}: maps on other points along {axis}")
        weights = tiling.weights(tile)
        stronger = weights > self._strongest[here]
        self._strongest[here][stronger] = weights[stronger]
        for name, field in maps.data_vars.items():
            key, values = str(name), field.transpose("y", "x").values
            self._attrs.setdefault(key, field.attrs)
            if values.dtype.kind != "f":
                chosen = self._classes.setdefault(
                    key, np.zeros(self._strongest.shape, dtype=values.dtype)
                )
                chosen[here][stronger] = values[stronger]
                continue
            known = np.isfinite(values)
            for totals, part in (
                (self._sums, np.where(known, weights * values, 0.0)),
                (self._weights, np.where(known, weights, 0.0)),
            ):
                total = totals.setdefault(key, np.zeros(self._strongest.shape))
                total[here] += part
        stress = maps["axial_stress"].transpose("y", "x").values
        known = np.isfinite(stress)
        self._count[here] += known
        np.minimum(self._lowest[here], stress, out=self._lowest[here], where=known)
        np.maximum(self._highest[here], stress, out=self._highest[here], where=known)

    def maps(self) -> xr.Dataset:
        """Return the maps of the field, without a value where no tile has one.

        ``axial_stress_seam_error`` is the largest difference of the axial stress, kPa, among the
        tiles that share a point, and has no value elsewhere. The attribute ``seam_error`` is that
        difference as a fraction of the stress there (root mean squares), and
        ``seam_error_largest_kPa`` the largest one.
        """
        tiling = self._tiling
        result = xr.Dataset(
            coords={
                axis: (axis, points, {"units": "mm", "long_name": f"lateral position {axis}"})
                for axis, points in (("y", tiling.y), ("x", tiling.x))
            }
        )
        for name, attrs in self._attrs.items():
            if name in self._classes:
                values: NDArray[Any] = self._classes[name]
            else:
                weights = self._weights[name]
                values = np.full(weights.shape, np.nan)
                np.divide(self._sums[name], weights, out=values, where=weights > 0)
            result[name] = (("y", "x"), values, attrs)
        shared = self._count > 1
        difference = np.full(shared.shape, np.nan)
        difference[shared] = self._highest[shared] - self._lowest[shared]
        result["axial_stress_seam_error"] = (
            ("y", "x"),
            difference,
            {"units": "kPa", "long_name": "difference of the axial stress of tiles that overlap"},
        )
        if shared.any():
            off, stress = difference[shared], result["axial_stress"].values[shared]
            size = max(float(np.linalg.norm(stress)), 1e-30)
            result.attrs["seam_error"] = float(np.linalg.norm(off)) / size
            result.attrs["seam_error_largest_kPa"] = float(off.max())
        return result


def _ramps(ends: tuple[int, int], count: int, overlap: int) -> Array:
    """Weights along one axis: 1, but for smooth ramps over the overlaps with neighbours."""
    first, last = ends
    steps = (np.arange(overlap + 1) + 0.5) / (overlap + 1)  # a tile counts on all of its points
    ramp = steps**2 * (3 - 2 * steps)
    weights = np.ones(last - first + 1)
    if first > 0:
        weights[: overlap + 1] = ramp
    if last < count - 1:
        weights[-overlap - 1 :] = ramp[::-1]
    return weights
