"""The algebraic method (section 3 of the paper): each pixel an independent uniaxial test."""

from __future__ import annotations

import json

import numpy as np
import xarray as xr

from optical_palpation.arguments import check_instance, explained
from optical_palpation.errors import MaterialError
from optical_palpation.material import Law
from optical_palpation.palpation.plausibility import unusual
from optical_palpation.palpation.result import StressResult
from optical_palpation.thickness.frames import inside_layer, on_grid
from optical_palpation.thickness.initial import match_initial_thickness


@explained
def algebraic_stress(
    loaded: xr.DataArray,
    initial_thickness: float | xr.DataArray,
    material: Law,
    *,
    glued: bool = False,
) -> xr.DataArray:
    """Axial stress from the strain of each pixel alone, ``E(strain) * strain``.

    The strain is ``(L1 - L0) / L0`` and E the strain-adjusted (secant) Young's modulus of the
    incompressible layer in a uniaxial test without friction; the bulk-to-shear ratio does not
    enter. The stress is the axial Cauchy stress, force per deformed area, because it is compared
    with the Cauchy stress of the computational method and the map shows the deformed layer.

    Parameters
    ----------
    loaded
        Loaded thickness L1 in mm on ``(y, x)``.
    initial_thickness
        Initial thickness L0 in mm, a number or a map, see
        :func:`~optical_palpation.thickness.match_initial_thickness`.
    material
        Law of the layer.
    glued
        Whether the sample is glued to the layer: where L1 > L0 it then pulls.

    Returns
    -------
    xarray.DataArray
        ``algebraic_axial_stress`` in kPa on the coordinates of `loaded`, negative where the layer
        is pressed, exactly zero where it is not (L1 >= L0) unless it is glued, NaN where `loaded`
        is missing or outside the layer's extent.

    Raises
    ------
    InputError
        If loaded and initial thickness are no thicknesses or do not fit together.
    MaterialError
        If a pixel is compressed or stretched beyond the strain up to which the material is stable.
    """
    _check_law(material)
    loaded = on_grid(loaded, "loaded")
    initial = match_initial_thickness(initial_thickness, loaded, glued=glued)
    return stress_of_pixels(loaded, initial, material, glued=glued)


def _check_law(material: Law) -> None:
    kind = "a law such as MooneyRivlin(c10=..., c01=...), moduli in kPa"
    check_instance(material, Law, "material", kind)


def stress_of_pixels(
    loaded: xr.DataArray, initial: xr.DataArray, material: Law, *, glued: bool = False
) -> xr.DataArray:
    """As :func:`algebraic_stress`, of maps that ``match_initial_thickness`` has put together."""
    _check_law(material)
    stretch = np.where(inside_layer(loaded), loaded.values / initial.values, np.nan)
    lowest, highest = material.stable_stretches()
    if not glued:
        # Out of contact the layer bears nothing: the map shows the gap, not a stretched layer.
        stretch = np.minimum(stretch, 1.0)
    elif np.nanmax(stretch) >= highest:
        raise MaterialError(
            f"the layer is stretched by {100 * (np.nanmax(stretch) - 1):.3g} %, but the material "
            f"{material.describe()} is stable only up to {100 * (highest - 1):.3g} %"
        )
    if np.nanmin(stretch) <= lowest:
        raise MaterialError(
            f"the layer is compressed by {100 * (1 - np.nanmin(stretch)):.3g} %, but the material "
            f"{material.describe()} is stable only up to "
            f"{100 * (1 - lowest):.3g} %"
        )
    strain = stretch - 1.0
    stress = loaded.copy(data=material.strain_adjusted_modulus(strain) * strain)
    stress.attrs = {
        "units": "kPa",
        "long_name": "axial Cauchy stress, algebraic method",
        "no_contact_share": initial.attrs["no_contact_share"],
    }
    return stress.rename("algebraic_axial_stress")


@explained
def algebraic_result(
    loaded: xr.DataArray,
    initial_thickness: float | xr.DataArray,
    material: Law,
    *,
    glued: bool = False,
) -> StressResult:
    """Compute the algebraic stress as a result that can be drawn, written and summarised.

    Parameters and errors are those of :func:`algebraic_stress`.

    Returns
    -------
    StressResult
        Maps on the pixels of `loaded`: ``axial_stress`` and the same as
        ``algebraic_axial_stress`` (kPa) and ``loaded_thickness`` (mm). The uniaxial test of each
        pixel knows no contact: there is neither a ``contact_state`` nor a ``layer``.
    """
    loaded = on_grid(loaded, "loaded")
    initial = match_initial_thickness(initial_thickness, loaded, glued=glued)
    stress = stress_of_pixels(loaded, initial, material, glued=glued)
    maps = xr.Dataset(
        {
            "axial_stress": stress,
            "algebraic_axial_stress": stress,
            "loaded_thickness": loaded,
        },
        attrs={
            "method": "algebraic",
            **material.attributes,
            "initial_thickness_mm": float(initial.where(inside_layer(loaded)).mean()),
            "no_contact_share": stress.attrs["no_contact_share"],
        },
    )
    maps.attrs["unusual"] = json.dumps(unusual(material, maps))
    return StressResult(maps)
