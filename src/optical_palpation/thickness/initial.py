"""The unloaded thickness on the pixels of the loaded map, and whether the two fit together."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.arguments import flag, number
from optical_palpation.errors import InputError
from optical_palpation.thickness.frames import inside_layer, layer_extent_of, on_grid

#: Thinnest and thickest layer, mm: OCT resolves 0.002 mm or more along depth, and ultrasound sees
#: 40 mm deep.
THINNEST_LAYER, THICKEST_LAYER = 0.005, 100.0
# Median loaded over initial thickness outside this range is no compression but a wrong unit.
_PLAUSIBLE_RATIO = (0.01, 100.0)
# A lower one is more than any layer bears.
_HARDEST_PRESSED = 0.1
# Plausible widths of the layer over its thickness.
_PLAUSIBLE_ASPECT = (0.1, 500.0)
# Pixels further apart than this many thicknesses show nothing of a layer.
_PLAUSIBLE_SPACING = 10.0
# Share of the initial thickness by which a layer that keeps its volume is not thicker than it was
# over half of the map, if it is thinner by less than that elsewhere.
_RISE = 0.01
# Share by which something that presses a flat layer makes it thinner somewhere.
_PRESSED = 0.02
# Of the field of view of the initial map over that of the layer.
_PLAUSIBLE_SPAN = 50.0


def match_initial_thickness(
    initial: float | xr.DataArray, loaded: xr.DataArray, *, glued: bool = False
) -> xr.DataArray:
    """Put the initial (unloaded) thickness on the pixels of the loaded map and check the pair.

    Parameters
    ----------
    initial
        Number in mm, or a map as :func:`read_thickness_map` gives it, without missing values (see
        :func:`clean_thickness`) and covering the extent of the layer; it is interpolated linearly.
    loaded
        Loaded thickness, mm, on ``(y, x)``.
    glued
        Whether the sample is glued to the layer, and may pull it.

    Returns
    -------
    xarray.DataArray
        ``initial_thickness`` in mm on the coordinates of `loaded`. Attribute ``no_contact_share``:
        the share of the layer's measured pixels that are not thinner than initially, where the
        sample does not touch the layer; 0 where it is glued.

    Raises
    ------
    InputError
        If a thickness is not positive and finite, if `initial` does not cover the layer, if the
        two differ so much that a unit must be wrong, or if, the sample not being glued, no pixel of
        the layer is compressed or most are thicker than the others are compressed.
    """
    glued = flag(glued, "glued")
    loaded = on_grid(loaded, "loaded")
    if np.any(loaded.values <= 0.0) or np.any(np.isinf(loaded.values)):
        raise InputError("the loaded thickness must be positive and finite (NaN where missing)")
    inside = inside_layer(loaded)
    if isinstance(initial, xr.DataArray):
        values = _interpolated(initial, loaded)
    else:
        values = np.full(
            loaded.shape,
            number(initial, "initial thickness", "a positive and finite number of mm, or a map"),
        )
    if not np.all(np.isfinite(values)) or np.any(values <= 0.0):
        raise InputError(
            f"initial thickness must be positive and finite, found {values.min():g} to "
            f"{values.max():g} mm; missing values of a map can be filled with clean_thickness"
        )
    measured = inside & np.isfinite(loaded.values)
    if not measured.any():
        raise InputError("the loaded thickness is missing everywhere in the layer")
    now, before = loaded.values[measured], values[measured]
    depth = float(np.median(values))
    check_depth(depth, "initial thickness")
    check_depth(float(now.max()), "loaded thickness")
    _check_units(loaded, float(np.median(now)), depth)
    share = 0.0 if glued else float(np.mean(now >= before))
    if share == 1.0:
        raise InputError(
            f"the loaded thickness ({now.min():g} mm or more) is nowhere below "
            f"the initial thickness ({before.max():g} mm at most): nothing is pressed. "
            "Check the initial thickness and the length unit; only a glued sample can pull"
        )
    rise = now - before
    typical, pressed = float(np.median(rise)), -float(np.percentile(rise, 1))
    # An imprint that is computed may say how far the sample is from a flat layer where the two do
    # not touch; it presses the layer elsewhere.
    uneven = isinstance(initial, xr.DataArray) and _spread(before) > 0.5 * _spread(now)
    measured_so = uneven or -float(rise.min()) < _PRESSED * depth
    if not glued and measured_so and typical > max(pressed, _RISE * depth):
        thinner = 1e3 * max(pressed, 0.0)
        raise InputError(
            f"the loaded layer is thicker than the unloaded one, by {1e3 * typical:.3g} um in the "
            f"median, and on all but a hundredth of the map thinner by {thinner:.3g} um at most: "
            "are the two swapped? Check the initial thickness, too; a layer keeps its volume"
        )
    return (
        loaded.copy(data=values)
        .rename("initial_thickness")
        .assign_attrs(
            units="mm",
            long_name="initial (unloaded) thickness of the layer",
            no_contact_share=share,
        )
    )


def filled_there(filled: xr.DataArray, here: xr.DataArray) -> xr.DataArray:
    """Where an unloaded map that was ``filled`` is interpolated on the pixels of another map.

    Between pixels of another grid the thickness is interpolated, and what was filled counts.
    """
    within = {a: here[a].clip(filled[a].min(), filled[a].max()) for a in "yx"}
    found = filled.astype(float).interp(within).assign_coords({a: here[a] for a in "yx"}) > 1e-6
    return found.assign_attrs(filled.attrs)


def _spread(values: NDArray[np.float64]) -> float:
    """Range of all but a hundredth of the values at either end."""
    low, high = np.percentile(values, (1, 99))
    return float(high - low)


def check_depth(thickness: float, where: str) -> None:
    """Refuse a thickness (mm), of a map the largest, that no compliant layer has.

    Raises
    ------
    InputError
        With the thickness, and what may have happened.
    """
    if thickness > THICKEST_LAYER:
        raise InputError(
            f"{where}: a layer of {thickness:g} mm is thicker than {THICKEST_LAYER:g} mm. Lengths "
            "are in mm: divide by 1000 if it is in um, or say length_unit 'um' of a file"
        )
    if thickness < THINNEST_LAYER:
        raise InputError(
            f"{where}: a layer of {thickness:g} mm is thinner than {THINNEST_LAYER:g} mm, and can "
            "hardly be seen. Lengths are in mm: multiply by 1000 if it is in m, or if it was in mm "
            "and was read as um"
        )


def _interpolated(initial: xr.DataArray, loaded: xr.DataArray) -> NDArray[np.float64]:
    initial = on_grid(initial, "initial thickness")
    x, y = initial["x"].values, initial["y"].values
    extent = layer_extent_of(loaded)
    slack = 1e-6 * max(extent[1] - extent[0], extent[3] - extent[2])
    if (
        min(extent[0] - x[0], extent[2] - y[0]) < -slack
        or max(extent[1] - x[-1], extent[3] - y[-1]) > slack
    ):
        raise InputError(
            f"the map of initial thickness spans x {x[0]:g} to {x[-1]:g}, y {y[0]:g} to "
            f"{y[-1]:g} mm and does not cover the layer, {extent} (x0, x1, y0, y1)"
        )
    for axis, span, width in (
        ("x", x[-1] - x[0], extent[1] - extent[0]),
        ("y", y[-1] - y[0], extent[3] - extent[2]),
    ):
        if span > _PLAUSIBLE_SPAN * width:
            raise InputError(
                f"the map of initial thickness spans {span:g} mm along {axis}, the layer {width:g} "
                "mm: are the positions of one of them in um?"
            )
    at = {
        "x": np.clip(loaded["x"].values, x[0], x[-1]),
        "y": np.clip(loaded["y"].values, y[0], y[-1]),
    }
    if np.array_equal(at["x"], x) and np.array_equal(at["y"], y):
        return initial.values.astype(float)
    return initial.interp(at).values


def _check_units(loaded: xr.DataArray, loaded_median: float, initial_median: float) -> None:
    ratio = loaded_median / initial_median
    numbers = f"loaded {loaded_median:g} mm, initial {initial_median:g} mm (medians)"
    if ratio > _PLAUSIBLE_RATIO[1]:
        raise InputError(
            f"loaded and initial thickness do not fit: {numbers}. The loaded thickness is probably "
            "in um: divide an array by 1000; of a file, say length_unit 'um'"
        )
    if ratio < _PLAUSIBLE_RATIO[0]:
        raise InputError(
            f"loaded and initial thickness do not fit: {numbers}. Probably the initial thickness "
            "is in um: give it in mm; or the loaded thickness is in mm and was read as um"
        )
    if ratio < _HARDEST_PRESSED:
        raise InputError(
            f"loaded and initial thickness do not fit: {numbers}. No layer can be pressed to "
            f"{ratio:.1%} of its thickness; check the initial thickness"
        )
    x0, x1, y0, y1 = layer_extent_of(loaded)
    for axis, width in (("x", x1 - x0), ("y", y1 - y0)):
        if not _PLAUSIBLE_ASPECT[0] < width / initial_median < _PLAUSIBLE_ASPECT[1]:
            raise InputError(
                f"the layer is {width:g} mm wide along {axis} and {initial_median:g} mm thick, a "
                f"ratio of {width / initial_median:.3g}: one of them is probably not in mm (is the "
                "field of view or pixel spacing in um?)"
            )
        step = float(np.median(np.diff(loaded[axis].values)))
        if step > _PLAUSIBLE_SPACING * initial_median:
            raise InputError(
                f"pixels lie {step:g} mm apart along {axis}, {step / initial_median:.3g} times the "
                f"layer's thickness of {initial_median:g} mm: one of them is probably not in mm "
                "(is the pixel spacing or field of view in um?)"
            )
