"""What the loaded layer says: its stress tensor, and maps of what its sample side carries."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise, product
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.linalg import block_diag

from optical_palpation.mechanics.cascade import Solution
from optical_palpation.mechanics.contact import friction_fraction
from optical_palpation.mechanics.faces import area_vectors, carrying_areas, push_slope
from optical_palpation.mechanics.grid import LayerGrid, node_positions
from optical_palpation.mechanics.newton import Balance, balance
from optical_palpation.mechanics.problem import SAMPLE, WINDOW, LayerProblem, LayerState
from optical_palpation.palpation.result import CONTACT_FLAGS, ContactState
from optical_palpation.thickness.frames import layer_extent_of

Array = NDArray[np.float64]

#: Lateral area, as a share of the unloaded one, below which a surface counts as nearly folded.
_FOLDED = 0.05
#: Points along each side of an element at which it is decided what lies within a map.
_SAMPLES = 4
#: Iterations in a row in which no point of a map finds its material point, after which those that
#: are left are looked for between the nodes.
_ASTRAY = 5
#: A node slips where friction has reached this share of its bound.
SLIP_SHARE = 0.9


def axial_stress_map(problem: LayerProblem, state: LayerState, x: Array, y: Array) -> Array:
    """Axial Cauchy stress on the sample side at points of the laboratory frame, (y, x), kPa.

    NaN where the layer does not cover them.
    """
    now = balance(problem, state)
    position = (problem.grid.nodes + state.u)[:, -1]
    stress = problem.body.stress(state.u, state.p)
    axial = _pressure_and_axial_stress(problem, state, now, stress)[1]
    return MapReading(problem.grid, position[0], position[1], x, y).read(axial)


def _pressure_and_axial_stress(
    problem: LayerProblem, state: LayerState, now: Balance, stress: Array
) -> tuple[Array, Array]:
    """Contact pressure and axial stress at the nodes of the sample side, kPa."""
    surface = (problem.grid.nodes + state.u)[:, -1]
    met = problem.imprint.evaluate(surface[0], surface[1], 1.0)[1:3]
    slope, beneath, _ = push_slope(surface, problem.grid.areas, met)
    closed = state.touching(problem)[SAMPLE]
    carried = pressure = np.where(closed, state.normal_force[SAMPLE] / beneath, 0.0)
    if problem.glued[SAMPLE]:  # what holds it has a direction of its own
        force, areas = now.force[:, -1], area_vectors(surface)
        carried, pressure = -force[2] / beneath, -(force * areas).sum(0) / (areas**2).sum(0)
    return pressure, surface_axial_stress(stress, slope, carried)


def per_area(grid: LayerGrid, surface: Array, force: Array) -> Array:
    """Forces of nodes, (..., ny + 1, nx + 1), mN, over the area of a deformed surface, kPa.

    ``surface`` holds node positions, (3, ny + 1, nx + 1), mm.
    """
    return force / carrying_areas(grid.surface_areas(surface), grid.areas)


def deformed_layer(solution: Solution, now: Balance) -> tuple[xr.Dataset, dict[str, Array]]:
    """Deformed layer as a Dataset, and what its sample side carries at the surface nodes."""
    problem, state = solution.problem, solution.state
    grid = problem.grid
    position = grid.nodes + state.u
    force = now.force
    stress = problem.body.stress(state.u, state.p)
    touching = state.touching(problem)
    share = friction_fraction(problem, state)
    contact = np.where(share < SLIP_SHARE, ContactState.STICK, ContactState.SLIP)
    contact = np.where(touching, contact, ContactState.OPEN).astype(np.int8)
    contact[list(problem.glued)] = ContactState.GLUED

    traction = {
        face: per_area(grid, position[:, k], force[:, k]) for face, k in ((WINDOW, 0), (SAMPLE, -1))
    }
    pressure, axial = _pressure_and_axial_stress(problem, state, now, stress)
    surface = {
        "contact_pressure": pressure,
        "axial_stress": axial,
        **{f"traction_{c}": traction[SAMPLE][n] for n, c in enumerate("xyz")},
        "contact_state": contact[SAMPLE],
        "window_contact_state": contact[WINDOW],
        "x": position[0, -1],
        "y": position[1, -1],
    }

    def variable(dims: str, data: Array, units: str, name: str) -> tuple:
        return dims.split(), data, {"units": units, "long_name": name}

    layer = xr.Dataset(
        {
            "position": variable(
                "z y x component", np.moveaxis(position, 0, -1), "mm", "deformed node position"
            ),
            "displacement": variable(
                "z y x component", np.moveaxis(state.u, 0, -1), "mm", "node displacement"
            ),
            "cauchy_stress": variable(
                "cell_z cell_y cell_x tensor", np.moveaxis(stress, 0, -1), "kPa", "Cauchy stress"
            ),
            "sample_traction": variable(
                "y x component", np.moveaxis(traction[SAMPLE], 0, -1), "kPa", "sample-side traction"
            ),
            "window_traction": variable(
                "y x component", np.moveaxis(traction[WINDOW], 0, -1), "kPa", "window traction"
            ),
            "sample_contact_state": (("y", "x"), contact[SAMPLE], CONTACT_FLAGS),
            "window_contact_state": (("y", "x"), contact[WINDOW], CONTACT_FLAGS),
        },
        {
            "x": variable("x", grid.x, "mm", "reference position x"),
            "y": variable("y", grid.y, "mm", "reference position y"),
            "z": variable("z", grid.depth, "1", "reference depth over unloaded thickness"),
            "component": ["x", "y", "z"],
            "tensor": ["xx", "yy", "zz", "yz", "xz", "xy"],
        },
    )
    return layer, surface


def surface_axial_stress(stress: Array, slope: Array, carried: Array) -> Array:
    """Cauchy zz at the sample-side nodes, by the vertical equilibrium of the surface.

    What a surface of slope (a_x, a_y) carries vertically per horizontal area is
    a_x xz + a_y yz - zz. The shear stress of the elements is extrapolated to the surface and
    averaged onto the nodes; their zz, which oscillates from element to element in
    constant-pressure bricks, is not needed.
    """
    shear = stress[3:5]
    top = shear[:, -1] if shear.shape[1] == 1 else 1.5 * shear[:, -1] - 0.5 * shear[:, -2]
    padded = np.pad(top, ((0, 0), (1, 1), (1, 1)), mode="edge")
    yz, xz = 0.25 * (
        padded[:, 1:, 1:] + padded[:, :-1, 1:] + padded[:, 1:, :-1] + padded[:, :-1, :-1]
    )
    return slope[0] * xz + slope[1] * yz - carried


def force_within(position: Array, pressure: Array, extent: tuple[float, ...]) -> float:
    """Vertical force of a nodal pressure on what lies within x0, x1, y0, y1 (mm), mN.

    Taken element by element and not from a map, which is checked by it. ``position`` holds the
    deformed nodes, (2 or more, ny + 1, nx + 1), mm.
    """
    x0, x1, y0, y1 = extent
    nodal = np.stack([*position[:2], pressure])
    corners = np.stack([nodal[:, :-1, :-1], nodal[:, :-1, 1:], nodal[:, 1:, :-1], nodal[:, 1:, 1:]])
    at = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    force = 0.0
    for s, t in product(at, at):
        x, y, carried = np.tensordot(
            [(1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t], corners, 1
        )
        along = np.tensordot([t - 1, 1 - t, -t, t], corners[:, :2], 1)
        across = np.tensordot([s - 1, -s, 1 - s, s], corners[:, :2], 1)
        area = along[0] * across[1] - along[1] * across[0]
        there = (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
        force += float((carried * area)[there].sum()) / _SAMPLES**2
    return force


def force_on_map(maps: xr.Dataset, surface: dict[str, Array]) -> dict[str, float]:
    """Attributes that say what the sample exerts within the map, and whether the map shows it.

    ``surface`` is that of :func:`deformed_layer`. Of the contact pressure and the axial stress, the
    one whose map adds up to another force than the elements beneath it counts.
    """
    x, y = maps["x"].values, maps["y"].values
    extent = float(x[0]), float(x[-1]), float(y[0]), float(y[-1])
    position = np.stack([surface["x"], surface["y"]])
    scale = force_within(position, np.abs(surface["contact_pressure"]), extent)
    names = "contact_pressure", "axial_stress"
    beneath = {name: force_within(position, surface[name], extent) for name in names}
    shown = {
        name: float(np.trapezoid(np.trapezoid(np.nan_to_num(maps[name].values), x), y))
        for name in names
    }
    difference = max(abs(shown[name] - beneath[name]) for name in names)
    return {
        "map_force_mN": beneath["contact_pressure"],
        "map_force_difference": difference / max(scale, 1e-30),
    }


def surface_field(grid: LayerGrid, field: Array) -> Callable[[Array], Array]:
    """Interpolation of a nodal field of the surface at reference points (..., 2), y before x.

    Cubic where the nodes are evenly spaced, since linear interpolation flattens relief of a few
    elements by several per cent; linear in the graded rows along the edges, where the pressure
    rises too steeply for a cubic.
    """
    from scipy.interpolate import RectBivariateSpline, RegularGridInterpolator  # slow to load

    linear = RegularGridInterpolator((grid.y, grid.x), field)
    even = [_evenly_spaced(nodes) for nodes in (grid.y, grid.x)]
    if min(part.stop - part.start for part in even) < 4:
        return linear
    y, x = grid.y[even[0]], grid.x[even[1]]
    cubic = RectBivariateSpline(y, x, field[even[0], even[1]])

    def interpolated(points: Array) -> Array:
        inside = ((points >= (y[0], x[0])) & (points <= (y[-1], x[-1]))).all(-1)
        out = np.empty(points.shape[:-1])
        out[inside] = cubic.ev(*points[inside].T)
        out[~inside] = linear(points[~inside])
        return out

    return interpolated


def _evenly_spaced(nodes: Array) -> slice:
    """The inner nodes between which the spacing is the usual one."""
    widths = np.diff(nodes)
    usual = np.nonzero(np.isclose(widths, widths[widths.size // 2], rtol=1e-3))[0]
    return slice(int(usual[0]), int(usual[-1]) + 2)


class MapReading:
    """How nodal fields of the deformed surface are read at the points of a map.

    A point shows the value of the material point that is there. Where elements are less than half
    as wide as the map's spacing, along free sides, it shows the mean over what the layer covers of
    the part of the map that is nearest to it. The pressure at a rim that sticks belongs to a few
    hundredths of a millimetre, and would count for half an element; and a rim that has moved
    inwards by less than a micrometre would leave the border of the map without values.

    Attributes
    ----------
    reference
        Points (ny, nx, 2) of the unloaded layer that lie at those of the map, y before x.
    outside
        Points of the map (ny, nx) of whose part the layer covers less than half.
    """

    def __init__(self, grid: LayerGrid, x: Array, y: Array, map_x: Array, map_y: Array) -> None:
        """Find the material points; `x`, `y` are the deformed positions of the nodes, mm."""
        self._grid = grid
        (at_y, self._down, own_y), (at_x, self._along, own_x) = (
            _parts(nodes, points) for nodes, points in ((grid.y, map_y), (grid.x, map_x))
        )
        target = np.stack(np.meshgrid(at_y, at_x, indexing="ij"), axis=-1)
        self._points, beyond = material_points(grid, x, y, target)
        self._covered = (~beyond).astype(float)
        self._share = self._down @ self._covered @ self._along.T
        self.reference, self.outside = self._points[np.ix_(own_y, own_x)], self._share < 0.5

    def read(self, field: Array) -> Array:
        """Values of a nodal field (ny + 1, nx + 1) on the map, NaN outside the layer."""
        values = self._covered * surface_field(self._grid, field)(self._points)
        return self._down @ values @ self._along.T / np.where(self.outside, np.nan, self._share)


def _parts(nodes: Array, points: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """Where a map is read along an axis: positions, weights (points, positions), own positions."""
    bounds = np.concatenate([points[:1], 0.5 * (points[1:] + points[:-1]), points[-1:]])
    narrow = np.diff(nodes) < 0.5 * (points[1] - points[0])
    gauss = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
    slack = 1e-9 * np.ptp(points)
    at, weights = [], []
    for point, (low, high) in zip(points, pairwise(bounds), strict=True):
        parts, share = np.array([point]), np.array([1.0])
        if (narrow & (nodes[:-1] < high - slack) & (nodes[1:] > low + slack)).any():
            cuts = [low, *nodes[(nodes > low + slack) & (nodes < high - slack)], high]
            widths = np.diff(cuts)
            inner = (np.array(cuts[:-1])[:, None] + widths[:, None] * gauss).ravel()
            parts, share = np.append(parts, inner), np.append(0.0, np.repeat(0.5 * widths, 2))
        at.append(parts)
        weights.append(share / share.sum())
    sizes = [part.size for part in at]
    own = np.cumsum([0, *sizes[:-1]])
    return np.concatenate(at), block_diag(*weights), own


def material_points(
    grid: LayerGrid, x: Array, y: Array, target: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Reference points of the surface that lie at points of the laboratory frame.

    Parameters
    ----------
    grid
        The layer's grid.
    x, y
        Deformed positions of the surface nodes, mm, (ny + 1, nx + 1).
    target
        Points (..., 2) in mm, y before x.

    Returns
    -------
    tuple
        Points (..., 2) of the unloaded layer, and which of `target` (...) the layer does not cover.
    """
    axes = (grid.y, grid.x)
    moved = [surface_field(grid, y - grid.y[:, None]), surface_field(grid, x - grid.x)]
    lower, upper = np.array([grid.y[0], grid.x[0]]), np.array([grid.y[-1], grid.x[-1]])
    shape, target = target.shape[:-1], target.reshape(-1, 2)
    undo = _undoing(axes, (y, x))
    reference = target.copy()
    left = np.arange(len(target))

    def off(points: Array, sought: Array) -> Array:
        here = np.clip(points, lower, upper)
        return sought - points - np.stack([by(here) for by in moved], -1)

    alike = 0  # iterations in a row after which as many were left
    while left.size and alike < _ASTRAY:
        missed = off(reference[left], target[left])
        here = np.clip(reference[left], lower, upper)
        reference[left] += undo(here, missed)
        still = (np.abs(missed) > 1e-8 * (upper - lower)).any(-1)
        alike = alike + 1 if still.all() else 0
        left = left[still]
    if left.size:  # where rows at a rim are nearly folded, the gradient leads astray
        other = _between_nodes(axes, np.stack([y, x], axis=-1), target[left])
        known = ~np.isnan(other).any(-1)
        left, other = left[known], other[known]
        own = reference[left]
        misses = (np.linalg.norm(off(at, target[left]), axis=-1) for at in (other, own))
        reference[left] = np.where(np.less(*misses)[:, None], other, own)
    tolerance = 1e-6 * (upper - lower)
    outside = ((reference < lower - tolerance) | (reference > upper + tolerance)).any(-1)
    return np.clip(reference, lower, upper).reshape(*shape, 2), outside.reshape(shape)


def _between_nodes(axes: tuple[Array, Array], position: Array, target: Array) -> Array:
    """Reference points (n, 2) of a few points, linear between the deformed nodes around them.

    Each element of the surface is two triangles. ``position`` is (ny + 1, nx + 1, 2), y before x;
    NaN for points outside all. Where the surface lies on itself a triangle that is not turned over
    counts, and of several the one that the point is deepest in.
    """
    from scipy.spatial import cKDTree  # slow to load

    triangles = _triangles(position)
    unloaded = _triangles(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    middle = triangles.mean(1)
    reach = float(np.linalg.norm(triangles - middle[:, None], axis=-1).max())
    found = np.full(target.shape, np.nan)
    for point, around in enumerate(cKDTree(middle).query_ball_point(target, reach)):
        near = np.asarray(around, np.intp)
        origin, edges = triangles[near, 0], triangles[near, 1:] - triangles[near, :1]
        area = np.linalg.det(edges)
        flat = np.abs(area) < 1e-12 * np.linalg.norm(edges, axis=-1).prod(-1)
        edges[flat] = np.eye(2)
        along = np.linalg.solve(np.swapaxes(edges, 1, 2), (target[point] - origin)[..., None])
        shares = np.concatenate([1.0 - along.sum(1), along[..., 0]], axis=-1)
        depth = np.where(flat, -1.0, shares.min(-1))
        within = depth > -1e-9
        if within.any():
            best = np.lexsort((depth, area > 0, within))[-1]
            found[point] = shares[best] @ unloaded[near[best]]
    return found


def _triangles(nodes: Array) -> Array:
    """Corners (m, 3, 2) of the triangles between nodes (ny + 1, nx + 1, 2), turned alike."""
    low, high = nodes[:-1], nodes[1:]
    lower = np.stack([low[:, :-1], high[:, :-1], low[:, 1:]], axis=2)
    upper = np.stack([high[:, 1:], low[:, 1:], high[:, :-1]], axis=2)
    return np.concatenate([lower.reshape(-1, 3, 2), upper.reshape(-1, 3, 2)])


def _undoing(
    axes: tuple[Array, Array], positions: tuple[Array, Array]
) -> Callable[[Array, Array], Array]:
    """Function that returns how far points (n, 2), y before x, must go to undo a miss (n, 2).

    By the lateral deformation gradient there, of differences of the nodes' positions, which is near
    enough for a step of Newton's method; by the miss itself where the surface is nearly folded.
    """
    from scipy.interpolate import RegularGridInterpolator  # slow to load

    rows = [np.stack(list(np.gradient(field, *axes)), -1) for field in positions]
    gradient = RegularGridInterpolator(axes, np.stack(rows, -2))

    def undo(points: Array, missed: Array) -> Array:
        (yy, yx), (xy, xx) = np.moveaxis(gradient(points), 0, -1)
        determinant = yy * xx - yx * xy
        folded = determinant < _FOLDED
        determinant[folded] = 1.0
        y, x = missed.T
        step = np.stack([xx * y - yx * x, yy * x - xy * y], -1) / determinant[:, None]
        step[folded] = missed[folded]
        return step

    return undo


def surface_maps(
    solution: Solution,
    surface: dict[str, Array],
    loaded: xr.DataArray,
    algebraic: xr.DataArray,
    sizes: tuple[float, float, float],
) -> xr.Dataset:
    """Surface fields in the laboratory frame, on even points as far apart as the element size."""
    grid, glued = solution.problem.grid, solution.problem.glued[SAMPLE]
    x0, x1, y0, y1 = layer_extent_of(loaded)
    x, y = node_positions(x1 - x0, sizes[0], x0), node_positions(y1 - y0, sizes[1], y0)
    at = MapReading(grid, surface["x"], surface["y"], x, y)

    units = {
        "contact_pressure": "contact pressure, positive in compression",
        "axial_stress": "axial Cauchy stress, computational method",
        "traction_x": "traction on the sample side of the layer, x",
        "traction_y": "traction on the sample side of the layer, y",
        "traction_z": "traction on the sample side of the layer, z",
    }
    maps: dict[str, Any] = {}
    for name, text in units.items():
        values = at.read(surface[name])
        if name == "contact_pressure" and not glued:
            values = np.maximum(values, 0.0)  # a cubic may overshoot where contact ends
        maps[name] = (("y", "x"), values, {"units": "kPa", "long_name": text})
    from scipy.interpolate import RegularGridInterpolator  # slow to load

    for name in ("contact_state", "window_contact_state"):
        nearest = RegularGridInterpolator((grid.y, grid.x), surface[name], method="nearest")
        values = np.where(at.outside, ContactState.OPEN, nearest(at.reference)).astype(np.int8)
        maps[name] = (
            ("y", "x"),
            values,
            {
                "long_name": name.replace("_", " "),
                **CONTACT_FLAGS,
            },
        )
    # Pixels beyond the layer have no stress: up to its border, go on from the last ones within.
    within = algebraic.dropna("x", how="all").dropna("y", how="all")
    thickness, stress = (_at_points(field, y, x) for field in (loaded, within))
    for name, values, unit, text in (
        ("loaded_thickness", thickness, "mm", "loaded thickness of the layer"),
        (
            "algebraic_axial_stress",
            stress if glued else np.minimum(stress, 0.0),
            "kPa",
            "axial Cauchy stress, algebraic method",
        ),
    ):
        maps[name] = (("y", "x"), values, {"units": unit, "long_name": text})
    axes = {
        axis: (axis, at, {"units": "mm", "long_name": f"lateral position {axis}"})
        for axis, at in (("y", y), ("x", x))
    }
    return xr.Dataset(maps, axes)


def _at_points(field: xr.DataArray, y: Array, x: Array) -> Array:
    """A map between its pixels, linearly, and beyond the last ones."""
    from scipy.interpolate import RegularGridInterpolator  # slow to load

    axes = field["y"].values, field["x"].values
    between = RegularGridInterpolator(axes, field.values, bounds_error=False, fill_value=None)
    return between(tuple(np.meshgrid(y, x, indexing="ij")))
