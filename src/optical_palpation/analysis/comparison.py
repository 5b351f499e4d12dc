"""Difference of maps, in the interior and at the edge."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from optical_palpation.analysis.maps import at_points_of, check_map, map_error, pixel_size
from optical_palpation.arguments import check_instance, explained
from optical_palpation.errors import InputError
from optical_palpation.thickness import lateral_shift

ZONES = ("interior", "edge", "all")


def compare_maps(
    field: xr.DataArray, reference: xr.DataArray, edge_width: float = 0.5
) -> xr.Dataset:
    """Compare a map with a reference.

    Parameters
    ----------
    field
        Map on ``(y, x)``; taken to the reference's pixels by linear interpolation.
    reference
        Map on ``(y, x)`` in the same unit.
    edge_width
        Pixels nearer than this to the border of the reference are its edge, mm.

    Returns
    -------
    xarray.Dataset
        ``difference`` (field less reference) on the reference's grid, and over ``zone``
        (interior, edge, all): ``rms``, ``relative_rms`` (rms of the difference over rms of the
        reference), ``bias`` (mean difference), ``relative_bias`` (over the mean of the reference),
        ``largest`` absolute difference, and ``pixels``. Pixels without a value in either map are
        left out.

    Raises
    ------
    InputError
        If the maps cannot be used, their units differ, or they do not overlap.
    """
    a, b = check_map(field, "map"), check_map(reference, "reference")
    units = a.attrs.get("units"), b.attrs.get("units")
    if None not in units and units[0] != units[1]:
        raise InputError(f"the map is in {units[0]} and the reference in {units[1]}")
    a = _on_pixels_of(a, b)
    difference = (a - b.assign_coords(y=a["y"], x=a["x"])).rename("difference")
    if not np.isfinite(difference.values).any():
        raise InputError(
            "map and reference do not overlap: x "
            f"{float(field['x'].min()):g} to {float(field['x'].max()):g} and "
            f"{float(b['x'].min()):g} to {float(b['x'].max()):g} mm, y "
            f"{float(field['y'].min()):g} to {float(field['y'].max()):g} and "
            f"{float(b['y'].min()):g} to {float(b['y'].max()):g} mm"
        )
    if units[1] is not None:
        difference.attrs["units"] = units[1]

    y, x = b["y"].values, b["x"].values
    border = np.minimum.outer(np.minimum(y - y[0], y[-1] - y), np.minimum(x - x[0], x[-1] - x))
    inner = border >= edge_width - 1e-9
    valid = np.isfinite(difference.values)
    rows = []
    for zone in (inner, ~inner, np.ones_like(inner)):
        d, r = difference.values[zone & valid], b.values[zone & valid]
        if d.size == 0:
            rows.append((np.nan,) * 5 + (0,))
            continue
        rms, bias = float(np.sqrt(np.mean(d**2))), float(d.mean())
        scale, mean = float(np.sqrt(np.mean(r**2))), float(r.mean())
        rows.append(
            (
                rms,
                rms / scale if scale > 0.0 else np.nan,
                bias,
                bias / mean if mean != 0.0 else np.nan,
                float(np.abs(d).max()),
                d.size,
            )
        )
    names = ("rms", "relative_rms", "bias", "relative_bias", "largest", "pixels")
    columns = dict(zip(names, zip(*rows, strict=True), strict=True))
    return xr.Dataset(
        {"difference": difference} | {k: ("zone", list(v)) for k, v in columns.items()},
        coords={"zone": list(ZONES)},
        attrs={"edge_width_mm": edge_width},
    )


def _on_pixels_of(field: xr.DataArray, reference: xr.DataArray) -> xr.DataArray:
    """Interpolate a map, but not on its own pixels: a missing one costs its neighbours."""
    same = field.sizes == reference.sizes and all(
        np.allclose(field[d], reference[d], rtol=0.0, atol=1e-9) for d in ("y", "x")
    )
    return field if same else at_points_of(field, reference)


@explained
def compare_results(
    results: Mapping[str, xr.Dataset],
    variable: str = "axial_stress",
    *,
    register: bool = False,
    edge_width: float = 0.5,
) -> xr.Dataset:
    """Compare a map of several results with that of the first one, on the pixels of that.

    Parameters
    ----------
    results
        Maps of at least two results by name; the first is the reference.
    variable
        Map to compare.
    register
        Take back a lateral shift of each result against the reference, found from the loaded
        thickness, which shows the sample's relief.
    edge_width
        As for :func:`compare_maps`.

    Returns
    -------
    xarray.Dataset
        The map itself over ``(result, y, x)``; over ``(compared, y, x)``, which has all results
        but the reference, ``difference`` (result less reference); over ``(compared, zone)`` the
        numbers of :func:`compare_maps`; over ``(compared, axis)`` the ``shift`` in mm that was
        taken back. Where the reference and another result hold ``<variable>_error``, also
        ``difference_error``, both errors and those of the meshes in quadrature (NaN for a result
        without), and over ``compared`` ``within_error``, the share of pixels whose difference is no
        larger.

    Raises
    ------
    InputError
        If there are fewer than two results, a map is missing or cannot be compared, or there is no
        relief to register by.
    """
    kind = "maps of results by name, {'before': before.maps, 'after': after.maps}"
    check_instance(results, Mapping, "results", kind)
    for name, maps in results.items():
        check_instance(maps, xr.Dataset, f"results[{name!r}]", "the maps of a result (.maps)")
    if len(results) < 2:
        raise InputError(f"a comparison needs at least two results, got {len(results)}")
    for name, maps in results.items():
        if variable not in maps:
            raise InputError(f"{name}: has no map {variable!r}")
        if maps[variable].dtype.kind != "f":
            raise InputError(
                f"{variable}: holds states or flags, which have no difference; choose a map with a "
                "unit, such as axial_stress"
            )
    (first, reference), *others = results.items()
    base = check_map(reference[variable], first)
    shown, parts, shifts, errors, within = [base.drop_attrs()], [], [], [], []
    for name, maps in others:
        shift = (0.0, 0.0)
        if register:
            shift = _shift(reference, maps, first, name)
            moved = {axis: maps[axis] - s for axis, s in zip("yx", shift, strict=True)}
            maps = maps.assign_coords(moved)
        shifts.append(shift)
        field = check_map(maps[variable], name)
        part = compare_maps(field, base, edge_width).assign_coords(y=base["y"], x=base["x"])
        parts.append(part)
        here = (part["difference"] + base).drop_attrs()
        shown.append(here)
        mine, theirs = map_error(reference, variable), map_error(maps, variable)
        if mine is not None and theirs is not None:
            own = _on_pixels_of(check_map(theirs, f"{name}, error"), base)
            both = np.hypot(check_map(mine, f"{first}, error").values, own.values)
        else:
            both = np.full(base.shape, np.nan)
        errors.append(both)
        known = np.isfinite(both) & np.isfinite(part["difference"].values)
        close = np.abs(part["difference"].values[known]) <= both[known]
        within.append(float(close.mean()) if close.size else np.nan)
    units = {"units": base.attrs["units"]} if "units" in base.attrs else {}
    compared = [name for name, _ in others]
    result = xr.concat(parts, dim=xr.IndexVariable("compared", compared), join="exact")
    result["difference"].attrs = units | {"long_name": f"difference from {first}"}
    result[variable] = xr.concat(shown, dim=xr.IndexVariable("result", list(results)), join="exact")
    result[variable].attrs = dict(base.attrs)
    result["shift"] = (
        ("compared", "axis"),
        np.array(shifts),
        {"units": "mm", "long_name": "lateral shift that was taken back"},
    )
    result = result.assign_coords(axis=["y", "x"])
    if np.isfinite(errors).any():
        result["difference_error"] = (
            ("compared", "y", "x"),
            np.array(errors),
            units | {"long_name": "error of the difference"},
        )
        result["within_error"] = (
            "compared",
            within,
            {"units": "1", "long_name": "share of pixels that differ by no more than the error"},
        )
    result.attrs = {"edge_width_mm": edge_width, "reference": first, "variable": variable}
    return result


def _shift(reference: xr.Dataset, maps: xr.Dataset, first: str, name: str) -> tuple[float, float]:
    """Lateral shift (y, x), mm, of a result against the reference, from the loaded thickness."""
    pair = []
    for which, of in ((first, reference), (name, maps)):
        if "loaded_thickness" not in of:
            raise InputError(f"{which}: has no loaded_thickness to register by")
        pair.append(check_map(of["loaded_thickness"], which))
    fixed, moving = pair
    steps = pixel_size(fixed)
    if not np.allclose(steps, pixel_size(moving), rtol=1e-3):  # on pixels as large
        places = {
            axis: np.arange(moving[axis].values[0], moving[axis].values[-1] + 1e-6 * step, step)
            for axis, step in zip("yx", steps, strict=True)
        }
        # of one that is much larger no more than is compared
        moving = moving.interp({axis: at[: fixed.sizes[axis]] for axis, at in places.items()})
    n = [min(fixed.sizes[axis], moving.sizes[axis]) for axis in ("y", "x")]
    parts = [field.isel(y=slice(n[0]), x=slice(n[1])) for field in (fixed, moving)]
    return lateral_shift(*parts)
