"""The computational method (sections 2 and 3 of the paper): stress from the layer's deformation.

The layer is meshed over its unloaded shape and pressed between the window and a rigid imprint that
carries the measured loaded thickness, as the paper's window and sample contact bodies do.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.material import Law
from optical_palpation.mechanics.cascade import LoadNotReached, Solution, solve
from optical_palpation.mechanics.contact import area_vectors, friction_fraction, side_contact
from optical_palpation.mechanics.grid import (
    RIM,
    LayerGrid,
    depth_positions,
    edge_width,
    node_positions,
)
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.iteration import TOLERANCES
from optical_palpation.mechanics.newton import Balance, balance
from optical_palpation.mechanics.problem import SAMPLE, WINDOW, LayerProblem, LayerState
from optical_palpation.palpation.algebraic import algebraic_stress
from optical_palpation.palpation.memory import check_memory
from optical_palpation.palpation.motion import match_sample_motion
from optical_palpation.palpation.plausibility import check_elements, unusual
from optical_palpation.palpation.result import ContactState, StressResult
from optical_palpation.palpation.threads import limited_threads
from optical_palpation.thickness.frames import inside_layer, layer_extent_of, on_grid
from optical_palpation.thickness.initial import match_initial_thickness

Array = NDArray[np.float64]
Edges = Literal["free", "roller", "padded"]

#: Width, in thicknesses, by which ``padded`` edges continue the layer past the field of view.
PADDING = 3.0
#: Smoothing of contact at the rim of finely meshed layers (``LayerProblem.rim_smoothing``), which
#: without it lifts off the window node by node. It raises the total force by 0.3 %.
RIM_SMOOTHING = 0.5
#: More elements than any machine holds; their layout alone would take minutes.
MOST_ELEMENTS = 1e8
#: A node slips where friction has reached this share of its bound.
SLIP_SHARE = 0.9


@dataclass(frozen=True)
class Progress:
    """What a running computation reports: the stage, the load reached and the work done."""

    stage: str
    load: float
    newton: int
    message: str = ""


def computational_stress(
    loaded: xr.DataArray,
    initial_thickness: float | xr.DataArray,
    material: Law,
    *,
    window_friction: float,
    sample_friction: float,
    element_size: float | Sequence[float],
    sample_motion: xr.Dataset | None = None,
    edges: Edges = "free",
    imprint_smoothing: float | None = None,
    solver: Literal["auto", "multigrid", "direct"] = "auto",
    threads: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> StressResult:
    """Compute the tactile stress that deforms the layer to the loaded thickness.

    Parameters
    ----------
    loaded
        Loaded thickness L1 in mm on ``(y, x)``, without missing values
        (:func:`~optical_palpation.thickness.clean_thickness`). Where it exceeds the unloaded
        thickness the sample does not touch.
    initial_thickness
        Unloaded thickness L0 in mm, a number or a map.
    material
        Law of the layer.
    window_friction, sample_friction
        Coulomb coefficients between window and layer, layer and sample.
    element_size
        Size of the elements in mm: one value, or three for x, y and z. It is adjusted so that whole
        elements fit.
    sample_motion
        How far the sample's surface has moved sideways, where that is known:
        ``sample_displacement_x`` and ``sample_displacement_y`` in mm on ``(y, x)``
        (:func:`~optical_palpation.palpation.read_sample_motion`), the displacement since the
        unloaded state of the point that is at (x, y) under load. Without it the surface is taken
        as fixed laterally, which a sample about as soft as the layer is not.
    edges
        Sides of the layer: ``free`` (stress-free, as published), ``roller`` (no normal
        displacement) or ``padded`` (the layer goes on for three thicknesses, then free).
    imprint_smoothing
        Standard deviation in mm of the Gaussian that smooths the imprint; by default half the
        lateral element size, the finest relief that the elements can follow.
    solver
        ``multigrid``, ``direct`` (sparse LU, for small grids) or ``auto``.
    threads
        Number of threads; by default one for each core that the process may use.
    progress
        Called with a :class:`Progress` now and then.

    Returns
    -------
    StressResult
        Maps in the frame of the imaging system, and the deformed layer.

    Raises
    ------
    InputError
        For a parameter or map that cannot be used; as its subclass
        :class:`~optical_palpation.errors.InsufficientMemoryError` where the elements would need
        more memory than there is.
    MaterialError
        If the layer is compressed beyond the stable range of the material.
    ConvergenceError
        If the full load is not reached.
    """
    loaded = on_grid(loaded)
    _check_numbers(window_friction, sample_friction, edges, imprint_smoothing, solver, threads)
    if bool(loaded.isnull().any()):
        raise InputError(
            f"the loaded thickness has {int(loaded.isnull().sum())} missing values: fill them with "
            "clean_thickness first"
        )
    initial = match_initial_thickness(initial_thickness, loaded)
    if bool(initial.isnull().any()):
        raise InputError("the unloaded thickness has missing values: fill them first")
    motion = None if sample_motion is None else match_sample_motion(sample_motion, loaded)
    algebraic = algebraic_stress(loaded, initial, material)
    sizes = _element_sizes(element_size, loaded, float(initial.median()))
    smoothing = 0.5 * float(np.sqrt(sizes[0] * sizes[1]))
    if imprint_smoothing is not None:
        smoothing = imprint_smoothing
        x0, x1, y0, y1 = layer_extent_of(loaded)
        if smoothing > (widest := 0.25 * min(x1 - x0, y1 - y0)):
            raise InputError(
                f"imprint_smoothing of {smoothing:g} mm is larger than a quarter of the field of "
                f"view, {widest:g} mm, and would leave no relief (it is in mm)"
            )
    friction = window_friction, sample_friction
    problem = _problem(loaded, initial, motion, material, friction, sizes, edges, smoothing)
    check_memory(problem, solver)

    newton = 0

    def report(level: LayerProblem, load: float, iteration: int, now: object, krylov: int) -> None:
        nonlocal newton
        newton += iteration > 0
        if progress:
            progress(Progress(f"{level.grid.n_elements:,} elements", load, newton))

    if progress:
        progress(Progress("preparing", 0.0, 0))
    try:
        with limited_threads(threads):
            solution = solve(
                problem,
                lambda level: _algebraic_forces(level, material),
                solver="multigrid" if solver == "auto" else solver,
                on_iteration=report,
            )
    except LoadNotReached as failure:
        raise ConvergenceError(
            f"the layer was loaded to {100 * failure.load:.1f} % only: {failure.reason}. Try a "
            "stronger imprint_smoothing, larger elements, less friction or other edges; and check "
            "that the thickness map is one a layer of this material can take"
        ) from None

    now = _checked(solution)
    layer, surface = _layer(solution, now)
    maps = _maps(solution, surface, loaded, algebraic, sizes)
    _check_cover(maps["axial_stress"], loaded, solution.state)
    sides = side_contact(solution.problem, solution.state).normal_force.sum(1)
    window_force, sample_force = map(float, solution.state.normal_force.sum((1, 2)) + sides)
    maps.attrs = {
        **{key: value for key, value in loaded.attrs.items() if key.startswith("source")},
        "method": "computational",
        **material.attributes,
        "bulk_to_shear": material.bulk_to_shear,
        "window_friction": float(window_friction),
        "sample_friction": float(sample_friction),
        "initial_thickness_mm": float(initial.where(inside_layer(loaded)).mean()),
        "element_size_mm": list(problem.grid.spacing[::-1]),
        "elements": list(problem.grid.shape[::-1]),
        "edges": edges,
        "imprint_smoothing_mm": smoothing,
        "window_force_mN": window_force,
        "sample_force_mN": sample_force,
        "force_balance": abs(window_force - sample_force) / max(window_force, 1e-30),
        "no_contact_share": algebraic.attrs["no_contact_share"],
        "newton_iterations": solution.newton_iterations,
        "convergence": json.dumps(
            [
                {"elements": elements, "load": round(load, 4), "newton": count}
                for elements, load, count in solution.record
            ]
        ),
        "volume_change_percent": 100 * float(now.volume.sum() / now.volume_ref.sum() - 1),
        "status": "converged",
        "force_residual": now.force_error,
        "force_tolerance": TOLERANCES.force,
        "volume_residual": now.volume_error,
        "volume_tolerance": TOLERANCES.volume,
        "smallest_volume_ratio": now.min_jacobian,
        "sides_force_share": float(sides.max()) / max(window_force, 1e-30),
        "slip_length_mm": problem.slip_length,
    }
    maps.attrs["unusual"] = json.dumps(unusual(material, maps))
    if motion is not None:
        maps.attrs |= motion.attrs
    return StressResult(maps, layer, problem, solution.state)


def _check_numbers(
    window_friction: float,
    sample_friction: float,
    edges: str,
    smoothing: float | None,
    solver: str,
    threads: int | None,
) -> None:
    for name, value in (("window_friction", window_friction), ("sample_friction", sample_friction)):
        if not (_is_number(value) and value >= 0):
            raise InputError(f"{name} must be a number of at least 0, not {value!r}")
        if value > 2:
            raise InputError(f"{name} is {value:g}: no interface has a coefficient above 2")
    if edges not in ("free", "roller", "padded"):
        raise InputError(f"edges must be free, roller or padded, not {edges!r}")
    if smoothing is not None and not (_is_number(smoothing) and smoothing >= 0):
        raise InputError(f"imprint_smoothing must be at least 0 mm, not {smoothing!r}")
    if solver not in ("auto", "multigrid", "direct"):
        raise InputError(f"solver must be auto, multigrid or direct, not {solver!r}")
    if threads is not None and not (isinstance(threads, int | np.integer) and threads >= 1):
        raise InputError(f"threads must be a whole number of at least 1, not {threads!r}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))


def _element_sizes(
    given: float | Sequence[float], loaded: xr.DataArray, thickness: float
) -> tuple[float, float, float]:
    """Element sizes (x, y, z), mm."""
    try:
        values = np.atleast_1d(np.asarray(given, dtype=float))
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.size not in (1, 3) or not np.all(np.isfinite(values)) or np.any(values <= 0):
        raise InputError(f"element_size must be one or three positive numbers in mm, not {given!r}")
    x, y, z = (float(v) for v in np.broadcast_to(values, 3))
    x0, x1, y0, y1 = layer_extent_of(loaded)
    check_elements((x, y, z), (x1 - x0, y1 - y0), thickness, "the thickness of the layer")
    elements = (x1 - x0) / x * (y1 - y0) / y * thickness / z
    if elements > MOST_ELEMENTS:
        raise InputError(
            f"elements of {x:g} x {y:g} x {z:g} mm would be {elements:.1e} in all, beyond any "
            "memory; give a larger element_size (it is in mm)"
        )
    return x, y, z


def _problem(
    loaded: xr.DataArray,
    initial: xr.DataArray,
    motion: xr.DataArray | None,
    material: Law,
    friction: tuple[float, float],
    sizes: tuple[float, float, float],
    edges: Edges,
    smoothing: float,
) -> LayerProblem:
    """Mesh the layer and make the imprint."""
    x0, x1, y0, y1 = layer_extent_of(loaded)
    thickness = float(initial.median())
    x, y = _uniform(loaded["x"].values), _uniform(loaded["y"].values)
    values = []
    for field in (initial, loaded) if motion is None else (initial, loaded, motion):
        same = np.array_equal(x, field["x"]) and np.array_equal(y, field["y"])
        values.append(field.values if same else field.interp(x=x, y=y).values)
    imprint = Imprint(x, y, *values)
    if smoothing > 0:
        imprint = imprint.smoothed(smoothing)
    depth = depth_positions(sizes[2] / thickness, edges == "free")
    edge = edge_width(depth, thickness) if edges == "free" else None
    nodes_x = node_positions(x1 - x0, sizes[0], x0, edge=edge)
    nodes_y = node_positions(y1 - y0, sizes[1], y0, edge=edge)
    if edges == "padded":
        nodes_x, nodes_y = (_padded(n, PADDING * thickness) for n in (nodes_x, nodes_y))
    unloaded = imprint.evaluate(*np.meshgrid(nodes_x, nodes_y), 0.0)[0]
    return LayerProblem(
        grid=LayerGrid(nodes_x, nodes_y, depth, unloaded),
        imprint=imprint,
        law=material,
        friction=friction,
        edges="roller" if edges == "roller" else "free",
        # friction builds up over 1 um on a layer of 0.5 mm, in proportion on others
        slip_length=2e-3 * thickness,
        rim_smoothing=_rim_smoothing(depth) if edges == "free" else 0.0,
    )


def _rim_smoothing(depth: Array) -> float:
    """Smoothing of contact at the rim; elements higher than the rim is wide need none."""
    return RIM_SMOOTHING * float(np.clip((RIM - depth[1]) / (0.5 * RIM), 0.0, 1.0))


def _uniform(positions: Array) -> Array:
    steps = np.diff(positions)
    if np.ptp(steps) < 1e-3 * steps.mean():
        return positions
    count = int(np.ceil((positions[-1] - positions[0]) / steps.min())) + 1
    return np.linspace(positions[0], positions[-1], count)


def _padded(nodes: Array, width: float) -> Array:
    """Continue node positions on both sides by ``width`` with slowly growing elements."""
    size = nodes[1] - nodes[0]
    count = 1
    while size * (1.2 ** (count + 1) - 1.2) / 0.2 < width:
        count += 1
    beyond = np.cumsum(1.2 ** np.arange(1, count + 1))
    beyond *= width / beyond[-1]  # how far the layer goes on decides the force
    return np.concatenate([nodes[0] - beyond[::-1], nodes, nodes[-1] + beyond])


def _algebraic_forces(level: LayerProblem, material: Law) -> Array:
    """Nodal contact forces at full load that the algebraic method expects."""
    grid = level.grid
    height = level.imprint.evaluate(*np.meshgrid(grid.x, grid.y), 1.0)[0]
    strain = np.minimum(height / grid.thickness, 1.0) - 1.0
    stress = material.strain_adjusted_modulus(strain) * -strain
    if level.edges == "roller":
        # with nowhere to go the layer answers to the loss of volume with its bulk modulus
        lost = 1 - np.minimum(height, grid.thickness).mean() / grid.thickness.mean()
        stress = stress + material.bulk_modulus * lost
    return stress * grid.areas


def _checked(solution: Solution) -> Balance:
    """Return the balance of a solution.

    Raises
    ------
    ConvergenceError
        If an element is inside out or a number is not finite.
    """
    now = balance(solution.problem, solution.state)
    if not (np.isfinite(solution.state.u).all() and np.isfinite(now.imbalance)):
        raise ConvergenceError("the solver ended with numbers that are not finite")
    if now.min_jacobian <= 0:
        raise ConvergenceError(
            "the solver ended with elements inside out, as where a free edge folds: try larger "
            "elements, a stronger imprint_smoothing or padded edges"
        )
    return now


def _check_cover(stress: xr.DataArray, loaded: xr.DataArray, state: LayerState) -> None:
    """Refuse a layer that has left more than half of its field of view.

    Raises
    ------
    ConvergenceError
    """
    x0, x1, y0, y1 = layer_extent_of(loaded)
    there = (stress["x"] >= x0) & (stress["x"] <= x1) & (stress["y"] >= y0) & (stress["y"] <= y1)
    covered = float((np.isfinite(stress) & there).sum() / there.sum())
    if covered < 0.5:
        moved = float(np.hypot(*state.u[:2].mean((1, 2, 3))))
        raise ConvergenceError(
            f"nothing holds the layer sideways: it slid by {moved:.2g} mm and covers only "
            f"{covered:.0%} of the field of view. Give the friction that there is at window and "
            "sample, or roller edges"
        )


def _layer(solution: Solution, now: Balance) -> tuple[xr.Dataset, dict[str, Array]]:
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

    area = grid.surface_areas(position[:, -1])
    traction = {
        WINDOW: force[:, 0] / grid.surface_areas(position[:, 0]),
        SAMPLE: force[:, -1] / area,
    }
    _, hx, hy = problem.imprint.evaluate(position[0, -1], position[1, -1], 1.0)[:3]
    slope = np.sqrt(1 + hx**2 + hy**2)
    vertical_area = area_vectors(position[:, -1])[2]
    pressure = np.where(touching[SAMPLE], state.normal_force[SAMPLE] / vertical_area, 0.0)
    normal = np.stack([-hx, -hy, np.ones_like(hx)]) / slope
    surface = {
        "contact_pressure": pressure,
        "axial_stress": _surface_axial_stress(stress, normal, pressure),
        **{f"traction_{c}": traction[SAMPLE][n] for n, c in enumerate("xyz")},
        "contact_state": contact[SAMPLE],
        "window_contact_state": contact[WINDOW],
        "x": position[0, -1],
        "y": position[1, -1],
    }

    def variable(dims: str, data: Array, units: str, name: str) -> tuple:
        return dims.split(), data, {"units": units, "long_name": name}

    flags = {
        "flag_values": [int(s) for s in ContactState],
        "flag_meanings": " ".join(s.name.lower() for s in ContactState),
    }
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
            "sample_contact_state": (("y", "x"), contact[SAMPLE], flags),
            "window_contact_state": (("y", "x"), contact[WINDOW], flags),
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


def _surface_axial_stress(stress: Array, normal: Array, pressure: Array) -> Array:
    """Cauchy zz at the sample-side nodes.

    The stress of the elements is extrapolated to the surface and averaged onto the nodes; then its
    hydrostatic part, which oscillates from element to element in constant-pressure bricks, is
    replaced so that the stress normal to the surface is the contact pressure.
    """
    top = stress[:, -1] if stress.shape[1] == 1 else 1.5 * stress[:, -1] - 0.5 * stress[:, -2]
    padded = np.pad(top, ((0, 0), (1, 1), (1, 1)), mode="edge")
    xx, yy, zz, yz, xz, xy = 0.25 * (
        padded[:, 1:, 1:] + padded[:, :-1, 1:] + padded[:, 1:, :-1] + padded[:, :-1, :-1]
    )
    nx, ny, nz = normal
    along = nx * nx * xx + ny * ny * yy + nz * nz * zz
    along += 2 * (ny * nz * yz + nx * nz * xz + nx * ny * xy)
    return zz - along - pressure


def _interpolator(grid: LayerGrid, field: Array) -> Callable[[Array], Array]:
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


def _maps(
    solution: Solution,
    surface: dict[str, Array],
    loaded: xr.DataArray,
    algebraic: xr.DataArray,
    sizes: tuple[float, float, float],
) -> xr.Dataset:
    """Surface fields in the laboratory frame, on even points as far apart as the element size."""
    grid = solution.problem.grid
    x0, x1, y0, y1 = layer_extent_of(loaded)
    x, y = node_positions(x1 - x0, sizes[0], x0), node_positions(y1 - y0, sizes[1], y0)
    target = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1)
    moved = [
        _interpolator(grid, shift)
        for shift in (surface["y"] - grid.y[:, None], surface["x"] - grid.x)
    ]
    lower, upper = np.array([grid.y[0], grid.x[0]]), np.array([grid.y[-1], grid.x[-1]])
    reference = target
    for _ in range(40):  # the material point that sits at each laboratory point
        before = reference
        reference = target - np.stack([by(np.clip(before, lower, upper)) for by in moved], -1)
        if (np.abs(reference - before) < 1e-8 * (upper - lower)).all():
            break
    tolerance = 1e-6 * (upper - lower)
    outside = ((reference < lower - tolerance) | (reference > upper + tolerance)).any(-1)
    reference = np.clip(reference, lower, upper)

    units = {
        "contact_pressure": "contact pressure, positive in compression",
        "axial_stress": "axial Cauchy stress, computational method",
        "traction_x": "traction on the sample side of the layer, x",
        "traction_y": "traction on the sample side of the layer, y",
        "traction_z": "traction on the sample side of the layer, z",
    }
    maps = xr.Dataset(
        coords={
            "y": ("y", y, {"units": "mm", "long_name": "lateral position y"}),
            "x": ("x", x, {"units": "mm", "long_name": "lateral position x"}),
        }
    )
    for name, text in units.items():
        values = np.where(outside, np.nan, _interpolator(grid, surface[name])(reference))
        if name == "contact_pressure":
            values = np.maximum(values, 0.0)  # a cubic may overshoot where contact ends
        maps[name] = (("y", "x"), values, {"units": "kPa", "long_name": text})
    from scipy.interpolate import RegularGridInterpolator  # slow to load

    for name in ("contact_state", "window_contact_state"):
        nearest = RegularGridInterpolator((grid.y, grid.x), surface[name], method="nearest")
        values = np.where(outside, ContactState.OPEN, nearest(reference)).astype(np.int8)
        maps[name] = (
            ("y", "x"),
            values,
            {
                "long_name": name.replace("_", " "),
                "flag_values": [int(s) for s in ContactState],
                "flag_meanings": " ".join(s.name.lower() for s in ContactState),
            },
        )
    maps["loaded_thickness"] = loaded.interp(x=x, y=y, kwargs={"fill_value": "extrapolate"})
    # Pixels beyond the layer have no stress: up to its border, go on from the last ones within.
    within = algebraic.dropna("x", how="all").dropna("y", how="all")
    stress = within.interp(x=x, y=y, kwargs={"fill_value": "extrapolate"})
    maps["algebraic_axial_stress"] = np.minimum(stress, 0.0)
    for name in ("loaded_thickness", "algebraic_axial_stress"):
        maps[name].attrs = {
            "units": {"loaded_thickness": "mm"}.get(name, "kPa"),
            "long_name": {"loaded_thickness": "loaded thickness of the layer"}.get(
                name, "axial Cauchy stress, algebraic method"
            ),
        }
    return maps
