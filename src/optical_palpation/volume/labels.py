"""Arrays with labelled axes: which axis is x, and where its points lie."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .axes import SYNONYMS, axes_of_dimensions, unclear_dimension
from .contents import Contents, Variable
from .units import MM, is_unit_key, split_unit, stated_unit

_ALL = (slice(None),) * 32
#: Most values of a map or a coordinate.
MAX_VALUES = 2**24
_POSITION = re.compile(r"([xyz])(?:s|_?(?:pos|position|coord|coordinate|axis)s?)")
#: Unit of coordinates that are numbers of pixels.
PIXEL = "pixel"
_COUNTS = {"", "1", "-", "px", "pix", PIXEL, "pixels", "index", "sample", "samples"}
_COUNTED = re.compile(r".*[_\s.(\[-](px|pix|pixels?|idx|index)[)\]]?", re.IGNORECASE)
_STANDARD = {"projection_x_coordinate": "x", "projection_y_coordinate": "y"}


@dataclass(frozen=True)
class Coordinate:
    """Positions along an axis, as stored: ``(n,)``, or those of every pixel, and their unit.

    ``counted`` marks numbers of pixels, by their unit or as whole numbers without one.
    """

    name: str
    values: NDArray[np.float64]
    dims: tuple[str, ...]
    unit: str | None
    counted: bool = False


@dataclass(frozen=True)
class Labelled:
    """Values with their axes in the order asked for; positions in mm where the file has them.

    ``order`` is that of the axes as they are stored.
    """

    values: NDArray
    positions: dict[str, NDArray[np.float64] | None]
    order: tuple[str, ...]


def axis_of(name: str, variable: Variable | None = None) -> str:
    """Return the axis that a name stands for, ``"x"`` for ``X_um``; else the name itself."""
    said = str(variable.attrs.get("axis", "")).lower() if variable is not None else ""
    if said in ("x", "y", "z"):
        return said
    standard = str(variable.attrs.get("standard_name", "")) if variable is not None else ""
    if standard in _STANDARD:
        return _STANDARD[standard]
    stem = split_unit(name.rpartition("/")[2])[0].lower()
    if position := _POSITION.fullmatch(stem):
        return position[1]
    return SYNONYMS.get(stem, stem)


def values_of(path: Path, name: str, variable: Variable) -> NDArray:
    """Read a whole array; an InputError if it is damaged or larger than any map."""
    if math.prod(variable.shape) * max(variable.dtype.itemsize, 8) > 8 * MAX_VALUES:
        raise InputError(
            f"{path}{f', variable {name}' if name else ''}: it states {variable.shape} values of "
            f"type {variable.dtype}, far too many for a map (at most {MAX_VALUES} values)"
        )
    return variable.open()[_ALL[: len(variable.shape)]]


def coordinate(path: Path, contents: Contents, name: str, axis: str) -> Coordinate | None:
    """Find the coordinate of an array along an axis, None if the file has none.

    Raises
    ------
    InputError
        If there are several, or it is no array of numbers.
    """
    group = name.rpartition("/")[0]
    dims = contents.variables[name].dims
    by_dimension = dict(zip(dims, axes_of_dimensions(dims), strict=True))
    while True:
        names = [
            other
            for other, variable in contents.variables.items()
            if other != name
            and other.rpartition("/")[0] == group
            and axis in (axis_of(other, variable), by_dimension.get(other.rpartition("/")[2]))
        ]
        if names or not (group and dims):
            break
        group = group.rpartition("/")[0]  # dimensions of netCDF hold in the groups below, too
    own = [other for other in names if other.rpartition("/")[2] in dims] or names
    if not own:
        return None
    where = f"{path}, variable {own[0]}"
    if len(own) > 1:
        raise InputError(f"{path} has several coordinates along {axis}: {', '.join(own)}")
    variable = contents.variables[own[0]]
    values = np.empty(0)
    if variable.dtype.kind in "fiu" and len(variable.shape) <= 2:
        values = values_of(path, own[0], variable).astype(np.float64)
    squeezed = values if values.ndim == 2 and min(values.shape) > 1 else values.ravel()
    if not squeezed.size:
        raise InputError(
            f"{where} should hold the {axis} coordinates, but its shape is {variable.shape} and "
            f"its type {variable.dtype}. If it is something else, store the map in its own file"
        )
    if squeezed.ndim == 2 and variable.dims and variable.dims == dims[::-1] != dims:
        squeezed = squeezed.T  # as the array is stored
    unit = unit_of_positions(own[0], variable.attrs, where)
    counted = unit == PIXEL or (unit is None and variable.dtype.kind in "iu")
    unit = None if counted else unit
    return Coordinate(own[0], squeezed, variable.dims, unit, counted)


def unit_of_positions(name: str, attrs: Mapping[str, object], where: str) -> str | None:
    """Return the unit of coordinates, ``PIXEL`` where they are said to be numbers of pixels.

    Raises
    ------
    InputError
        As :func:`stated_unit`.
    """
    units = [str(value).strip().lower() for key, value in attrs.items() if is_unit_key(key)]
    if (units and _COUNTS.issuperset(units)) or _COUNTED.fullmatch(name):
        return PIXEL
    return stated_unit(name, attrs, where)


def check_units(
    coordinates: Sequence[tuple[str, NDArray[np.float64], str | None]], where: str
) -> None:
    """Refuse a coordinate without a unit that fits another one better in the unit of that.

    It would be in mm. Where the other is in um and its pixels are more alike if both are, nobody
    knows.

    Parameters
    ----------
    coordinates
        Name, positions as stored, and unit of each.
    where
        Names the array in errors.

    Raises
    ------
    InputError
        If there is such a one.
    """
    for name, positions, unit in coordinates:
        for silent, others, none in coordinates:
            if unit is None or none is not None or min(positions.size, others.size) < 2:
                continue
            step, other = (np.ptp(along) / (along.size - 1) for along in (positions, others))
            if not step * other > 0.0:
                continue
            alike = abs(np.log(other / step))
            if alike < abs(np.log(other / (step * MM[unit]))):
                raise InputError(
                    f"{where}: its coordinate {name} is in {unit}, and {silent} states no unit: "
                    f"{unit} as well, or mm? State it"
                )


def counts_pixels(positions: NDArray) -> bool:
    """Tell whether positions are whole numbers or a whole number apart: without a unit no mm.

    Numbers of the pixels of a part of a map begin anywhere, those of averages over blocks lie in
    between.
    """
    if positions.dtype.kind in "iu":
        return True
    steps = np.diff(positions)
    return steps.size > 1 and steps[0] % 1.0 == 0.0 != steps[0] and bool((steps == steps[0]).all())


def attributes_of(path: Path, contents: Contents, name: str) -> Mapping[str, object]:
    """Attributes of an array; where none of them is a unit, what the file says of it elsewhere.

    Raises
    ------
    InputError
        If the unit may stand in something that cannot be read.
    """
    attrs = _with_unit(contents.variables[name].attrs, f"{path}, variable {name}")
    if any(is_unit_key(key) for key in attrs):
        return attrs
    for other in contents.unread:
        group, _, stem = other.rpartition("/")
        if is_unit_key(stem) and name.startswith(group):
            raise InputError(
                f"{path}: {other} may state the unit, but is no text; save it as one, or leave it "
                "out"
            )
    return {**attrs, **contents.unit_texts(name)}


def _with_unit(attrs: Mapping[str, object], where: str) -> Mapping[str, object]:
    """Attributes with the unit that others than ``unit`` state: openPMD's factor, or a symbol."""
    said = {
        f"{kind}_unit": attrs[key]
        for key, kind in (("unit_symbol", "value"), ("unit_name", "data"))
        if key in attrs
    }
    factor: Any = attrs.get("unitSI")
    if factor is not None:
        units = [unit for unit, mm in MM.items() if np.all(np.isclose(factor, mm / 1e3, atol=0))]
        if not units:
            raise InputError(f"{where}: its unitSI is {factor}, no unit of length in m")
        said["length_unit"] = units[0]
    return {**attrs, **said}


def labelled(
    path: Path, contents: Contents, name: str, axes: str = "yx", like: str | None = None
) -> Labelled:
    """Read an array with its axes in a given order, and their coordinates in mm.

    Which axis is which is said by the names of its dimensions, by the dimensions of the coordinate
    variables, or by the direction along which coordinates of every pixel vary. Where nothing says
    it the axes come as they are asked for, or as those of another array, `like`, that is stored
    with the same shape.

    Raises
    ------
    InputError
        If the labels contradict each other or name other axes, or a coordinate does not fit.
    """
    variable = contents.variables[name]
    where = f"{path}, variable {name}" if name else str(path)
    if len(variable.shape) != len(axes):
        raise InputError(
            f"{where} has the shape {variable.shape}; {len(axes)} axes ({', '.join(axes)}) are "
            "needed"
        )
    if like is not None and not variable.dims and not variable.stated.axes:
        other = contents.variables[like]
        if other.shape == variable.shape:
            variable = replace(variable, dims=other.dims, stated=other.stated)
    found = {axis: coordinate(path, contents, name, axis) for axis in axes}
    order = _order(variable, found, axes, where)
    values = values_of(path, name, variable).transpose([order.index(axis) for axis in axes])
    positions: dict[str, NDArray[np.float64] | None] = {}
    vectors = []
    for number, axis in enumerate(axes):
        given = found[axis]
        if given is None:
            positions[axis] = None
            continue
        vector = _vector(given, order.index(axis))
        if vector.shape != (values.shape[number],):
            raise InputError(
                f"{path}, variable {given.name} should hold the {axis} coordinates of "
                f"{values.shape[number]} pixels (the map has "
                + " and ".join(
                    f"{n} {_KIND[a]} along {a}" for a, n in zip(axes, values.shape, strict=True)
                )
                + f"), but its shape is {given.values.shape}. If it is something else, store the "
                "map in a file of its own"
            )
        if given.counted or (given.unit is None and counts_pixels(vector)):
            positions[axis] = None
            values = np.flip(values, number) if vector[0] > vector[-1] else values
            continue
        vectors.append((given.name, vector, given.unit))
        unit = given.unit or _common_unit(contents, given, f"{path}, variable {given.name}")
        positions[axis] = vector * MM[unit]
    check_units(vectors, where)
    return Labelled(values, positions, tuple(order))


_KIND = {"x": "columns", "y": "rows", "z": "layers"}


def _common_unit(contents: Contents, given: Coordinate, where: str) -> str:
    """Unit of a coordinate that has none of its own; one of the whole file would be ambiguous."""
    if contents.unit_texts(given.name):
        raise InputError(
            f"{where}: the file states a unit, but does not say whether for the coordinates too; "
            f"name it {given.name}_mm or {given.name}_um"
        )
    return "mm"


def _order(
    variable: Variable, found: dict[str, Coordinate | None], axes: str, where: str
) -> list[str]:
    """Which axis each dimension of the stored array is."""
    names: list[str | None] = [None] * len(axes)
    stated = variable.stated.axes
    if stated is not None and sorted(stated.lower()) == sorted(axes):
        names = list(stated.lower())
    elif stated is not None and variable.stated.described:
        raise InputError(
            f"{where}: its axes are said to be {stated!r}, no order of {' and '.join(axes)} such "
            f"as {axes!r}"
        )
    for number, label in enumerate(axes_of_dimensions(variable.dims)):
        if label is None:
            continue
        if label not in axes:
            raise InputError(
                f"{where} has the dimensions ({', '.join(variable.dims)}), not ({', '.join(axes)})"
            )
        if names[number] not in (None, label):
            raise InputError(
                f"{where}: its axes are said to be {stated}, but its dimensions are "
                f"({', '.join(variable.dims)})"
            )
        names[number] = label
    for axis, given in found.items():
        at = None
        if given is not None and len(given.dims) == 1 and given.values.ndim == 1:
            at = [n for n, dim in enumerate(variable.dims) if dim == given.dims[0]]
        elif given is not None and given.values.ndim == 2 == len(axes):
            at = [n for n in (0, 1) if _varies_only_along(given.values, n)]
        if not at:
            continue
        if names[at[0]] not in (None, axis) or axis in names[: at[0]] + names[at[0] + 1 :]:
            raise InputError(
                f"{where}: its dimensions are ({', '.join(variable.dims)}), but {given.name} "  # type: ignore[union-attr]
                f"says that dimension {at[0] + 1} is {axis}"
            )
        names[at[0]] = axis
    if len(set(filter(None, names))) != len(list(filter(None, names))):
        raise InputError(f"{where}: its dimensions ({', '.join(variable.dims)}) are the same twice")
    rest = [axis for axis in axes if axis not in names]
    if len(rest) > 1 and variable.stated.no_axes:
        raise InputError(
            f"{where}: {variable.stated.no_axes}; save it with the axes {', '.join(sorted(axes))}"
        )
    unclear = unclear_dimension(variable.dims)
    if len(rest) > 1 and unclear is not None:
        raise InputError(
            f"{where}: of its dimensions ({', '.join(variable.dims)}), {unclear!r} may be "
            f"{' or '.join(sorted(rest))}, and nothing says what the others are; name them "
            f"{' and '.join(axes)}"
        )
    return [name or rest.pop(0) for name in names]


def _varies_only_along(grid: NDArray[np.float64], axis: int) -> bool:
    first = grid[:, :1] if axis == 0 else grid[:1]
    return bool(np.array_equal(grid, np.broadcast_to(first, grid.shape)) and np.ptp(first) > 0)


def _vector(given: Coordinate, axis: int) -> NDArray[np.float64]:
    if given.values.ndim == 1:
        return given.values
    if not _varies_only_along(given.values, axis):
        return given.values
    return given.values[:, 0] if axis == 0 else given.values[0]
