"""Problem and state of a result as groups of a NetCDF file, and back to the last bit."""

from __future__ import annotations

import dataclasses
import json
import typing
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.errors import MaterialError
from optical_palpation.material import Law, make_law
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.palpation.result import StressResult

#: Groups of the file, and the field of the result that each holds.
GROUPS = {"problem": LayerProblem, "state": LayerState}


def state_groups(result: StressResult) -> dict[str, xr.Dataset]:
    """Return the groups that hold problem and state, none where the result has no state."""
    if result.problem is None or result.state is None:
        return {}
    return {name: _packed(getattr(result, name)) for name in GROUPS}


def read_state(groups: Mapping[str, xr.Dataset]) -> dict[str, Any]:
    """Return ``problem`` and ``state`` from their groups.

    Nothing, where there are none, or where a version of the software wrote them whose problems or
    states are made of other parts: they are no solution of the problem as this version poses it.
    """
    try:
        found = {name: _unpacked(kind, groups[name]) for name, kind in GROUPS.items()}
    except (KeyError, TypeError, ValueError, MaterialError):
        return {}
    grid = found["problem"].grid
    if found["state"].u.shape != (3, *grid.node_shape) or found["state"].p.shape != grid.shape:
        return {}
    return found


def _packed(item: Any, prefix: str = "") -> xr.Dataset:
    """Fields of a dataclass as variables (arrays) and attributes (all else, as JSON)."""
    variables: dict[str, Any] = {}
    attrs: dict[str, Any] = {}
    for part in dataclasses.fields(item):
        name, value = prefix + part.name, getattr(item, part.name)
        if isinstance(value, np.ndarray):
            variables[name] = ([f"{name}_{k}" for k in range(value.ndim)], value)
        elif isinstance(value, Law):
            attrs[name] = json.dumps(value.arguments)
        elif dataclasses.is_dataclass(value):
            inner = _packed(value, f"{name}.")
            variables |= {str(k): v for k, v in inner.variables.items()}
            attrs |= inner.attrs
        else:
            attrs[name] = json.dumps(value, default=float)
    return xr.Dataset(variables, attrs=attrs)


def _unpacked(kind: Any, group: xr.Dataset, prefix: str = "") -> Any:
    types = typing.get_type_hints(kind)
    values: dict[str, Any] = {}
    for part in dataclasses.fields(kind):
        name = prefix + part.name
        if name in group:
            values[part.name] = group[name].values
        elif name in group.attrs:
            value = json.loads(group.attrs[name])
            if types[part.name] is Law:
                value = make_law(**value)
            values[part.name] = tuple(value) if isinstance(value, list) else value
        elif dataclasses.is_dataclass(types[part.name]):
            values[part.name] = _unpacked(types[part.name], group, f"{name}.")
        else:
            raise KeyError(name)
    return kind(**values)
