"""The computational method (sections 2 and 3 of the paper): stress from the layer's deformation.

The layer is meshed over its unloaded shape and pressed between the window and a rigid imprint that
carries the measured loaded thickness, as the paper's window and sample contact bodies do.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import xarray as xr

from optical_palpation.arguments import LARGEST_FRICTION, check_instance, choice, explained, flag
from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.material import Law
from optical_palpation.mechanics.cascade import (
    LoadNotReached,
    OnlyOnCoarser,
    Solution,
    solve,
)
from optical_palpation.mechanics.iteration import TOLERANCES, Iterate, Tolerances, met
from optical_palpation.mechanics.newton import Balance, balance
from optical_palpation.mechanics.path import COVERED, SLID_AWAY, SLIDES
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.mechanics.side_contact import side_contact
from optical_palpation.mechanics.similar import Similar
from optical_palpation.palpation.accuracy import solve_to_accuracy
from optical_palpation.palpation.algebraic import stress_of_pixels
from optical_palpation.palpation.edges import edge_influence
from optical_palpation.palpation.input_errors import INPUT_ERRORS, InputErrors, add_error_bands
from optical_palpation.palpation.memory import check_memory
from optical_palpation.palpation.mesh_error import MeshError, Quantities, mesh_error
from optical_palpation.palpation.meshing import (
    SLIP_LENGTHS,
    Edges,
    Hold,
    expected_forces,
    imprint_of,
    layer_problem,
)
from optical_palpation.palpation.motion import match_sample_motion
from optical_palpation.palpation.plausibility import check_count, check_elements, unusual
from optical_palpation.palpation.progress import Iterations, Progress
from optical_palpation.palpation.result import Status, StressResult
from optical_palpation.palpation.sensitivity import changes, sensitivities
from optical_palpation.palpation.surface import (
    axial_stress_map,
    deformed_layer,
    force_on_map,
    surface_maps,
)
from optical_palpation.palpation.threads import limited_threads
from optical_palpation.thickness.frames import (
    inside_layer,
    layer_extent_of,
    on_grid,
    typical_thickness,
)
from optical_palpation.thickness.initial import match_initial_thickness

#: What to do about a layer that slides away, and about one that does not arrive otherwise.
_HOLD_IT = "Give the friction that there is at window and sample, or roller edges"
_TAME_IT = (
    "Try a stronger imprint_smoothing, larger elements, less friction or other edges; and check "
    "that the thickness map is one a layer of this material can take"
)


@explained
def computational_stress(
    loaded: xr.DataArray,
    initial_thickness: float | xr.DataArray,
    material: Law,
    *,
    window_friction: Hold,
    sample_friction: Hold,
    element_size: float | Sequence[float] | None = None,
    accuracy: float | None = None,
    sample_motion: xr.Dataset | None = None,
    edges: Edges = "free",
    imprint_smoothing: float | None = None,
    slip_length: float | None = None,
    solver: Literal["auto", "multigrid", "direct"] = "auto",
    threads: int | None = None,
    mesh_check: bool = True,
    edge_check: bool = True,
    input_errors: InputErrors | None = INPUT_ERRORS,
    similar: Similar | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> StressResult:
    """Compute the tactile stress that deforms the layer to the loaded thickness.

    Parameters
    ----------
    loaded
        Loaded thickness L1 in mm on ``(y, x)``, without missing values
        (:func:`~optical_palpation.thickness.clean_thickness`). Where it exceeds the unloaded
        thickness the sample does not touch, or pulls if it is glued.
    initial_thickness
        Unloaded thickness L0 in mm, a number or a map.
    material
        Law of the layer.
    window_friction, sample_friction
        Coulomb coefficients between window and layer, layer and sample; or ``"glued"``, where the
        layer neither slips nor lifts off, as one that was cast onto the window.
    element_size
        Size of the elements in mm: one value, or three for x, y and z. It is adjusted so that whole
        elements fit.
    accuracy
        Instead of the size: error of the total force that the mesh may leave, as a fraction of it
        (0.02 for 2 %). Elements are made finer until the estimated error is below that.
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
    slip_length
        Slip in mm over which friction builds up to 0.84 of its bound (the smoothing of Coulomb's
        law); by default 0.002 of the thickness, in proportion less where the compression is
        below 10 % everywhere. `docs/which-friction.md` says what it changes.
    solver
        ``multigrid``, ``direct`` (sparse LU, for small grids) or ``auto``.
    threads
        Number of threads; by default one for each core that the process may use.
    mesh_check
        Whether to solve the problem on further grids to learn the error of the mesh
        (``force_mesh_error_mN``), where it was small, or those that were needed anyway are not
        coarser along all axes; where they are the error is always given.
    edge_check
        Whether to compute, on a coarse grid, how much the sides of the layer matter: the map
        ``edge_influence`` and the attributes ``edge_influence_*``.
    input_errors
        Errors of the inputs, from which those of force and stress follow (``axial_stress_error``,
        ``force_error_mN``) by the result's ``sensitivities``; None computes neither.
    similar
        Where many similar layers are solved one after the other: the last of them, which says where
        Newton's method begins at each load. Each is loaded from rest all the same, and its result
        is that without it but for what the tolerances leave, mostly less than 0.5 % of the stress
        (`docs/live.md`). These are twice as loose at the full load, and a load on the way at
        which the guide meets them is left as it suggests. This layer takes its place. The attribute
        ``guided_by_similar_layer`` says so in the result.
    progress
        Called with a :class:`Progress` now and then.

    Returns
    -------
    StressResult
        Maps in the frame of the imaging system, and the deformed layer. Where the full load is
        reached on coarser elements only, that is the solution there: its ``status`` says so, the
        attributes ``asked_elements_failure`` and ``asked_element_size_mm`` why and what was asked;
        ``asked_edges_failure`` why where the elements at free edges alone are coarser;
        ``edge_element_size_mm`` and ``asked_edge_element_size_mm`` how wide these are.

    Raises
    ------
    InputError
        For a parameter or map that cannot be used; as its subclass
        :class:`~optical_palpation.errors.InsufficientMemoryError` where the elements would need
        more memory than there is.
    MaterialError
        If the layer is compressed beyond the stable range of the material.
    ConvergenceError
        If the full load is not reached, on coarser elements neither.
    """
    if input_errors is not None:
        check_instance(input_errors, InputErrors, "input_errors", "palpation.InputErrors or None")
    if similar is not None:
        check_instance(similar, Similar, "similar", "palpation.Similar or None")
    if progress is not None:
        check_instance(progress, Callable, "progress", "a function of a Progress")
    if (element_size is None) == (accuracy is None):
        raise InputError(
            "give element_size (mm) or accuracy (0.02 for 2 % of the force), one of them"
        )
    if element_size is None:
        assert accuracy is not None
        x0, x1, y0, y1 = layer_extent_of(on_grid(loaded, "loaded"))
        thickness = float(np.nanmedian(initial_thickness))

        def solve_with(size: float) -> StressResult:
            return computational_stress(
                loaded,
                initial_thickness,
                material,
                window_friction=window_friction,
                sample_friction=sample_friction,
                element_size=size,
                sample_motion=sample_motion,
                edges=edges,
                imprint_smoothing=imprint_smoothing,
                slip_length=slip_length,
                solver=solver,
                threads=threads,
                edge_check=edge_check,
                input_errors=input_errors,
                progress=progress,
            )

        return solve_to_accuracy(accuracy, thickness, (x1 - x0, y1 - y0), solve_with)
    loaded = on_grid(loaded, "loaded")
    flag(mesh_check, "mesh_check")
    flag(edge_check, "edge_check")
    held = {"window": window_friction, "sample": sample_friction}
    _check_numbers(held, edges, imprint_smoothing, solver, threads)
    glued = {face: hold == "glued" for face, hold in held.items()}
    if bool(loaded.isnull().any()):
        raise InputError(
            f"the loaded thickness has {int(loaded.isnull().sum())} missing values: fill them with "
            "clean_thickness first"
        )
    initial = match_initial_thickness(initial_thickness, loaded, glued=glued["sample"])
    if bool(initial.isnull().any()):
        raise InputError("the unloaded thickness has missing values: fill them first")
    motion = None if sample_motion is None else match_sample_motion(sample_motion, loaded)
    algebraic = stress_of_pixels(loaded, initial, material, glued=glued["sample"])
    thickness = typical_thickness(initial)
    _check_slip_length(slip_length, thickness)
    if input_errors is not None:
        input_errors.check_thickness(thickness)
    sizes = element_sizes(element_size, loaded, thickness)
    smoothing = 0.5 * float(np.sqrt(sizes[0] * sizes[1]))
    if imprint_smoothing is not None:
        smoothing = imprint_smoothing
        x0, x1, y0, y1 = layer_extent_of(loaded)
        if smoothing > (widest := 0.25 * min(x1 - x0, y1 - y0)):
            raise InputError(
                f"imprint_smoothing of {smoothing:g} mm is larger than a quarter of the field of "
                f"view, {widest:g} mm, and would leave no relief (it is in mm)"
            )
    problem = layer_problem(
        loaded, initial, motion, material, held, sizes, edges, smoothing, slip_length, similar
    )
    check_memory(problem, solver)

    neighbours = (
        changes(problem) if input_errors is not None and input_errors.any_of_layer else None
    )
    report = Iterations(progress)
    report.stage("preparing", 0.0)
    asked, instead = problem, dict[str, Any]()
    try:
        with limited_threads(threads):
            solution = solve(
                problem,
                lambda level: expected_forces(level, material),
                solver="multigrid" if solver == "auto" else solver,
                neighbours=neighbours,
                similar=similar,
                on_iteration=report,
            )
    except OnlyOnCoarser as failure:
        solution, problem = failure.solution, failure.solution.problem
        instead = instead_of(asked, failure)
    except LoadNotReached as failure:
        raise ConvergenceError(
            f"the layer was loaded {failure.how_far()}: {failure.reason}. "
            + (_HOLD_IT if failure.reason in (SLID_AWAY, SLIDES) else _TAME_IT)
        ) from None

    now = checked(solution)
    layer, surface = deformed_layer(solution, now)
    maps = surface_maps(solution, surface, loaded, algebraic, sizes)

    def quantities(problem: LayerProblem, state: LayerState) -> Quantities:
        if state is solution.state:
            return _total_forces(problem, state)[1], maps["axial_stress"].values
        stress = axial_stress_map(problem, state, maps["x"].values, maps["y"].values)
        return _total_forces(problem, state)[1], stress

    of_mesh = None
    if mesh_check or solution.coarser is not None:
        with limited_threads(threads):
            of_mesh = mesh_error(
                solution,
                quantities,
                lambda level: expected_forces(level, material),
                further=mesh_check,
            )
    _check_cover(maps["axial_stress"], loaded, solution.state)
    maps.attrs = {
        **{key: value for key, value in loaded.attrs.items() if key.startswith("source")},
        "method": "computational",
        **material.attributes,
        "bulk_to_shear": material.bulk_to_shear,
        **{f"{face}_contact": "glued" if stuck else "friction" for face, stuck in glued.items()},
        **{f"{face}_friction": float(held[face]) for face, stuck in glued.items() if not stuck},
        "initial_thickness_mm": float(initial.where(inside_layer(loaded)).mean()),
        "element_size_mm": list(problem.grid.spacing[::-1]),
        "elements": list(problem.grid.shape[::-1]),
        "edges": edges,
        "imprint_smoothing_mm": problem.imprint.smoothing,
        "slip_length_mm": problem.slip_length,
        "no_contact_share": algebraic.attrs["no_contact_share"],
        **outcome(solution, now),
        **force_on_map(maps, surface),
    }
    if solution.guided:
        maps.attrs["guided_by_similar_layer"] = 1
    if instead:
        maps.attrs |= instead
        if maps.attrs["status"] == Status.CONVERGED:
            at_edges = "asked_edges_failure" in instead
            maps.attrs["status"] = str(Status.COARSE_EDGES if at_edges else Status.COARSER)
    if of_mesh is not None:
        _add_mesh_error(maps, of_mesh)
    if edge_check:
        with limited_threads(threads):
            report.stage("influence of the sides", 1.0)
            within = None
            if edges == "free" and not inside_layer(loaded).all():
                within = imprint_of(loaded, initial, motion, smoothing, beyond=False)
            at = maps["x"].values, maps["y"].values
            influence = edge_influence(problem, edges, layer_extent_of(loaded), *at, within)
        maps["edge_influence"] = influence.described()
        maps.attrs |= influence.attributes
    derivatives = None
    if neighbours is not None and input_errors is not None:
        with limited_threads(threads):
            report.stage("sensitivities", 1.0)
            derivatives = sensitivities(
                solution,
                neighbours,
                quantities,
                lambda level: expected_forces(level, material),
                maps["y"].values,
                maps["x"].values,
            )
        rim = derivatives.attrs.pop("force_rim_model_mN", None)
        if rim is not None:
            maps.attrs["force_rim_model_mN"] = rim
        add_error_bands(maps, derivatives, input_errors)
    maps.attrs["unusual"] = json.dumps(unusual(material, maps))
    if motion is not None:
        maps.attrs |= motion.attrs
    pixels = xr.Dataset({"algebraic_axial_stress": algebraic, "loaded_thickness": loaded})
    return StressResult(
        maps,
        layer,
        problem,
        solution.state,
        pixels=pixels.drop_attrs(deep=False),
        sensitivities=derivatives,
    )


def _check_numbers(
    held: Mapping[str, Hold],
    edges: str,
    smoothing: float | None,
    solver: str,
    threads: int | None,
) -> None:
    for face, value in held.items():
        if isinstance(value, str) and value == "glued":
            continue
        if isinstance(value, str) or not (_is_number(value) and value >= 0):
            raise InputError(
                f'{face}_friction must be a number of at least 0 or "glued", not {value!r}'
            )
        if value > LARGEST_FRICTION:
            raise InputError(
                f"{face}_friction is {value:g}: no interface has a coefficient above "
                f'{LARGEST_FRICTION:g}; a layer that cannot slip is "glued"'
            )
    choice(edges, "edges", "free", "roller", "padded")
    if smoothing is not None and not (_is_number(smoothing) and smoothing >= 0):
        raise InputError(f"imprint_smoothing must be at least 0 mm, not {smoothing!r}")
    choice(solver, "solver", "auto", "multigrid", "direct")
    if threads is not None and not (isinstance(threads, int | np.integer) and threads >= 1):
        raise InputError(f"threads must be a whole number of at least 1, not {threads!r}")


def _check_slip_length(given: float | None, thickness: float) -> None:
    if given is None:
        return
    if not (_is_number(given) and given > 0):
        raise InputError(f"slip_length must be a positive number of mm, not {given!r}")
    low, high = (share * thickness for share in SLIP_LENGTHS)
    if not low <= given <= high:
        raise InputError(
            f"slip_length is {given:g} mm; on a layer of {thickness:.3g} mm it must lie between "
            f"{low:.3g} mm, below which friction flickers, and {high:.3g} mm, above which it is no "
            "friction any more (it is in mm)"
        )


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return False
    return bool(np.isfinite(value))


def element_sizes(
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
    check_count((x, y, z), (x1 - x0, y1 - y0), thickness)
    return x, y, z


def outcome(solution: Solution, now: Balance) -> dict[str, Any]:
    """Attributes that say how a solution ended: total forces, balance, iterations and residuals."""
    sides = side_contact(solution.problem, solution.state).normal_force.sum(1)
    window, sample = _total_forces(solution.problem, solution.state)
    return {
        "window_force_mN": window,
        "sample_force_mN": sample,
        "force_balance": abs(window - sample) / max(abs(window), 1e-30),
        "newton_iterations": solution.newton_iterations,
        "convergence": json.dumps(
            [
                {"elements": elements, "load": round(load, 4), "newton": count}
                for elements, load, count in solution.record
            ]
        ),
        "volume_change_percent": 100 * now.volume_change,
        **residuals(now, solution.tolerances),
        "sides_force_share": float(sides.max()) / max(abs(window), 1e-30),
    }


def residuals(now: Iterate, tolerances: Tolerances = TOLERANCES) -> dict[str, Any]:
    """Attributes that say how near to equilibrium a solution is, of one body or of two."""
    return {
        "status": str(Status.CONVERGED if met(now, tolerances) else Status.NEARLY),
        "force_residual": now.force_error,
        "force_tolerance": tolerances.force,
        "volume_residual": now.volume_error,
        "volume_tolerance": tolerances.volume,
        "smallest_volume_ratio": now.min_jacobian,
    }


def instead_of(asked: LayerProblem, failure: OnlyOnCoarser) -> dict[str, Any]:
    """Attributes that say which elements a solution was to be on, and why it is on others."""
    why = f"the layer was loaded {failure.how_far()}: {failure.reason}"
    edges = {
        "edge_element_size_mm": list(failure.solution.problem.grid.edge_widths[::-1]),
        "asked_edge_element_size_mm": list(asked.grid.edge_widths[::-1]),
    }
    if failure.at_edges:
        return edges | {"asked_edges_failure": why}
    return edges | {
        "asked_element_size_mm": list(asked.grid.spacing[::-1]),
        "asked_elements_failure": why,
    }


def checked(solution: Solution) -> Balance:
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


def _total_forces(problem: LayerProblem, state: LayerState) -> tuple[float, float]:
    """Return what window and sample carry, the sides of the layer included, mN."""
    sides = side_contact(problem, state).normal_force.sum(1)
    window, sample = map(float, state.normal_force.sum((1, 2)) + sides)
    return window, sample


def _add_mesh_error(maps: xr.Dataset, error: MeshError) -> None:
    """Let the discretisation error go with the maps."""
    maps["axial_stress_mesh_error"] = (
        ("y", "x"),
        error.stress,
        {"units": "kPa"},
    )
    maps.attrs["force_mesh_error_mN"] = error.force
    maps.attrs["mesh_error_coarser_elements"] = error.elements


def _check_cover(stress: xr.DataArray, loaded: xr.DataArray, state: LayerState) -> None:
    """Refuse a layer that has left most of its field of view.

    Raises
    ------
    ConvergenceError
    """
    x0, x1, y0, y1 = layer_extent_of(loaded)
    x, y = stress["x"].values, stress["y"].values
    there = stress.values[np.ix_((y >= y0) & (y <= y1), (x >= x0) & (x <= x1))]
    covered = float(np.isfinite(there).mean())
    if covered < COVERED:
        moved = float(np.hypot(*state.u[:2].mean((1, 2, 3))))
        raise ConvergenceError(
            f"nothing holds the layer sideways: it slid by {moved:.2g} mm and covers only "
            f"{covered:.0%} of the field of view. {_HOLD_IT}"
        )
