"""What is known of a deformable sample and of how it was pressed, and whether it can be so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import xarray as xr

from optical_palpation.arguments import check_instance, explained_fields, numbers
from optical_palpation.errors import InputError
from optical_palpation.material import Law
from optical_palpation.palpation.input_errors import INPUT_ERRORS
from optical_palpation.palpation.plausibility import LARGEST_MEAN_STRESS, WIDEST_FIELD
from optical_palpation.thickness.frames import (
    inside_layer,
    layer_extent_of,
    on_grid,
    typical_thickness,
)

#: By how much larger elements are, at least, of the mesh on which sensitivities are computed.
COARSER = 2.0
#: Share of the travel that a sample must take, or it is as good as rigid: nobody knows the travel
#: much better.
RIGID = 0.03
#: Share of the sample's thickness by which it can be compressed at most.
_MOST_COMPRESSED = 0.7
#: Loads must differ by this share of the travel, or force, at least.
_DIFFERENT = 0.02
#: Least and most force, in multiples of what the layer bears by uniaxial stress alone: where it
#: sticks, a thin one bears much more.
_FORCES = (1e-2, 1e3)
_MEANING = {
    "compression": ": it is how far the plate moves after layer and sample have met",
}


@explained_fields
@dataclass(frozen=True)
class Sample:
    """What is known of a deformable sample.

    Attributes
    ----------
    thickness
        Unloaded, mm; that below a relief of 0, or the mean one where the relief is sought.
    compression
        Travel of the plate after layer and sample have met, mm; of a series of loads one for each,
        ascending. ``None`` if the force is given.
    plate_friction
        Coulomb coefficient between sample and plate.
    relief
        Height of the unloaded surface on ``(y, x)``, mm, towards the layer; ``"flat"``; or None:
        then it is found from a series of loads, and flat with one load.
    size
        Width along x and y, mm; by default that of the layer, below which it is centred.
    law
        Its law; only how stress grows with strain counts, the stiffness is what is sought. By
        default neo-Hookean and incompressible.
    total_force
        On the window, mN; of a series one for each load. In place of the travel of the plate, which
        is then found too, or beside it, as a check.
    """

    thickness: float
    compression: float | Sequence[float] | None
    plate_friction: float
    relief: xr.DataArray | Literal["flat"] | None = None
    size: tuple[float, float] | None = None
    law: Law | None = None
    total_force: float | Sequence[float] | None = None

    def __post_init__(self) -> None:
        for name in ("thickness", "plate_friction"):
            _check_number(name, getattr(self, name))
        for name in ("compression", "total_force"):
            for value in np.atleast_1d(getattr(self, name)).tolist():
                if getattr(self, name) is not None:
                    _check_number(name, value)
        if self.law is not None:
            check_instance(self.law, Law, "sample: law", "a law such as material.NeoHookean")
        if self.size is not None:
            numbers(self.size, 2, "sample: size", "two positive numbers of mm, x and y")

    @property
    def travels(self) -> tuple[float, ...] | None:
        """The travel at each load, mm; None if forces are given."""
        return _each(self.compression)

    @property
    def forces(self) -> tuple[float, ...] | None:
        """The total force at each load, mN; None if it is not known."""
        return _each(self.total_force)

    @property
    def relief_is_sought(self) -> bool:
        """Whether the relief is to be found."""
        given = self.travels or self.forces
        return self.relief is None and given is not None and len(given) > 1


def _each(given: float | Sequence[float] | None) -> tuple[float, ...] | None:
    if given is None:
        return None
    return tuple(np.atleast_1d(given).tolist())


def as_loads(loaded: xr.DataArray | Sequence[xr.DataArray]) -> list[xr.DataArray]:
    """Return the maps of one load or several, each on ``(y, x)``.

    Raises
    ------
    InputError
        If there are none, or they do not show the same layer.
    """
    maps = [loaded] if isinstance(loaded, xr.DataArray | xr.Dataset) else list(loaded)
    if not maps:
        raise InputError("sample: at least one map of the loaded thickness is needed")
    maps = [on_grid(each, "loaded") for each in maps]
    *others, last = (layer_extent_of(each) for each in maps)
    slack = 1e-3 * max(last[1] - last[0], last[3] - last[2])
    for n, extent in enumerate(others, start=1):
        if not np.allclose(extent, last, rtol=0, atol=slack):
            raise InputError(
                f"map {n} of {len(maps)} shows a layer of x {extent[0]:g} to {extent[1]:g}, y "
                f"{extent[2]:g} to {extent[3]:g} mm, the last one x {last[0]:g} to {last[1]:g}, y "
                f"{last[2]:g} to {last[3]:g} mm: all loads must show the same part of the layer"
            )
    return maps


def check_sample(
    sample: Sample,
    loaded: xr.DataArray | Sequence[xr.DataArray],
    initial: xr.DataArray,
    layer: Law,
) -> None:
    """Refuse a sample that cannot be, or cannot be pressed like that.

    Parameters
    ----------
    sample
        What is known of it.
    loaded
        The loaded thickness, mm, or that of each load, in the order of loading.
    initial
        The unloaded thickness on the pixels of the last one, mm.
    layer
        Law of the layer.

    Raises
    ------
    InputError
    """
    check_instance(sample, Sample, "sample", "an optical_palpation.Sample")
    loads = as_loads(loaded)
    if sample.compression is None and sample.total_force is None:
        raise InputError(
            "sample: give the compression (the travel of the plate, mm) or the total force (mN)"
        )
    _check_numbers(sample, len(loads))
    _check_shape(sample, loads[-1])
    inside = inside_layer(loads[-1])
    if not bool((initial - loads[-1]).where(inside).max() > 0):
        raise InputError("the sample does not touch the layer: it is nowhere thinner than unloaded")
    if sample.forces is not None:
        _check_force(sample.forces[-1], loads[-1], initial, layer)
    if sample.travels is None and sample.relief_is_sought:
        raise InputError(
            "sample: total forces alone do not tell relief from stiffness: give the "
            'compression of each load, or the relief ("flat" if it is)'
        )
    if sample.travels is None:
        _check_order(sample.forces or (), "mN", loads)
    else:
        _check_order(sample.travels, "mm", loads)
        _check_travels(sample, sample.travels, loads, initial)
    _check_different(loads)


def _check_travels(
    sample: Sample,
    travels: Sequence[float],
    loads: Sequence[xr.DataArray],
    initial: xr.DataArray,
) -> None:
    """Refuse travels of the plate that layer and sample cannot have taken."""
    together = typical_thickness(initial) + sample.thickness
    for n, (travel, measured) in enumerate(zip(travels, loads, strict=True), start=1):
        here = "" if len(loads) == 1 else f" of load {n}"
        if travel >= together:
            raise InputError(
                f"sample: the compression{here}, {travel:g} mm, is more than layer and sample "
                f"together are thick, {together:g} mm; lengths are in mm"
            )
        unloaded = initial if measured is loads[-1] else initial.interp_like(measured)
        typical = float((unloaded - measured).where(inside_layer(measured)).median())
        # The travel counts from the first contact, whatever the relief.
        if typical > (1 + RIGID) * travel:
            raise InputError(
                f"sample: the layer is thinner by {typical:.3g} mm, more than the compression"
                f"{here} of {travel:g} mm: the plate cannot have moved less than the layer gave way"
            )
        left = travel - typical
        if left > _MOST_COMPRESSED * sample.thickness:
            raise InputError(
                f"sample: of the compression{here} of {travel:g} mm the layer takes "
                f"{typical:.3g} mm, and the rest is more than {_MOST_COMPRESSED:.0%} of the "
                f"sample's thickness, {sample.thickness:g} mm"
            )


def _check_numbers(sample: Sample, loads: int) -> None:
    """Refuse numbers that are none, or cannot be."""
    if sample.thickness <= 0:
        raise InputError(f"sample: the thickness must be positive, not {sample.thickness:g} mm")
    if not 0 <= sample.plate_friction <= 2:
        raise InputError(f"sample: plate_friction must lie in 0 ... 2, not {sample.plate_friction}")
    words = {"compression": "compression", "total_force": "total force"}
    for name, units in (("compression", "mm"), ("total_force", "mN")):
        given = getattr(sample, name)
        if given is None:
            continue
        for value in np.atleast_1d(given).tolist():
            if value <= 0:
                raise InputError(
                    f"sample: the {words[name]}, {value:g} {units}, must be positive"
                    + _MEANING.get(name, "")
                )
        each = _each(given) or ()
        if len(each) != loads:
            raise InputError(
                f"sample: {len(each)} values of the {words[name]} for {loads} maps: give one for "
                "each"
            )
        if not (np.diff(each) > _DIFFERENT * each[-1]).all():
            said = ", ".join(f"{value:g}" for value in each)
            raise InputError(
                f"sample: the {words[name]} must rise from map to map, by {_DIFFERENT:.0%} of the "
                f"largest at least, not {said} {units}: give the maps in the order of loading"
            )


def _check_order(given: Sequence[float], units: str, loads: Sequence[xr.DataArray]) -> None:
    """Refuse maps that are not in the order of rising load, as the thickness tells."""
    for n, (first, second) in enumerate(pairwise(loads), start=1):
        thicker = (second - first.interp_like(second)).where(inside_layer(second)).mean()
        if thicker > INPUT_ERRORS.thickness:
            raise InputError(
                f"sample: the layer of map {n + 1} of {len(loads)}, for {given[n]:g} {units}, is "
                f"{1e3 * float(thicker):.3g} um thicker on average than that of map {n}, for "
                f"{given[n - 1]:g} {units}: a layer gets thinner under rising load. Give the maps "
                "in the order of loading, and the numbers in the same order"
            )


def _check_different(loads: Sequence[xr.DataArray]) -> None:
    """Refuse a map that is given twice."""
    for n, (first, second) in enumerate(pairwise(loads), start=1):
        if first.equals(second):
            raise InputError(
                f"sample: maps {n} and {n + 1} of {len(loads)} are the same: give that of each load"
            )


def _check_force(force: float, loaded: xr.DataArray, initial: xr.DataArray, layer: Law) -> None:
    """Refuse a force (mN) far from what the thinning of the layer can take."""
    x0, x1, y0, y1 = layer_extent_of(loaded)
    area = (x1 - x0) * (y1 - y0)
    thinning = float((1.0 - loaded / initial).clip(min=0.0).where(inside_layer(loaded)).mean())
    bears = area * thinning * layer.initial_youngs_modulus
    low, high = _FORCES[0] * bears, min(_FORCES[1] * bears, LARGEST_MEAN_STRESS * area)
    if not low <= force <= high:
        raise InputError(
            f"sample: the total force, {force:g} mN, is far from the {bears:.2g} mN or so that a "
            f"layer of this stiffness bears where it is pressed as the map shows ({low:.2g} to "
            f"{high:.2g} mN could be). It is in mN"
        )


def _check_number(name: str, value: Any) -> None:
    if not (isinstance(value, int | float | np.number) and np.isfinite(value)):
        raise InputError(f"sample: {name} must be a number, not {value!r}")


def check_sample_elements(
    element_size: float, layer: tuple[float, float], sample: tuple[float, float] | None
) -> None:
    """Refuse elements (mm) that are too large for the widths of layer and sample along x and y.

    Raises
    ------
    InputError
        Naming the axis and the limit.
    """
    for axis, *widths in zip("xy", layer, sample or layer, strict=True):
        limit = 0.25 * min(widths) / COARSER
        if element_size > limit * (1 + 1e-9):
            raise InputError(
                f"the element size, {element_size:g} mm, is larger than an eighth of the smaller "
                f"of layer and sample along {axis}, {limit:g} mm: a mesh {COARSER:g} times as "
                "coarse is solved beside it; give a smaller one (it is in mm)"
            )


def _check_shape(sample: Sample, loaded: xr.DataArray) -> None:
    """Refuse a size or relief that no sample below this layer has."""
    x0, x1, y0, y1 = layer_extent_of(loaded)
    size = (x1 - x0, y1 - y0) if sample.size is None else sample.size
    if len(size) != 2 or not all(np.isfinite(width) and width > 0 for width in size):
        raise InputError(f"sample: size must be two positive numbers of mm, x and y, not {size!r}")
    if sample.thickness > WIDEST_FIELD:
        raise InputError(
            f"sample: a thickness of {sample.thickness:g} mm is more than {WIDEST_FIELD:g} mm; "
            "lengths are in mm: divide by 1000 if it is in um"
        )
    if sample.relief is None:
        return
    if isinstance(sample.relief, str):
        if sample.relief != "flat":
            raise InputError(f'sample: the relief is a map or "flat", not {sample.relief!r}')
        return
    try:
        relief = on_grid(sample.relief, "relief")
    except InputError as error:
        raise InputError(f"sample: the relief is no map of heights in mm: {error}") from error
    if absent := int((~np.isfinite(relief.values)).sum()):
        raise InputError(
            f"sample: the relief has {absent} missing values: fill them first, smoothly"
        )
    height = float(np.ptp(relief.values))
    if height >= sample.thickness:
        raise InputError(
            f"sample: the relief is {height:.3g} mm from its lowest to its highest point, more "
            f"than the sample is thick, {sample.thickness:g} mm; lengths are in mm"
        )
    for axis, low, high, width in (("x", x0, x1, size[0]), ("y", y0, y1, size[1])):
        at = relief[axis].values
        half = 0.5 * min(high - low, width)
        first, last = 0.5 * (low + high) - half, 0.5 * (low + high) + half
        pixel = float(np.diff(at).max())
        if at[0] > first + pixel or at[-1] < last - pixel:
            raise InputError(
                f"sample: the relief spans {axis} {at[0]:g} to {at[-1]:g} mm and does not cover "
                f"what lies below the layer, {first:g} to {last:g} mm"
            )
