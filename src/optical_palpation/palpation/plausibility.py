"""Whether the numbers of a computation can be those of a layer, taken by themselves and together.

What cannot be is refused; what is only unusual is said. The limits are those of matter and of
instruments, far from what measurements come near to.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.errors import InputError, MaterialError
from optical_palpation.material import Law

#: Young's modulus, kPa: the hardest rubbers have 20 MPa (Shore A 95) ...
HARDEST_LAYER = 2e4
#: ... and PDMS as it is sold for soft lithography (Sylgard 184, 10 : 1) has up to 3 MPa: a layer
#: stiffer than that is no compliant one.
STIFF_LAYER = 3e3
#: The softest gels that keep their shape, as polyacrylamide of 3 %, have 0.1 kPa.
SOFT_LAYER = 0.1
#: Mean stress, kPa: ten atmospheres. It presses on a field of 5 x 5 mm with the weight of 2.5 kg;
#: soft tissue is destroyed by a tenth of it.
LARGEST_MEAN_STRESS = 1e3
#: Widest field, mm: an ultrasound array sees 60 mm.
WIDEST_FIELD = 500.0
#: More elements than any machine holds; their layout alone would take minutes.
MOST_ELEMENTS = 1e8
#: Fraction by which a map may add up to another force than the elements beneath it, because it has
#: points where these have surfaces: 5 % on coarse elements, 9 % where only 3 x 3 points touch.
MAP_FORCE = 0.1
#: Change of the force by what the map shows beyond the layer's extent from which it is told. Where
#: that is the bulge of the layer it is less, in virtual experiments 1 to 9 %.
BEYOND_EXTENT = 0.1
#: Hydrostatic tension, in Young's moduli, at which bonded rubber tears open from within (Gent and
#: Lindley, Proc. R. Soc. A 249:195, 1959).
CAVITATION = 5 / 6

#: What a result without a sample in the model does not know.
SOFT_SAMPLE = (
    "the sample is taken not to move sideways: one as soft as the layer spreads, and its true "
    "stress may be half of this. Its thickness and the travel of the plate put it into the model "
    "([sample] of a study, or --sample-thickness and --compression)"
)


def check_layer(law: Law) -> None:
    """Refuse a law stiffer than any rubber.

    Raises
    ------
    MaterialError
        With its Young's modulus, and what may have happened.
    """
    modulus = law.initial_youngs_modulus
    if modulus > HARDEST_LAYER:
        raise MaterialError(
            f"the layer's initial Young's modulus would be {modulus / 1e3:.3g} MPa, and the hardest"
            f" rubbers have {HARDEST_LAYER / 1e3:g} MPa. Coefficients are in kPa: divide them by "
            "1000 if they are in Pa"
        )


def check_field(width: float, height: float, where: str) -> None:
    """Refuse a field of view (mm) wider than any instrument sees.

    Raises
    ------
    InputError
        With the width, and what may have happened.
    """
    if max(width, height) > WIDEST_FIELD:
        raise InputError(
            f"{where}: the field of view would be {width:g} x {height:g} mm, and no instrument sees"
            f" {WIDEST_FIELD:g} mm. Lengths are in mm: divide the spacing by 1000 if it is in um"
        )


def check_elements(
    size: float | Sequence[float], field: tuple[float, float], depth: float, what: str
) -> None:
    """Refuse elements (mm) that are larger than what they are to resolve.

    Parameters
    ----------
    size
        Size of the elements, one number or x, y and z.
    field
        Width of the field of view along x and y.
    depth
        A thickness that the layer does not exceed.
    what
        What that thickness is, in words.

    Raises
    ------
    InputError
        Naming the axis and the limit.
    """
    x, y, z = (float(v) for v in np.broadcast_to(np.atleast_1d(size), 3))
    for axis, value, limit, of in (
        ("z", z, depth, what),
        ("x", x, 0.25 * field[0], "a quarter of the field of view"),
        ("y", y, 0.25 * field[1], "a quarter of the field of view"),
    ):
        if value > limit * (1 + 1e-9):
            raise InputError(
                f"the element size along {axis}, {value:g} mm, is larger than {of}, {limit:g} mm; "
                "give a smaller one (it is in mm)"
            )


def check_count(
    size: float | Sequence[float], field: tuple[float, float], thickness: float | None
) -> None:
    """Refuse elements (mm) that are too many for any memory.

    Parameters
    ----------
    size, field
        As for :func:`check_elements`.
    thickness
        Of the layer; where it is not known yet there is one element across it, at least.

    Raises
    ------
    InputError
        With their number.
    """
    x, y, z = (float(v) for v in np.broadcast_to(np.atleast_1d(size), 3))
    across = 1.0 if thickness is None else thickness / z
    count = field[0] / x * field[1] / y * across
    if count > MOST_ELEMENTS:
        least = "at least " if thickness is None else ""
        raise InputError(
            f"elements of {x:g} x {y:g} x {z:g} mm would be {least}{count:.1e} in all, beyond any "
            "memory; give a larger element_size (it is in mm)"
        )


def check_stress(algebraic: xr.DataArray) -> None:
    """Refuse a mean stress that no sample bears.

    Parameters
    ----------
    algebraic
        Stress by the algebraic method, kPa, which costs nothing and tells the order of magnitude.

    Raises
    ------
    InputError
        With the stress, and what may have happened.
    """
    mean = abs(float(algebraic.mean()))
    if mean > LARGEST_MEAN_STRESS:
        raise InputError(
            f"the layer would bear {mean:.4g} kPa on average, more than {LARGEST_MEAN_STRESS:g} kPa"
            " (ten atmospheres), which samples and windows do not. Are the material's coefficients"
            " in Pa (divide them by 1000), or is the loaded map not that of this layer?"
        )


def unusual_layer(law: Law) -> list[str]:
    """Say what is possible but rare about the material of a layer."""
    modulus = law.initial_youngs_modulus
    if modulus > STIFF_LAYER:
        return [
            f"the layer is as stiff as hard rubber (Young's modulus {modulus / 1e3:.3g} MPa): are "
            "its coefficients in kPa?"
        ]
    if modulus < SOFT_LAYER:
        return [
            f"the layer is softer than gels that keep their shape (Young's modulus "
            f"{1e3 * modulus:.3g} Pa): are its coefficients in kPa?"
        ]
    return []


def unusual(law: Law, maps: xr.Dataset) -> list[str]:
    """Say what is possible but rare about a layer and its result.

    Parameters
    ----------
    law
        Law of the layer.
    maps
        Maps of a result, with ``loaded_thickness`` and the attribute ``initial_thickness_mm``.
    """
    said = unusual_layer(law)
    thickness = maps.attrs["initial_thickness_mm"]
    width = min(float(np.ptp(maps[axis].values)) for axis in "yx")
    if thickness > width:
        said.append(
            f"the layer is thicker ({thickness:.3g} mm) than the field of view is wide "
            f"({width:.3g} mm): its sides decide the stress everywhere"
        )
    if abs(change := maps.attrs.get("beyond_extent_force", 0.0)) > BEYOND_EXTENT:
        said.append(
            f"what the map shows beyond the extent of the layer, over which its free sides bulge, "
            f"makes a difference of {100 * abs(change):.2g} % to the force: if the layer does not "
            "reach there, mark these pixels as missing"
        )
    said += misread(maps.attrs)
    limit = CAVITATION * law.initial_youngs_modulus
    pulled = -float(maps["contact_pressure"].min()) if "contact_pressure" in maps else 0.0
    if pulled > limit:
        said.append(
            f"the glued sample pulls the layer with up to {pulled:.3g} kPa, and bonded rubber of "
            f"its modulus tears open from within at about {limit:.3g} kPa"
        )
    return said


def misread(attrs: Mapping[Hashable, Any]) -> list[str]:
    """Say where the map of a result shows another force than there is."""
    if (difference := attrs.get("map_force_difference", 0.0)) <= MAP_FORCE:
        return []
    return [
        f"the stress map adds up to a force that differs by {100 * difference:.3g} % from what the "
        f"elements beneath it carry ({attrs['map_force_mN']:.4g} mN): it shows values that are not "
        "there, or misses some, probably where a rim folds. Smaller elements or padded edges "
        "may help; do not trust its peaks or its mean"
    ]
