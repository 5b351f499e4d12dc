"""What a loaded stack shows: thickness as OCT would see it, and the stress on the layer."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import cKDTree

from optical_palpation.mechanics.faces import push_slope
from optical_palpation.mechanics.grid import LayerGrid, node_positions
from optical_palpation.mechanics.stack.contact import friction_memory, touching
from optical_palpation.mechanics.stack.problem import (
    INTERFACE,
    LAYER,
    PLATE,
    SAMPLE,
    WINDOW,
    Stack,
    State,
)
from optical_palpation.palpation.result import CONTACT_FLAGS, ContactState
from optical_palpation.palpation.surface import (
    SLIP_SHARE,
    MapReading,
    force_on_map,
    material_points,
    per_area,
    surface_axial_stress,
)

Array = NDArray[np.float64]
_STRESSES = {
    "axial_stress": "true axial Cauchy stress at the sample, tension positive",
    "contact_pressure": "true contact pressure of the sample on the layer",
    "traction_x": "x component of the true traction of the sample on the layer",
    "traction_y": "y component of the true traction of the sample on the layer",
    "traction_z": "z component of the true traction of the sample on the layer",
}


def pixels(stack: Stack, state: State, spacing: float) -> tuple[Array, Array]:
    """Positions x and y of pixels about ``spacing`` apart that show all of the loaded layer.

    They have pixels on the edges of the unloaded layer, and reach beyond it as far as it bulges.
    """
    body = stack.bodies[LAYER]
    surface = (body.nodes + stack.split(state.u)[LAYER])[:2, -1]
    axes = []
    for positions, nodes in zip(surface, (body.grid.x, body.grid.y), strict=True):
        inside = node_positions(nodes[-1] - nodes[0], spacing, nodes[0])
        step = inside[1] - inside[0]
        bulge = max(nodes[0] - positions.min(), positions.max() - nodes[-1], 0.0)
        more = step * np.arange(1, np.ceil(bulge / step) + 1)
        axes.append(np.concatenate([nodes[0] - more[::-1], inside, nodes[-1] + more]))
    return axes[0], axes[1]


def observed_maps(stack: Stack, state: State, x: Array, y: Array) -> xr.Dataset:
    """Maps at laboratory points ``x``, ``y``, mm; NaN where there is no layer.

    The motion of the sample is given everywhere, beyond its edge as that of the edge.
    """
    body = stack.bodies[LAYER]
    grid = body.grid
    u = stack.split(state.u)[LAYER]
    position = body.nodes + u
    force = body.forces(u, state.p[LAYER]).force[:, -1]
    surface = position[:, -1]
    slope, beneath, _ = push_slope(surface, grid.areas, np.zeros((2, *grid.areas.shape)))
    pressure = np.maximum(-force[2] / beneath, 0.0)
    traction = per_area(grid, surface, force)
    fields = {
        "contact_pressure": pressure,
        "axial_stress": surface_axial_stress(body.stress(u, state.p[LAYER]), slope, pressure),
        **{f"traction_{c}": traction[n] for n, c in enumerate("xyz")},
    }
    target = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1)
    at = MapReading(grid, surface[0], surface[1], x, y)
    at_window, _ = material_points(grid, position[0, 0], position[1, 0], target)
    maps = xr.Dataset(
        coords={
            "y": ("y", y, {"units": "mm", "long_name": "lateral position y"}),
            "x": ("x", x, {"units": "mm", "long_name": "lateral position x"}),
        }
    )
    thickness = _smooth(grid, surface[2], at.reference) - _smooth(grid, position[2, 0], at_window)
    thickness[at.outside] = np.nan
    millimetres = {"units": "mm"}
    unloaded = np.full(thickness.shape, float(grid.thickness.mean()))
    for name, values in (("unloaded_thickness", unloaded), ("loaded_thickness", thickness)):
        text = name.replace("_", " ") + " of the layer"
        maps[name] = (("y", "x"), values, {**millimetres, "long_name": text})
    below = stack.bodies[SAMPLE]
    moved = stack.split(state.u)[SAMPLE][:, 0]
    there = below.nodes[:, 0] + moved
    at_layer, _ = material_points(below.grid, there[0], there[1], target)
    for component, axis in zip(moved, "xy", strict=False):
        text = f"lateral displacement of the sample's surface, {axis}"
        values = _smooth(below.grid, component, at_layer)
        maps[f"sample_displacement_{axis}"] = (
            ("y", "x"),
            values,
            {**millimetres, "long_name": text},
        )
    for name, text in _STRESSES.items():
        values = at.read(fields[name])
        if name == "contact_pressure":
            values = np.maximum(values, 0.0)  # a cubic may overshoot where contact ends
        maps[name] = (("y", "x"), values, {"units": "kPa", "long_name": text})
    for name, contact in (("contact_state", INTERFACE), ("window_contact_state", WINDOW)):
        slaves = stack.contacts[contact].slaves.ravel()
        lateral = stack.position(state.u)[slaves, :2]
        distance, nearest = cKDTree(lateral[:, ::-1]).query(target)
        values = contact_states(stack, state, contact)[nearest]
        reach = np.sqrt(stack.areas[contact])[nearest]
        values = np.where(distance < reach, values, ContactState.OPEN).astype(np.int8)
        maps[name] = (("y", "x"), values, {"long_name": name.replace("_", " "), **CONTACT_FLAGS})
    maps.attrs = force_on_map(maps, {"x": surface[0], "y": surface[1], **fields})
    return maps


def contact_states(stack: Stack, state: State, contact: int) -> NDArray[np.int8]:
    """State of each slave of a contact, a :class:`ContactState`."""
    position = stack.position(state.u)
    own = state.contacts[contact]
    projection = stack.project(position, state.load)[contact]
    w = friction_memory(own, position, stack.slip_length)
    share = np.sqrt((w**2).sum(1) / (1 + (w**2).sum(1)))
    if stack.contacts[contact].friction == 0:
        share[:] = 1.0
    states = np.where(share < SLIP_SHARE, ContactState.STICK, ContactState.SLIP)
    closed = touching(projection, own, stack.scales[contact])
    return np.where(closed, states, ContactState.OPEN).astype(np.int8)


def body_dataset(stack: Stack, state: State, which: int) -> xr.Dataset:
    """The deformed layer or sample, in the form of ``StressResult.layer``.

    Of the sample, ``window_...`` is its face towards the window, ``sample_...`` that at the plate.
    """
    body = stack.bodies[which]
    u, p = stack.split(state.u)[which], state.p[which]
    position = body.nodes + u
    force = body.forces(u, p).force
    own = {LAYER: (WINDOW, INTERFACE), SAMPLE: (INTERFACE, PLATE)}[which]

    def variable(dims: str, data: Array, units: str, name: str) -> tuple:
        return dims.split(), data, {"units": units, "long_name": name}

    cells = "cell_z cell_y cell_x"
    variables = {
        "position": variable(
            "z y x component", np.moveaxis(position, 0, -1), "mm", "deformed node position"
        ),
        "displacement": variable(
            "z y x component", np.moveaxis(u, 0, -1), "mm", "node displacement"
        ),
        "cauchy_stress": variable(
            f"{cells} tensor", np.moveaxis(body.stress(u, p), 0, -1), "kPa", "Cauchy stress"
        ),
        "stiffness": variable(
            cells,
            np.broadcast_to(body.factor, body.grid.shape),
            "1",
            "stiffness over that of the law",
        ),
    }
    for face, k, contact in (("window", 0, own[0]), ("sample", -1, own[1])):
        traction = per_area(body.grid, position[:, k], force[:, k])
        variables[f"{face}_traction"] = variable(
            "y x component", np.moveaxis(traction, 0, -1), "kPa", f"traction, {face} side"
        )
        if stack.slave_grids[contact] is body.grid:
            states = contact_states(stack, state, contact).reshape(traction.shape[1:])
        else:
            pressed = np.abs(traction[2]) > 2e-3 * stack.shear_modulus
            states = np.where(pressed, ContactState.SLIP, ContactState.OPEN).astype(np.int8)
        variables[f"{face}_contact_state"] = (("y", "x"), states, CONTACT_FLAGS)
    return xr.Dataset(
        variables,
        {
            "x": variable("x", body.grid.x, "mm", "reference position x"),
            "y": variable("y", body.grid.y, "mm", "reference position y"),
            "z": variable("z", body.grid.depth, "1", "reference depth over unloaded thickness"),
            "component": ["x", "y", "z"],
            "tensor": ["xx", "yy", "zz", "yz", "xz", "xy"],
        },
    )


def _smooth(grid: LayerGrid, values: Array, points: Array) -> Array:
    return RegularGridInterpolator((grid.y, grid.x), values, method="cubic")(points)
