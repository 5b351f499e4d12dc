"""Total force and mean stress, and their comparison with a load cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from optical_palpation.analysis.maps import area_mean, check_map, point_areas
from optical_palpation.errors import InputError


@dataclass(frozen=True)
class ForceBalance:
    """What a stress map adds up to, compression positive.

    Attributes
    ----------
    force
        Force over the pixels with a value, mN.
    mean_stress
        Force over their area, kPa.
    area
        Their area, mm2.
    missing
        Share of the map without a value.
    expected_stress
        Measured force over the area it acts on, kPa, or None.
    relative_difference
        ``mean_stress / expected_stress - 1``, or None.
    """

    force: float
    mean_stress: float
    area: float
    missing: float
    expected_stress: float | None = None
    relative_difference: float | None = None


def force_balance(
    axial_stress: xr.DataArray,
    measured_force: float | None = None,
    layer_area: float | None = None,
) -> ForceBalance:
    """Add up a stress map and compare it with a load cell (section 5 of the paper).

    Stress and not force is compared: the load cell feels the whole layer, the map shows the field
    of view.

    Parameters
    ----------
    axial_stress
        Axial stress on ``(y, x)``, kPa, negative where pressed; each value stands for the part
        of the map that is nearest to its point.
    measured_force
        Reading of the load cell, mN, compression positive.
    layer_area
        Area of the loaded layer in mm2; the map's area by default.

    Raises
    ------
    InputError
        If the map cannot be used, or force or area are not positive.
    """
    stress = check_map(axial_stress, "axial_stress")
    areas = point_areas(stress)
    area = float(areas.where(np.isfinite(stress)).sum())
    mean = -area_mean(stress)
    force = mean * area
    expected = difference = None
    if measured_force is not None:
        of = area if layer_area is None else layer_area
        if not (measured_force > 0.0 and of > 0.0):
            raise InputError(
                f"measured force {measured_force:g} mN and layer area {of:g} mm2 must be positive"
            )
        expected = measured_force / of
        difference = mean / expected - 1.0
    return ForceBalance(force, mean, area, 1.0 - area / float(areas.sum()), expected, difference)
