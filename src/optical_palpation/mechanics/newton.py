"""Newton's method for the layer at one load, displacement and pressure independent unknowns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .contact import ContactLinearisation, linearise
from .elements import GRADIENTS, internal_force
from .problem import SAMPLE, WINDOW, LayerProblem, LayerState
from .system import NewtonSystem, assemble

Array = NDArray[np.float64]


class LinearSolver(Protocol):
    """What Newton's method needs of a linear solver."""

    gamma: float
    dtype: type[np.floating]

    def solve(self, system: NewtonSystem, tolerance: float) -> tuple[Array, Array, int]:
        """Return the step (du in contact coordinates, dp) and the number of iterations."""
        ...


@dataclass(frozen=True)
class Tolerances:
    """When a load is reached.

    Attributes
    ----------
    force
        Out-of-balance nodal forces relative to the contact forces (both as 2-norms).
    volume
        Root mean square violation of J - 1 = p / K.
    iterations
        Newton iterations allowed at one load.
    linear
        Relative residual to which linear systems are solved (inexact Newton).
    """

    force: float = 1e-6
    volume: float = 1e-7
    iterations: int = 25
    linear: float = 1e-2


@dataclass
class Balance:
    """Internal forces, volumes and contact of a state, and how far it is from equilibrium."""

    force: Array
    volume: Array
    volume_ref: Array
    contact: ContactLinearisation
    min_jacobian: float
    force_error: float
    volume_error: float
    penetration: float


class NotConverged(Exception):
    """Newton's method failed at this load; carries the reason."""


def balance(
    problem: LayerProblem,
    state: LayerState,
    bound_guess: Array | None = None,
    secant: bool = False,
) -> Balance:
    """Evaluate equilibrium, incompressibility and contact at a state."""
    grid = problem.grid
    force = np.empty(state.u.shape)
    volume, volume_ref = np.empty(grid.shape), np.empty(grid.shape)
    jacobian = np.empty(grid.shape[:2])
    internal_force(
        grid.nodes,
        state.u,
        state.p,
        problem.c10,
        problem.c01,
        GRADIENTS,
        force,
        volume,
        volume_ref,
        jacobian,
    )
    contact = linearise(problem, state, force, bound_guess, secant)
    out = force.copy()
    for face, k in ((WINDOW, 0), (SAMPLE, -1)):
        out[:2, k] += contact.row[face] * force[2, k]
        out[2, k][state.active[face]] = 0.0
    if problem.edges == "roller":
        out[0, :, :, [0, -1]] = 0.0
        out[1, :, [0, -1], :] = 0.0
    scale = max(float(np.linalg.norm(contact.normal_force)), 1e-30)
    return Balance(
        force=force,
        volume=volume,
        volume_ref=volume_ref,
        contact=contact,
        min_jacobian=float(jacobian.min()),
        force_error=float(np.linalg.norm(out)) / scale,
        volume_error=float(
            np.sqrt(np.mean((volume / volume_ref - 1 - state.p / problem.bulk_modulus) ** 2))
        ),
        penetration=float(np.abs(contact.penetration[state.active]).max(initial=0.0)),
    )


def equilibrate(
    problem: LayerProblem,
    state: LayerState,
    solver: LinearSolver,
    tolerances: Tolerances,
    bound_guess: Array | None = None,
    on_iteration: Callable[[int, Balance, int], None] | None = None,
) -> int:
    """Bring ``state`` (changed in place) into equilibrium at its load.

    Returns
    -------
    int
        The number of Newton iterations.

    Raises
    ------
    NotConverged
        When the iterations run out, an element turns inside out or numbers overflow.
    """
    thickness = float(problem.grid.thickness.max())
    now = balance(problem, state, bound_guess)
    seen: set[bytes] = set()
    krylov = 0
    storage = None
    for iteration in range(tolerances.iterations):
        if on_iteration:
            on_iteration(iteration, now, krylov)
        settled = iteration > 0 and not changed
        if (
            settled
            and now.force_error < tolerances.force
            and now.volume_error < tolerances.volume
            and now.penetration < 1e-6 * thickness
        ):
            state.normal_force = now.contact.normal_force
            return iteration
        system = assemble(
            problem,
            state,
            now.contact,
            now.force,
            now.volume,
            now.volume_ref,
            solver.gamma,
            solver.dtype,
            storage,
        )
        storage = system.stencil
        du, dp, krylov = solver.solve(system, tolerances.linear)
        if not (np.isfinite(du).all() and np.isfinite(dp).all()):
            raise NotConverged("the linear system could not be solved")
        normal = system.contact_forces(now.force, du, dp)
        step = system.to_cartesian(du)
        trial = state.copy()
        best = None
        for fraction in (1.0, 0.5, 0.25, 0.125):
            trial.u = state.u + fraction * step
            trial.p = state.p + fraction * dp
            after = balance(problem, trial)
            if after.min_jacobian > 0.02 and np.isfinite(after.force_error):
                if best is None or after.force_error < best[0]:
                    best = (after.force_error, trial.u, trial.p, after)
                if (
                    iteration == 0
                    or changed
                    or after.force_error < (1 - 0.3 * fraction) * now.force_error
                ):
                    break
        if best is None:
            raise NotConverged("an element turned inside out")
        _, trial.u, trial.p, after = best
        # contact: a node that would have to be pulled is released, one that penetrates is caught
        active = np.where(state.active, normal > 0, after.contact.penetration > 1e-9 * thickness)
        changed = bool((active != state.active).any())
        if changed and active.tobytes() in seen and iteration > 8:
            # the active set cycles between a few nodes: from here on only catch, never release
            active |= state.active
            changed = bool((active != state.active).any())
        seen.add(active.tobytes())
        state.u, state.p, state.active = trial.u, trial.p, active
        now = balance(problem, state)
    raise NotConverged(f"no convergence in {tolerances.iterations} Newton iterations")
