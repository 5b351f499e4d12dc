"""Newton's method for the layer at one load, displacement and pressure independent unknowns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from .contact import (
    ContactLinearisation,
    direction_step,
    friction_direction,
    linearise,
    slip_coordinate,
)
from .problem import SAMPLE, WINDOW, LayerProblem, LayerState
from .side_flow import SideFlow
from .stencil import threads_for
from .system import NewtonSystem, assemble

Array = NDArray[np.float64]


class LinearSolver(Protocol):
    """What Newton's method needs of a linear solver."""

    #: Penalty of the displacement block, kPa.
    gamma: float
    dtype: ClassVar[type[np.floating]]

    @property
    def stencil(self) -> Any:
        """The displacement block, in whatever form."""
        ...

    def store(self, k: int, plane: NDArray[np.floating]) -> None:
        """Take plane k of the displacement block, [y, neighbour, 3 * row + column, x].

        Rows are filled up to whole lanes; the plane is overwritten afterwards.
        """
        ...

    def solve(
        self, system: NewtonSystem, tolerance: float
    ) -> tuple[NDArray[np.floating], NDArray[np.floating], int]:
        """Return the step (du in contact coordinates, dp) and the number of iterations.

        The system is the one last assembled for this solver.
        """
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
    acceptable
        Factor by which both may be exceeded when the iterations run out.
    linear
        Relative residual to which linear systems are solved (inexact Newton).
    """

    force: float = 1e-6
    volume: float = 1e-7
    iterations: int = 25
    acceptable: float = 10.0
    linear: float = 1e-2


#: How much further from balance an equilibrium on the way may be, a smaller load or a coarser grid.
_ON_THE_WAY = 100.0


def on_the_way(tolerances: Tolerances, problem: LayerProblem) -> Tolerances:
    """Return the tolerances of an equilibrium from which the next is only begun.

    Contact forces of a layer with nowhere to go are those of its bulk modulus: as a share of them,
    what shears it is small, and nothing can be given away.
    """
    if problem.edges == "roller":
        return tolerances
    return replace(
        tolerances,
        force=_ON_THE_WAY * tolerances.force,
        volume=_ON_THE_WAY * tolerances.volume,
    )


#: Newton iterations in which the error must fall, or a smaller load is tried.
_STAGNATION = 12


#: A step must leave less out of balance than the most of so many iterations. Pressures that grow
#: from nothing to what fits the layer between the surfaces, and friction that turns round, leave
#: more for a step or two; steps cut short for that get nowhere.
_MEMORY = 4


#: Least damping of a step that otherwise fails, in shear moduli per thickness squared, and how
#: often a step is tried.
_DAMPING, _ATTEMPTS = 30.0, 6


#: Share of its smallest volume ratio that the layer must keep in a step.
_FLATTENING = 0.3


@dataclass
class Balance:
    """Internal forces, volumes and contact of a state, and how far it is from equilibrium.

    ``force`` are the internal nodal forces (x, y, z), ``residual`` what is out of balance of the
    equations in contact coordinates, both (3, nz + 1, ny + 1, nx + 1), mN. ``imbalance`` is the
    2-norm of all that is out of balance, mN, ``force_error`` its share of the contact forces.
    """

    force: Array
    residual: Array
    volume: Array
    volume_ref: Array
    volume_residual: Array
    flow: SideFlow | None
    contact: ContactLinearisation
    min_jacobian: float
    imbalance: float
    force_error: float
    volume_error: float


class NotConverged(Exception):
    """Newton's method failed at this load; carries the reason."""


def balance(problem: LayerProblem, state: LayerState, direction: Array | None = None) -> Balance:
    """Evaluate equilibrium, incompressibility and contact at a state (see ``linearise``)."""
    body = problem.body.forces(state.u, state.p)
    force, volume, volume_ref = body.force, body.volume, body.reference_volume
    contact = linearise(problem, state, force, direction)
    out = force.copy()
    for face, k, sign in ((WINDOW, 0, -1.0), (SAMPLE, -1, 1.0)):
        out[:2, k] += contact.row[face] * force[2, k]
        out[2, k] += sign * state.normal_force[face]
    if problem.edges == "free":
        out[:, *problem.grid.side_nodes] += contact.sides.force
    if problem.edges == "roller":
        out[0, :, :, [0, -1]] = 0.0
        out[1, :, [0, -1], :] = 0.0
    imbalance = float(np.hypot(np.linalg.norm(out), np.linalg.norm(contact.violation)))
    return Balance(
        force=force,
        residual=out,
        volume=volume,
        volume_ref=volume_ref,
        volume_residual=body.volume_residual,
        flow=body.flow,
        contact=contact,
        min_jacobian=body.min_jacobian,
        imbalance=imbalance,
        force_error=imbalance / max(float(np.linalg.norm(state.normal_force)), 1e-30),
        volume_error=float(np.sqrt(np.mean((body.volume_residual / volume_ref) ** 2))),
    )


def _search(
    problem: LayerProblem,
    state: LayerState,
    now: Balance,
    direction: Array,
    system: NewtonSystem,
    solution: tuple[NDArray[np.floating], NDArray[np.floating]],
    highest: float,
    lenient: bool,
) -> tuple[Balance, Array] | None:
    """Take the largest fraction of a Newton step that leads on (``state`` changed in place).

    What it leaves out of balance must be less than ``highest``, the more so the larger the
    fraction, or, where ``lenient``, less than twice that. Forces are compared, not shares of the
    contact forces: a step that takes these away would never lead on.

    Returns
    -------
    tuple
        The new balance and the new direction of friction; None if there is none.
    """
    du, dp = solution
    step = system.to_cartesian(du)
    change = system.contact_forces(now.force, du, dp) - state.normal_force
    slip_step = np.stack([step[:2, 0], step[:2, -1]]).astype(float) / problem.slip_length
    turn = direction_step(slip_coordinate(problem, state), direction, slip_step)
    trial = state.copy()
    for fraction in (1.0, 0.5, 0.25, 0.125):
        trial.u = state.u + fraction * step
        trial.p = state.p + fraction * dp
        trial.normal_force = state.normal_force + fraction * change
        turned = direction + fraction * turn
        turned /= np.maximum(1.0, np.sqrt((turned**2).sum(1, keepdims=True)))
        after = balance(problem, trial, turned)
        growth = 2.0 if lenient else 1 - 0.3 * fraction
        if (
            after.min_jacobian > _FLATTENING * now.min_jacobian
            and after.imbalance < growth * highest
        ):
            state.u, state.p, state.normal_force = trial.u, trial.p, trial.normal_force
            return after, turned
    return None


def equilibrate(
    problem: LayerProblem,
    state: LayerState,
    solver: LinearSolver,
    tolerances: Tolerances,
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
    with threads_for(problem.grid.node_shape):
        return _newton(problem, state, solver, tolerances, on_iteration)


def _newton(
    problem: LayerProblem,
    state: LayerState,
    solver: LinearSolver,
    tolerances: Tolerances,
    on_iteration: Callable[[int, Balance, int], None] | None,
) -> int:
    direction = friction_direction(state.slip)
    now = balance(problem, state, direction)
    krylov = 0
    errors: list[float] = []
    imbalances: list[float] = []
    least = _DAMPING * problem.shear_modulus / float(np.median(problem.grid.thickness)) ** 2
    damping = 0.0
    for iteration in range(tolerances.iterations):
        if on_iteration:
            on_iteration(iteration, now, krylov)
        errors.append(now.force_error)
        imbalances.append(now.imbalance)
        if iteration >= _STAGNATION and errors[-1] > 0.3 * errors[-_STAGNATION]:
            raise NotConverged("Newton's method stagnates")
        if (
            iteration > 0
            and now.force_error < tolerances.force
            and now.volume_error < tolerances.volume
        ):
            return iteration
        krylov = 0
        for _ in range(_ATTEMPTS):
            system = assemble(problem, state, now, solver, damping)
            du, dp, count = solver.solve(system, tolerances.linear)
            krylov += count
            if not (np.isfinite(du).all() and np.isfinite(dp).all()):
                raise NotConverged("the linear system could not be solved")
            # The first step crosses the new load and a damped one a snap: both may leave more out
            # of balance than they found.
            lenient = iteration == 0 or damping > 0
            highest = max(imbalances[-_MEMORY:])
            found = _search(problem, state, now, direction, system, (du, dp), highest, lenient)
            if found is not None:
                break
            damping = max(least, 5.0 * damping)
        else:
            raise NotConverged("no step leads nearer to equilibrium")
        after, direction = found
        damping *= 0.5 * min(1.0, after.imbalance / now.imbalance)
        if damping < 0.1 * least:
            damping = 0.0
        now = after
    if (
        now.force_error < tolerances.acceptable * tolerances.force
        and now.volume_error < tolerances.acceptable * tolerances.volume
    ):
        return tolerances.iterations
    raise NotConverged(f"no convergence in {tolerances.iterations} Newton iterations")
