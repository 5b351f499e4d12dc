"""Regions of interest of a map: which pixels they hold, and what the map says there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from optical_palpation.analysis.maps import (
    area_mean,
    at_points_of,
    check_map,
    map_error,
    on_layer,
    pixel_size,
    plane_noise,
    point_areas,
)
from optical_palpation.arguments import (
    check_instance,
    explained,
    explained_fields,
    in_words,
    number,
    numbers,
)
from optical_palpation.errors import InputError

#: Points along each side of a pixel by which the share of it that lies in an outline is counted, at
#: least; and along the longer side of a region, which may have few pixels.
_POINTS = 8
_ACROSS = 400
#: Points along each side of a region that reaches beyond the map, to tell by how much.
_SAMPLES = 200
#: Directions of the polygon that stands for an ellipse.
_CORNERS = 180
# Variables whose integral is a force, and the sign that makes compression positive.
_FORCES = {
    "axial_stress": -1.0,
    "algebraic_axial_stress": -1.0,
    "contact_pressure": 1.0,
    "traction_z": -1.0,
}


@explained_fields
@dataclass(frozen=True, eq=False)
class Region:
    """A named part of the field of view.

    Make one with :meth:`rectangle`, :meth:`ellipse`, :meth:`polygon` or :meth:`of_mask`.

    Attributes
    ----------
    name
        What to call it in tables and figures.
    outlines
        Closed polygons, each ``(n, 2)`` of x and y in mm; where two overlap is a hole. Empty for
        a region that was given as a mask.
    mask
        Share of each pixel that belongs to it, on ``(y, x)``; ``None`` where outlines say so.
    """

    name: str
    outlines: tuple[NDArray[np.float64], ...] = ()
    mask: xr.DataArray | None = None

    def __post_init__(self) -> None:
        check_instance(self.name, str, "name", "a region is called by a text")
        if self.mask is None:
            kind = "polygons of x and y in mm; Region.polygon, .rectangle and .ellipse make them"
            check_instance(self.outlines, tuple, "outlines", kind)
            for outline in self.outlines:
                check_instance(outline, np.ndarray, "outlines", kind)
        else:
            check_instance(self.mask, xr.DataArray, "mask", "a DataArray (Region.of_mask)")

    @classmethod
    @explained
    def polygon(cls, name: str, vertices: ArrayLike) -> Region:
        """Region within a polygon of at least three vertices, ``(n, 2)`` of x and y in mm.

        Raises
        ------
        InputError
            If there are fewer vertices, or one is no pair of finite numbers.
        """
        try:
            outline = np.asarray(vertices, dtype=np.float64)
        except (TypeError, ValueError):
            outline = np.empty(0)
        pairs = outline.ndim == 2 and outline.shape[1] == 2
        if not pairs or len(outline) < 3:
            found = f"{len(outline)} of them" if pairs else in_words(vertices)
            raise InputError(
                f"region {name!r}, vertices: a polygon needs at least three vertices (x, y) in "
                f"mm, not {found}"
            )
        if not np.isfinite(outline).all():
            raise InputError(f"region {name!r}: a vertex is not finite")
        spread = np.linalg.svd(outline - outline.mean(axis=0), compute_uv=False)
        if spread[1] <= 1e-9 * spread[0]:
            raise InputError(f"region {name!r}: its vertices lie on a line and enclose no area")
        return cls(name, (outline,))

    @classmethod
    @explained
    def rectangle(cls, name: str, x0: float, x1: float, y0: float, y1: float) -> Region:
        """Region of x0 to x1 and y0 to y1, mm.

        Raises
        ------
        InputError
            If it has no area.
        """
        x0, x1, y0, y1 = (
            number(value, f"region {name!r}, {side}", "a number of mm")
            for side, value in zip(("x0", "x1", "y0", "y1"), (x0, x1, y0, y1), strict=True)
        )
        if not (x0 < x1 and y0 < y1):
            raise InputError(
                f"region {name!r}: a rectangle needs x0 < x1 and y0 < y1, found x {x0:g} to {x1:g} "
                f"and y {y0:g} to {y1:g} mm"
            )
        return cls.polygon(name, [(x0, y0), (x1, y0), (x1, y1), (x0, y1)])

    @classmethod
    @explained
    def ellipse(
        cls, name: str, centre: tuple[float, float], semi_axes: tuple[float, float]
    ) -> Region:
        """Region within an ellipse about a centre (x, y) of given semi-axes along x and y, mm.

        Raises
        ------
        InputError
            If a semi-axis is not positive.
        """
        where = f"region {name!r}, "
        middle = numbers(centre, 2, f"{where}centre", "two numbers (x, y) in mm")
        axes = numbers(semi_axes, 2, f"{where}semi_axes", "two positive numbers (x, y) in mm")
        if not min(axes) > 0.0:
            raise InputError(f"{where}semi_axes: must be positive, found {semi_axes}")
        return cls.polygon(name, np.array(middle) + _unit_circle() * np.array(axes))

    @classmethod
    @explained
    def ellipse_in_box(cls, name: str, corners: ArrayLike) -> Region:
        """Region within the ellipse that fits into a box, which may be turned.

        Parameters
        ----------
        name
            What to call it.
        corners
            The four corners of the box, ``(4, 2)`` of x and y in mm, in order.

        Raises
        ------
        InputError
            If they are no such corners.
        """
        four = f"region {name!r}, corners: the four corners (x, y) of a box in mm, in order"
        try:
            box = cls.polygon(name, corners).outlines[0]
        except InputError:
            raise InputError(f"{four}, not {in_words(corners)}") from None
        if len(box) != 4:
            raise InputError(f"{four}; found {len(box)}")
        half = np.stack([(box[1] - box[0]) / 2, (box[2] - box[1]) / 2])
        return cls.polygon(name, box.mean(0) + _unit_circle() @ half)

    @classmethod
    @explained
    def of_mask(cls, name: str, mask: xr.DataArray) -> Region:
        """Region of the pixels that are true in a mask on ``(y, x)``, coordinates in mm.

        Raises
        ------
        InputError
            If the mask is no such map, or true nowhere.
        """
        if not isinstance(mask, xr.DataArray) or set(mask.dims) != {"y", "x"}:
            raise InputError(
                f"region {name!r}: a mask is a DataArray over y and x, not {type(mask).__name__}"
            )
        if mask.dtype != bool or not mask.values.any():
            raise InputError(
                f"region {name!r}: a mask holds true and false, and true somewhere; found "
                f"{mask.dtype}, {int(mask.values.astype(bool).sum())} pixels true"
            )
        return cls(name, mask=mask.transpose("y", "x").astype(float))

    def weights(self, like: xr.DataArray) -> xr.DataArray:
        """Share of each pixel of a map that lies in the region, 0 to 1, on ``(y, x)``.

        A pixel is what is nearest to its point, no further than the outermost points of the map.

        Raises
        ------
        InputError
            If the region lies outside of the map.
        """
        field = check_map(like, "map")
        y, x = field["y"].values, field["x"].values
        if self.mask is not None:
            mask = self.mask.sortby(["y", "x"])
            shares = at_points_of(mask, field, "nearest", beyond=0.0).values
        else:
            shares = self._shares(y, x, pixel_size(field))
        if not shares.any():
            raise InputError(
                f"region {self.name!r} lies outside of the map, x {x[0]:g} to {x[-1]:g} and y "
                f"{y[0]:g} to {y[-1]:g} mm"
            )
        return field.copy(data=shares).rename("weight").drop_attrs(deep=False)

    def beyond(self, like: xr.DataArray) -> float:
        """Share of the region that lies outside of a map, to about one in a hundred."""
        field = check_map(like, "map")
        reach = 1e-6 * np.array(pixel_size(field))[::-1]
        first, last = (np.array([float(field[a][n]) for a in "xy"]) for n in (0, -1))
        low, high = first - reach, last + reach

        def outside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
            return np.any((points < low) | (points > high), axis=1)

        if self.mask is not None:
            rows, columns = np.nonzero(self.mask.values)
            points = np.stack([self.mask["x"].values[columns], self.mask["y"].values[rows]], -1)
        else:
            points = np.concatenate(self.outlines)
        if not outside(points).any():
            return 0.0
        if self.mask is not None:  # of a pixel at the border half is in the map
            at_border = (abs(points - first) < reach) | (abs(points - last) < reach)
            areas = np.where(at_border, 0.5, 1.0).prod(axis=1)
            return float(np.average(outside(points), weights=areas))
        at = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        x, y = (a + at * (b - a) for a, b in zip(points.min(0), points.max(0), strict=True))
        points = np.stack(np.meshgrid(x, y), -1)[self._holds(y, x)]
        return float(outside(points).mean()) if len(points) else 0.0

    def _holds(self, y: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points of a grid, ascending, lie within its outlines, (y, x).

        Along each row the sides of the outlines are crossed, and every crossing leads in or out.
        The rows of all sides together are few; a test of each point against each side takes long
        for outlines that were drawn by hand or traced.
        """
        crossed = np.zeros((y.size, x.size + 1), np.bool_)
        for outline in self.outlines:
            start, end = outline, np.roll(outline, -1, axis=0)
            low, high = np.sort(np.searchsorted(y, [start[:, 1], end[:, 1]]), axis=0)
            count = high - low
            side = np.repeat(np.arange(len(outline)), count)
            row = np.arange(side.size) - np.repeat(np.cumsum(count) - count - low, count)
            (x0, y0), (x1, y1) = start[side].T, end[side].T
            at = np.searchsorted(x, x0 + (x1 - x0) * (y[row] - y0) / (y1 - y0))
            np.logical_xor.at(crossed, (row, at), True)
        return np.logical_xor.accumulate(crossed, axis=1)[:, :-1]

    def _shares(
        self, y: NDArray[np.float64], x: NDArray[np.float64], size: tuple[float, float]
    ) -> NDArray[np.float64]:
        shares = np.zeros((y.size, x.size))
        corners = np.concatenate(self.outlines)
        (x0, y0), (x1, y1) = corners.min(0), corners.max(0)
        rows = np.flatnonzero((y > y0 - size[0]) & (y < y1 + size[0]))
        columns = np.flatnonzero((x > x0 - size[1]) & (x < x1 + size[1]))
        if rows.size == 0 or columns.size == 0:
            return shares
        count = _POINTS
        while count * max(rows.size, columns.size) < _ACROSS:  # halves of pixels stay halves
            count *= 2
        within = (np.arange(count) + 0.5) / count - 0.5
        fine_y = (y[rows, None] + within * size[0]).ravel()
        fine_x = (x[columns, None] + within * size[1]).ravel()
        there_y, there_x = (fine_y > y[0]) & (fine_y < y[-1]), (fine_x > x[0]) & (fine_x < x[-1])
        held = self._holds(fine_y, fine_x) & there_y[:, None] & there_x
        held = held.reshape(rows.size, count, columns.size, count).sum(axis=(1, 3))
        there = (there.reshape(-1, count).sum(axis=1) for there in (there_y, there_x))
        shares[np.ix_(rows, columns)] = held / np.outer(*there)
        return shares


def _unit_circle() -> NDArray[np.float64]:
    """Polygon of the area of the unit circle, not one inscribed in it."""
    angle = np.linspace(0.0, 2 * np.pi, _CORNERS, endpoint=False)
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return unit * np.sqrt(2 * np.pi / _CORNERS / np.sin(2 * np.pi / _CORNERS))


@explained
def region_statistics(
    maps: xr.Dataset,
    regions: Sequence[Region],
    variable: str = "axial_stress",
    background: Region | Literal["rest"] | None = "rest",
) -> xr.Dataset:
    """Tell what a map says in regions of interest.

    A pixel at the rim of a region counts by the share of it that lies inside, so that areas and
    forces do not jump with the pixels. Pixels without a value are left out and counted.

    Parameters
    ----------
    maps
        Maps of a result on ``(y, x)``; what lies beyond the layer is left out.
    regions
        At least one; names must differ.
    variable
        The map to look at.
    background
        What regions are compared with: a region, ``"rest"`` for the pixels that none of them
        touches, or ``None``.

    Returns
    -------
    xarray.Dataset
        Over ``region``: ``mean``, ``standard_deviation``, ``minimum``, ``maximum`` in the unit of
        the map, ``area`` (mm2), ``missing`` (share of the region without a value or outside of the
        map); of stress and pressure also ``force`` (mN, compression positive). With a background
        that has a value, ``difference`` (mean less that of the background), and ``contrast``, its
        size over the background's noise, the standard deviation about a plane. Where the maps hold
        ``<variable>_error`` (of both moduli ``sample_modulus_error``), ``mean_error``, the mean of
        that error and the mesh's, and ``force_error`` (mN), its sum: those of an error common to
        the whole region, and upper bounds of any other. They are NaN where no pixel has an error.
        The attributes hold the mean and noise of the background.

    Raises
    ------
    InputError
        If there is no such map, a region lies outside of it or holds no value, or names repeat.
    """
    if variable not in maps:
        known = ", ".join(str(n) for n, v in maps.data_vars.items() if set(v.dims) == {"y", "x"})
        raise InputError(f"there is no map {variable!r}; known are {known}")
    maps = on_layer(maps)
    kind = "a list of Region (read_regions reads one)"
    check_instance(regions, Sequence, "regions", kind)
    for region in regions:
        check_instance(region, Region, "regions", kind)
    names = [region.name for region in regions]
    if not names:
        raise InputError("regions: give at least one")
    if len(set(names)) < len(names):
        raise InputError(f"regions: names must differ, found {', '.join(names)}")
    field = check_map(maps[variable], variable)
    areas = point_areas(field).values
    error = _error(maps, variable)
    rows = []
    rest = np.ones(field.shape, np.bool_)
    for region in regions:
        weight = region.weights(field).values
        rest &= weight == 0.0
        row = _statistics(region.name, field.values, weight, areas, error, _FORCES.get(variable))
        beyond = region.beyond(field)
        row["area"] /= 1.0 - beyond
        row["missing"] = 1.0 - (1.0 - beyond) * (1.0 - row["missing"])
        rows.append(row)
    units = field.attrs.get("units", "")
    result = xr.Dataset(
        {
            key: ("region", [row[key] for row in rows], {"units": unit or units, "long_name": text})
            for key, (unit, text) in _COLUMNS.items()
            if key in rows[0]
        },
        {"region": names},
        {"variable": variable, "long_name": str(field.attrs.get("long_name", variable))},
    )
    if background is not None:
        level = _background(field, rest, background)
        if level is not None:
            mean, noise = level
            difference = result["mean"] - mean
            result["difference"] = difference.assign_attrs(
                units=units, long_name="mean less that of the background"
            )
            result["contrast"] = abs(difference) / noise if noise > 0 else difference * np.nan
            result["contrast"].attrs = {
                "units": "1",
                "long_name": "difference over the noise of the background",
            }
            result.attrs |= {"background_mean": mean, "background_noise": noise}
    return result


_COLUMNS = {
    "mean": ("", "mean"),
    "standard_deviation": ("", "standard deviation"),
    "minimum": ("", "lowest value"),
    "maximum": ("", "highest value"),
    "mean_error": ("", "error of the mean, at most"),
    "force": ("mN", "force, compression positive"),
    "force_error": ("mN", "error of the force, at most"),
    "area": ("mm2", "area"),
    "missing": ("1", "share without a value"),
}


def _statistics(
    name: str,
    values: NDArray[np.float64],
    share: NDArray[np.float64],
    areas: NDArray[np.float64],
    error: NDArray[np.float64] | None,
    sign: float | None,
) -> dict[str, float]:
    seen = np.isfinite(values) & (share > 0)
    if not seen.any():
        raise InputError(f"region {name!r} holds no value: the map is missing all over it")
    held = share * areas
    w, v = held[seen], values[seen]
    mean = float(np.average(v, weights=w))
    # of pixels that only touch the region, none is its extreme, unless the mean is theirs
    inner = v[share[seen] >= 0.5]
    if not (inner.size and inner.min() <= mean <= inner.max()):
        inner = v
    row = {
        "mean": mean,
        "standard_deviation": float(np.sqrt(np.average((v - mean) ** 2, weights=w))),
        "minimum": float(inner.min()),
        "maximum": float(inner.max()),
        "area": float(held.sum()),
        "missing": float(held[~seen].sum() / held.sum()),
    }
    if sign is not None:
        row["force"] = sign * float(w @ v)
    if error is not None:
        known = np.isfinite(error[seen])
        there = known.any()
        row["mean_error"] = (
            float(np.average(error[seen][known], weights=w[known])) if there else np.nan
        )
        if sign is not None:
            row["force_error"] = row["mean_error"] * float(w.sum())
    return row


def _error(maps: xr.Dataset, variable: str) -> NDArray[np.float64] | None:
    """The error of a map in its unit, None where there is none."""
    if (own := map_error(maps, variable)) is not None:
        return check_map(own, f"{variable}_error").values
    shared = "sample_modulus_error"
    if variable in ("sample_shear_modulus", "sample_youngs_modulus") and shared in maps:
        share = check_map(maps[shared], shared).values
        return np.asarray(share * maps[variable].transpose("y", "x").values)
    return None


def _background(
    field: xr.DataArray, rest: NDArray[np.bool_], background: Region | str
) -> tuple[float, float] | None:
    """Mean and noise of the background, or None where too few pixels are left."""
    mask = background.weights(field).values >= 0.5 if isinstance(background, Region) else rest
    mask = mask & np.isfinite(field.values)
    if mask.sum() < 6:
        if isinstance(background, Region):
            raise InputError(
                f"background {background.name!r}: {mask.sum()} pixels with a value, at least 6 are "
                "needed"
            )
        return None
    return area_mean(field.where(mask)), plane_noise(field, mask)
