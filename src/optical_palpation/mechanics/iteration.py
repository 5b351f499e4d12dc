"""Newton's method with a line search and damping, of whatever can be linearised."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar


class NotConverged(Exception):
    """Newton's method failed at this load; carries the reason.

    ``nearest`` is the iterate that was nearest to equilibrium, and its number.
    """

    nearest: tuple[Any, int] | None = None


class HardSystem(NotConverged):
    """The linear solver did not get there, or took too long."""


@dataclass(frozen=True)
class Tolerances:
    """When a load is reached.

    Attributes
    ----------
    force
        Out-of-balance nodal forces relative to the contact forces (both as 2-norms).
    volume
        Root mean square violation of J - 1 = p / K.
    iterations, least
        Newton iterations allowed at one load, and how many are made even where none is needed.
    linear
        Relative residual to which linear systems are solved (inexact Newton), in norms in which
        what contact springs take up counts by what it moves the body.
    patience
        Newton iterations in which the distance must fall to three tenths.
    krylov
        Iterations of a linear solver from which on the tangent counts as nearly singular, and
        Newton's method is given up.
    nearly, lingers
        Distance of a state that will do where Newton's method does not get there, its volume
        twice as far off as ``volume`` at the most: so near, patience is a third of what it is
        elsewhere, but so many iterations at least.
    """

    force: float = 1e-6
    volume: float = 1e-7
    iterations: int = 25
    linear: float = 3e-2
    patience: int = 12
    krylov: int = 1000
    nearly: float = 0.0
    lingers: int = 2
    least: int = 1


#: When bodies are in equilibrium: what is left changes forces by hundredths of a per cent at most.
#: With twice as much, a thin layer glued to both faces had 0.2 % of its pressure wrong.
TOLERANCES = Tolerances(force=5e-5, volume=5e-6)


def relaxed(tolerances: Tolerances, factor: float) -> Tolerances:
    """Return tolerances looser by a factor."""
    return replace(tolerances, force=factor * tolerances.force, volume=factor * tolerances.volume)


def impatient(tolerances: Tolerances) -> Tolerances:
    """Return tolerances with which Newton's method gives up where drag gets there sooner.

    More iterations than these, or more of the linear solver, cost a lot on a fine grid.
    """
    return replace(tolerances, patience=5, krylov=30)


class Iterate(Protocol):
    """A state and how far it is from equilibrium.

    ``imbalance`` is the 2-norm of all forces out of balance, mN, ``force_error`` its share of the
    contact forces, ``distance`` that share or, of many nodes, what they change the resultant by
    where that is less, ``merit`` that norm without what goes where each node comes to rest alone,
    mN: a node that slips the wrong way by next to nothing has all of its friction out of balance.
    ``volume_error`` the violation of J - 1 = p / K (root mean square), ``volume_distance`` that or,
    of many elements, its mean: one that is crushed outweighs millions in the root mean square.
    ``min_jacobian`` the smallest J.
    """

    @property
    def imbalance(self) -> float: ...  # noqa: D102
    @property
    def merit(self) -> float: ...  # noqa: D102
    @property
    def force_error(self) -> float: ...  # noqa: D102
    @property
    def distance(self) -> float: ...  # noqa: D102
    @property
    def volume_error(self) -> float: ...  # noqa: D102
    @property
    def volume_distance(self) -> float: ...  # noqa: D102
    @property
    def min_jacobian(self) -> float: ...  # noqa: D102


AnyIterate = TypeVar("AnyIterate", bound=Iterate)


@dataclass(frozen=True)
class Direction(Generic[AnyIterate]):
    """A Newton step: where a fraction of it leads, and the Krylov iterations that it took."""

    follow: Callable[[float], AnyIterate]
    krylov: int


#: A step must leave a smaller merit than the largest of so many iterations. Pressures that grow
#: from nothing to what fits the layer between the surfaces leave more for a step or two; steps cut
#: short for that get nowhere.
_MEMORY = 4
#: Least damping of a step that otherwise fails, in shear moduli per height squared.
DAMPING = 30.0
#: Compressibility beside that of a body that goes with damping of one shear modulus per height
#: squared, in reciprocal shear moduli.
_SOFTENING = 1e-3
#: How often a step is tried, with ever more damping.
_ATTEMPTS = 6
#: Share of its smallest volume ratio that a body must keep in a step.
_FLATTENING = 0.3


def iterate(
    now: AnyIterate,
    linearise: Callable[[AnyIterate, float], Direction[AnyIterate]],
    tolerances: Tolerances,
    least_damping: float,
    on_iteration: Callable[[int, AnyIterate, int], None] | None = None,
    eliminate: Callable[[AnyIterate, Sequence[float]], AnyIterate | None] | None = None,
) -> tuple[AnyIterate, int]:
    """Go on from an iterate until the tolerances are met.

    Parameters
    ----------
    linearise
        Returns the Newton step of an iterate, for a damping: a resistance to displacement in the
        tangent alone, kPa / mm^2, and with it a compressibility.
    least_damping
        What is tried first where the step as it is leads nowhere.
    on_iteration
        Called with the number of the iteration, the iterate and the Krylov iterations before it.
    eliminate
        Called with the iterate and the errors so far, returns an iterate in which what keeps it
        from equilibrium is solved alone, or None.

    Returns
    -------
    tuple
        The last iterate and the number of iterations.

    Raises
    ------
    NotConverged
        When the iterations run out, or no step leads nearer to equilibrium.
    """
    errors: list[float] = []  # after the step
    left: list[float] = []  # distances, after what is solved alone
    merits: list[float] = []
    nearest, number = now, 0
    damping, krylov = 0.0, 0
    try:
        for iteration in range(tolerances.iterations):
            errors.append(now.force_error)
            merits.append(now.merit)
            if eliminate and not met(now, tolerances):
                now = eliminate(now, errors) or now
            if on_iteration:
                on_iteration(iteration, now, krylov)
            if now.distance < nearest.distance:
                nearest, number = now, iteration
            patience = tolerances.patience
            if nearly_met(nearest, tolerances):
                patience = max(patience // 3, tolerances.lingers)
            left.append(now.distance)
            if iteration >= tolerances.least and met(now, tolerances):
                return now, iteration
            if stagnates(left, patience):
                raise NotConverged("Newton's method stagnates")
            krylov = 0
            for _ in range(_ATTEMPTS):
                step = linearise(now, damping)
                krylov += step.krylov
                # The first step crosses the new load and a damped one a snap: both may leave more
                # out of balance than they found.
                lenient = iteration == 0 or damping > 0
                after = _search(now, step, max(merits[-_MEMORY:]), lenient)
                if after is not None:
                    break
                damping = max(least_damping, 5.0 * damping)
            else:
                raise NotConverged("no step leads nearer to equilibrium")
            damping *= 0.5 * min(1.0, after.merit / max(now.merit, 1e-300))
            if damping < 0.1 * least_damping:
                damping = 0.0
            now = after
            del step, after  # they would stay in memory while the next system is solved
        if met(now, tolerances):
            return now, tolerances.iterations
        raise NotConverged(f"no convergence in {tolerances.iterations} Newton iterations")
    except NotConverged as failure:
        failure.nearest = nearest, number
        raise


def softness(damping: float, stiffness: float, shear_modulus: float) -> float:
    """Compressibility of a damped step beside that of the body, 1 / kPa.

    Else the step must take away all of the violation of J - 1 = p / K, and the more it is damped,
    the larger the forces that this takes. ``stiffness`` is one shear modulus per height squared.
    """
    return _SOFTENING * damping / (stiffness * shear_modulus)


def met(now: Iterate, tolerances: Tolerances) -> bool:
    """Whether an iterate is in equilibrium."""
    return now.force_error < tolerances.force and now.volume_error < tolerances.volume


def nearly_met(now: Iterate, tolerances: Tolerances) -> bool:
    """Whether an iterate will do where no other is one of equilibrium."""
    return now.distance < tolerances.nearly and volume_nearly_met(now, tolerances)


def volume_nearly_met(now: Iterate, tolerances: Tolerances) -> bool:
    """Whether the volume of an iterate is near enough for that.

    Pressures hang on it: of a layer between rollers that nothing lets out, 4e-4 too little of it
    was four times the force.
    """
    return now.volume_distance < 2.0 * tolerances.volume


def stagnates(left: Sequence[float], patience: int) -> bool:
    """Whether none of the last distances, ``patience`` of them, fell to 0.3 of the one before."""
    return len(left) > patience and min(left[-patience:]) > 0.3 * left[-1 - patience]


def _search(
    now: AnyIterate, step: Direction[AnyIterate], highest: float, lenient: bool
) -> AnyIterate | None:
    """Take the largest fraction of a step that leads on; None if there is none.

    The merit that it leaves must be less than ``highest``, the more so the larger the
    fraction, or, where ``lenient``, less than twice that. Forces are compared, not shares of the
    contact forces: a step that takes these away would never lead on.
    """
    for fraction in (1.0, 0.5, 0.25, 0.125):
        after = None  # out of memory before the next one is made
        after = step.follow(fraction)
        growth = 2.0 if lenient else 1 - 0.3 * fraction
        if after.min_jacobian > _FLATTENING * now.min_jacobian and after.merit < growth * highest:
            return after
    return None
