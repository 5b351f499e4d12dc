"""What a file must hold to be a result: maps on (y, x) in mm and kPa, and a whole layer.

Other programs write results, too, after a change of units or of the order of axes. Statistics and
figures would take their numbers as they are.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
import xarray as xr

from optical_palpation.errors import InputError
from optical_palpation.volume.units import length_unit

_FORCE = re.compile(r"(?:(?:sample|window|map)_force|force_(?:\w+_)?error|force_rim_model)_mN")
#: Parts of a layer, and their dimensions.
_LAYER = {
    "position": "z y x component",
    "displacement": "z y x component",
    "cauchy_stress": "cell_z cell_y cell_x tensor",
    "sample_traction": "y x component",
    "window_traction": "y x component",
    "sample_contact_state": "y x",
    "window_contact_state": "y x",
}
_NAMES = {"component": ["x", "y", "z"], "tensor": ["xx", "yy", "zz", "yz", "xz", "xy"]}


def check_maps(maps: xr.Dataset, units: Mapping[str, str], where: str) -> None:
    """Refuse maps that are not on rising x and y in mm, or not in the units of a result.

    Parameters
    ----------
    maps
        As read.
    units
        What a variable of a name is in. One that states nothing is.
    where
        Names them in errors.

    Raises
    ------
    InputError
        If they are so, or a force is no number.
    """
    for axis in ("y", "x"):
        if axis not in maps.coords or maps[axis].dims != (axis,):
            raise InputError(f"{where}: has no coordinate {axis}, the position of its points in mm")
        at = maps[axis].values
        if at.dtype.kind not in "iuf" or not np.isfinite(at).all() or (np.diff(at) <= 0.0).any():
            raise InputError(f"{where}: its coordinate {axis} must be numbers in mm that rise")
    _check_units(maps, units, where)
    for name, variable in maps.data_vars.items():
        if not {"x", "y"} <= set(variable.dims):
            continue
        if variable.dims != ("y", "x"):
            raise InputError(
                f"{where}: {name} has the dimensions ({', '.join(map(str, variable.dims))}), not "
                "(y, x); transpose it, or select one map"
            )
        if variable.dtype.kind not in "biuf":
            raise InputError(f"{where}: {name} holds {variable.dtype}, not real numbers")
    forces = {key: value for key, value in maps.attrs.items() if _FORCE.fullmatch(str(key))}
    for key, value in forces.items():
        if not isinstance(value, int | float | np.integer | np.floating):
            raise InputError(f"{where}: its attribute {key} is {value!r}, no number of mN")
    if forces and "sample_force_mN" not in forces:
        raise InputError(f"{where}: states {min(forces)}, but no force sample_force_mN")


def check_layer(layer: xr.Dataset, units: Mapping[str, str], where: str) -> None:
    """Refuse a layer that lacks a part, or has one on other dimensions or in another unit.

    Raises
    ------
    InputError
        If it is so.
    """
    for name, dims in _LAYER.items():
        if name not in layer.data_vars:
            raise InputError(f"{where}: its layer lacks {name}; write the result anew")
        variable = layer[name]
        if variable.dims != tuple(dims.split()) or variable.dtype.kind not in "biuf":
            raise InputError(
                f"{where}: {name} of the layer should be numbers on ({dims.replace(' ', ', ')}), "
                f"not {variable.dtype} on ({', '.join(map(str, variable.dims))})"
            )
    for axis in ("x", "y", "z"):
        if layer.sizes[f"cell_{axis}"] != layer.sizes[axis] - 1:
            raise InputError(
                f"{where}: the layer has {layer.sizes[axis]} nodes along {axis}, but "
                f"{layer.sizes[f'cell_{axis}']} elements"
            )
    for dim, names in _NAMES.items():
        found = [str(name) for name in layer[dim].values] if dim in layer.coords else []
        if found != names:
            raise InputError(
                f"{where}: the layer's {dim} should be {', '.join(names)}, not "
                f"{', '.join(found) or 'without names'}"
            )
    _check_units(layer, units, f"{where}, layer")


def check_points(part: xr.Dataset, maps: xr.Dataset, where: str) -> None:
    """Refuse a part of a result that does not lie on the points of its maps.

    Raises
    ------
    InputError
        If it is so.
    """
    for axis in ("y", "x"):
        if part.sizes.get(axis, maps.sizes[axis]) != maps.sizes[axis]:
            raise InputError(
                f"{where}: has {part.sizes[axis]} points along {axis}, the maps have "
                f"{maps.sizes[axis]}: it is of another result"
            )


def _check_units(dataset: xr.Dataset, units: Mapping[str, str], where: str) -> None:
    for name, variable in dataset.variables.items():
        needed = units.get(str(name), "kPa" if str(name).startswith("axial_stress") else "")
        said = str(variable.attrs.get("units", needed))
        known = length_unit(said) == "mm" if needed == "mm" else said.strip().lower() == "kpa"
        if needed in ("mm", "kPa") and not known:
            raise InputError(
                f"{where}: {name} is in {said!r}, a result has it in {needed}; convert it, and its "
                "attribute units with it"
            )
