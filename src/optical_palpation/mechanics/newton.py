"""Newton's method for the layer at one load, displacement and pressure independent unknowns."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from .contact import ContactLinearisation, FaceFriction, linearise, remember_slip, slip_coordinate
from .direct import DirectSolver, direct_solver
from .effort import spend
from .elimination import (
    Box,
    Part,
    at_free_side,
    cut_out,
    put_back,
    unbalanced_columns,
    widened,
    within,
)
from .folds import Folds, folds
from .friction import Ahead
from .grid import face_and_sides
from .iteration import (
    DAMPING,
    Direction,
    HardSystem,
    NotConverged,
    Tolerances,
    iterate,
    met,
    softness,
)
from .krylov import MultigridSolver
from .path import Drag
from .problem import SAMPLE, WINDOW, LayerProblem, LayerState
from .side_contact import SideContact, side_contact
from .side_flow import SideFlow
from .stencil import threads_for
from .system import NewtonSystem, RightHandSide, assemble

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

    def prepare(self, system: NewtonSystem) -> None:
        """Make ready for solutions of a system whose planes have all been stored."""
        ...

    def solve(
        self, rhs: RightHandSide, tolerance: float, limit: int | None = None
    ) -> tuple[NDArray[np.floating], NDArray[np.floating], int]:
        """Return the step (du in contact coordinates, dp) and the number of iterations.

        There are at most ``limit`` of these. The system is the one last assembled for this solver.
        """
        ...


#: Pressure, in shear moduli, above which contact forces no longer tell how large errors may be, and
#: the mean one below which there are none.
_PRESSURE, _NO_PRESSURE = 4.0, 1e-9
#: Elements beyond which a grid is fine. Some node of a rim snaps there for ever, so that what is
#: out of balance counts by how much it changes the force that the layer carries; and a load path
#: takes more than seconds.
FINE = 30_000
#: Steps by the tangent of another state; and the share of the imbalance that each of them, or
#: columns that are solved alone in vain, may leave.
_CHORDS, _NEARER = 6, 0.5
#: Share of the contact forces out of balance below which Newton's method is near its end, and the
#: iterations of the linear solver that a step may then take.
_CLOSE, _TO_THE_END = 1e-2, 200
#: Farther from its end a step of a layer with free sides is taken as it is after so many iterations
#: of the linear solver: where a rim folds, more of them, or an exact solution, cost more than
#: another step.
_ROUGH = 8
#: Work of an iteration of the linear solver on each node, in operations of the exact one, and the
#: iterations that take as long as what the exact one does besides; most iterations after which a
#: system is solved exactly, and the systems in a row that then are.
_ITERATION, _BESIDES, _LONG, _ROW = 2e4, 6, 40, 3
#: Margin, in columns, around those that are brought into equilibrium alone: at first, by how much
#: it grows where that leaves more than half of the time before out of balance, and the most.
_MARGIN, _WIDER, _WIDEST = 3, 2, 12
#: How often that is tried at one load; once in vain counts as three.
_ELIMINATIONS = 8
#: Share of what is out of balance that such columns may keep: the others move them again.
_KEEP = 0.03
#: How much more than before may be out of balance of the whole layer. Columns that are solved alone
#: leave what they push to where they were cut, and the next step of the whole takes it away.
_PUSHED = 3.0


@dataclass(frozen=True)
class Due:
    """When the columns that are out of balance are solved alone.

    After ``first`` iterations, where the ``last`` ones left more than a share ``left`` of the
    error, and the columns that hold a ``share`` of its square are at most a share ``most`` of the
    layer. In a layer that was ``carried`` to another grid only those at free sides are solved:
    others have to keep their volume, and push all around them. Their volumes may be as much looser
    than the whole layer's as their forces, and where they find no equilibrium what is nearest to
    one will do. Where the load is followed with no similar layer to guide it none of this pays:
    thin layers that stick ask for volumes as good as the whole layer's.
    """

    first: int
    last: int
    left: float
    share: float
    most: float
    carried: bool


#: Where Newton's method is slow; and in a layer that was carried over to a fine grid, where an
#: iteration of the whole takes as long as many of a small part, or that is guided by a similar one,
#: from which a few columns of the rim are soon all that differs.
SLOW = Due(first=4, last=2, left=0.5, share=0.9, most=0.35, carried=False)
CARRIED = Due(first=1, last=1, left=0.1, share=0.7, most=0.06, carried=True)


@dataclass
class Balance:
    """Internal forces, volumes and contact of a state, and how far it is from equilibrium.

    ``drag`` is what resists the state. ``force`` are the internal nodal forces (x, y, z), with what
    else holds the layer but for contact of the faces (drag, cut sides, ``sides``, ``folds``), (3,
    nz + 1, ny + 1, nx + 1), mN. ``volume_change`` is the relative one of the whole layer.
    ``columns`` are the squares of what is out of balance in each column, (ny + 1, nx + 1), mN^2,
    ``imbalance`` is the 2-norm of all that, mN, ``force_error`` its share of the contact forces.
    ``friction`` and
    ``side_friction`` are linearised; ``merit`` is that of ``Iterate``.
    """

    state: LayerState
    drag: Drag[LayerState] | None
    force: Array
    volume_ref: Array
    volume_change: float
    volume_residual: Array
    flow: SideFlow | None
    contact: ContactLinearisation
    sides: SideContact
    folds: list[Folds]
    friction: FaceFriction
    side_friction: Ahead | None
    merit: float
    min_jacobian: float
    columns: Array
    imbalance: float
    force_error: float
    volume_error: float

    def residual(self, problem: LayerProblem) -> Array:
        """What is out of balance of the equations, in contact coordinates, of the shape of force.

        Not kept: of a fine grid it would be a tenth of what Newton's method holds.
        """
        return _residual(problem, self.state, self.force, self.contact)

    @cached_property
    def distance(self) -> float:
        """That of ``Iterate``: ``force_error``, on fine grids no more than ``resultant_error``."""
        if self.state.p.size <= FINE:
            return self.force_error
        return min(self.force_error, self.resultant_error)

    @cached_property
    def volume_distance(self) -> float:
        """That of ``Iterate``: ``volume_error``, on fine grids the mean of the violation."""
        if self.state.p.size <= FINE:
            return self.volume_error
        return float(np.mean(np.abs(self.volume_residual / self.volume_ref)))

    @property
    def resultant_error(self) -> float:
        """How much what is out of balance may change the force that the layer carries.

        The 2-norms of what is out of balance in each column, summed, as a share of that force.
        Where a few columns hold nearly all of it, that is far less than ``force_error``; it is
        infinite where one of them holds more than an average one carries.
        """
        force = np.abs(self.state.normal_force[SAMPLE])
        columns = np.sqrt(self.columns)
        if columns.max() > force.mean():
            return np.inf
        return float(columns.sum() / force.sum())


def balance(
    problem: LayerProblem, state: LayerState, drag: Drag[LayerState] | None = None
) -> Balance:
    """Evaluate equilibrium, incompressibility and contact at a state (see ``linearise``)."""
    body = problem.body.forces(state.u, state.p)
    force, volume_ref = body.force, body.reference_volume
    if drag is not None:
        force += drag.viscosity * problem.body.resistance.force(state.u - drag.origin.u)
    if problem.border is not None:
        problem.border.add_resistance(state.u, force)
    folded = folds(problem, state)
    for face in folded:
        face.add_forces(force)
    w = slip_coordinate(problem, state)
    slip, slip_of_sides = face_and_sides(w, problem.grid.node_shape[1:])
    sides = side_contact(problem, state, slip_of_sides)
    force[:, *sides.nodes] += sides.force
    glued = list(problem.glued)
    if any(glued):
        held = state.normal_force.copy()
        held[glued] = np.stack([force[2, 0], -force[2, -1]])[glued]
        state = replace(state, normal_force=held)
    bound = None if drag is None else np.stack(drag.bound)
    contact = linearise(problem, state, force, slip, bound)
    out = _residual(problem, state, force, contact)
    violation = (contact.violation**2).sum(0)
    columns = np.einsum("ckji,ckji->ji", out, out) + violation
    imbalance = float(np.sqrt(columns.sum()))
    whole, dragged = np.zeros((2, *problem.grid.node_shape))
    whole[[0, -1]] = contact.carried
    whole[sides.nodes] += sides.bound.sum(0)
    if drag is not None:
        dragged = drag.viscosity * problem.body.resistance.own
    friction = contact.friction(problem, out, whole, dragged[[0, -1]])
    side_friction = sides.friction(out, whole, dragged[sides.nodes])
    # what is left of it where friction turns as it will
    out[:2, [0, -1]] += np.moveaxis(friction.turned, 0, 1)
    if side_friction is not None:
        out[:2, *sides.nodes] += sides.turned(side_friction)
    problem.hold_sides(out, 0.0)
    return Balance(
        state=state,
        drag=drag,
        force=force,
        volume_ref=volume_ref,
        volume_change=float(body.volume.sum() / volume_ref.sum() - 1),
        volume_residual=body.volume_residual,
        flow=body.flow,
        contact=contact,
        sides=sides,
        folds=folded,
        friction=friction,
        side_friction=side_friction,
        merit=float(np.sqrt(np.vdot(out, out) + violation.sum())),
        min_jacobian=body.min_jacobian,
        columns=columns,
        imbalance=imbalance,
        force_error=imbalance / _force_scale(problem, state),
        volume_error=float(np.sqrt(np.mean((body.volume_residual / volume_ref) ** 2))),
    )


def _residual(
    problem: LayerProblem, state: LayerState, force: Array, contact: ContactLinearisation
) -> Array:
    out = force.copy()
    for face, k, sign in ((WINDOW, 0, -1.0), (SAMPLE, -1, 1.0)):
        out[:2, k] += contact.row[face] * force[2, k] + contact.traction[face]
        out[2, k] += sign * state.normal_force[face]
        if problem.glued[face]:
            out[:, k] = 0.0
    problem.hold_sides(out, 0.0)
    return out


def _force_scale(problem: LayerProblem, state: LayerState) -> float:
    """What forces out of balance are compared with: the contact forces (2-norm), mN.

    A pressure above ``_PRESSURE`` shear moduli counts as that. Where a thin layer sticks, or has
    nowhere to go, the pressure is many times what shears it, and a small share of it is a large
    error of all else.
    """
    unit = problem.shear_modulus * problem.grid.areas
    most = _PRESSURE * unit
    forces = np.linalg.norm(np.clip(state.normal_force, -most, most))
    return max(float(forces), _NO_PRESSURE * float(np.linalg.norm(unit)))


def _newton_step(
    problem: LayerProblem,
    now: Balance,
    solver: LinearSolver,
    tolerances: Tolerances,
    damping: float,
    eased: bool,
) -> Direction[Balance]:
    """Return where fractions of a Newton step lead."""
    viscosity = 0.0 if now.drag is None else now.drag.viscosity
    soft = softness(damping, _stiffness(problem), problem.shear_modulus)
    system = assemble(problem, now, solver, viscosity + damping, soft, eased)
    return _direction(problem, now, system, solver, tolerances)


def _direction(
    problem: LayerProblem,
    now: Balance,
    system: NewtonSystem,
    solver: LinearSolver,
    tolerances: Tolerances,
) -> Direction[Balance]:
    """Return where fractions of a step lead that undoes an imbalance by a tangent."""
    state = now.state
    rough = now.force_error > _CLOSE and problem.edges == "free"
    limit = min(tolerances.krylov, _ROUGH) if rough else tolerances.krylov
    # by no name, so that the solver can let go of it
    du, dp, krylov = solver.solve(system.right_hand_side(problem, now), tolerances.linear, limit)
    shape = problem.grid.node_shape
    if isinstance(solver, DirectSolver):
        spend(shape, 0, solver.work * math.prod(shape))
    else:
        spend(shape, krylov, 0.0)
    if not (np.isfinite(du).all() and np.isfinite(dp).all()):
        raise HardSystem("the linear system could not be solved")
    if krylov >= tolerances.krylov:
        raise HardSystem("the tangent is nearly singular")
    step = system.to_cartesian(du)
    _take_drift(problem, state, step)
    change = system.contact_forces(now.force, du, dp) - state.normal_force
    if problem.held_columns is not None:
        change[:, problem.held_columns] = 0.0

    drag = now.drag  # not to hold the rest of the balance in memory

    def follow(fraction: float) -> Balance:
        trial = replace(
            state,
            u=state.u + fraction * step,
            p=state.p + fraction * dp,
            normal_force=state.normal_force + fraction * change,
        )
        return balance(problem, trial, drag)

    return Direction(follow, krylov)


def _take_drift(problem: LayerProblem, state: LayerState, step: NDArray[np.floating]) -> None:
    """Take from a step what moves or turns the layer as a whole and nothing resists (in place).

    Of that a linear solver returns whatever its rounding errors make of it.
    """
    indifferent = problem.indifferent
    if not any(indifferent):
        return
    share = problem.grid.node_volumes / problem.grid.node_volumes.sum()
    for lateral, free in zip(step, indifferent, strict=False):
        if free:
            lateral -= (share * lateral).sum()
    if all(indifferent):
        x, y = problem.grid.nodes[:2] + state.u[:2]
        x, y = x - (share * x).sum(), y - (share * y).sum()
        turn = (share * (x * step[1] - y * step[0])).sum() / (share * (x**2 + y**2)).sum()
        step[0] += turn * y
        step[1] -= turn * x


@dataclass
class Solvers:
    """An iterative linear solver, and an exact one for the systems that it hardly solves.

    Thin layers that stick make such systems, and layers that are about to snap. They come in rows.
    ``last`` is the one that solved the last system.
    """

    iterative: LinearSolver
    exact: DirectSolver
    row: int = field(default=0, init=False)
    last: LinearSolver = field(init=False)

    def __post_init__(self) -> None:
        self.last = self.iterative

    def step(
        self,
        problem: LayerProblem,
        now: Balance,
        tolerances: Tolerances,
        damping: float,
        eased: bool,
    ) -> Direction[Balance]:
        """Return where fractions of a Newton step lead."""
        if self.row == 0:
            long = min(_BESIDES + int(self.exact.work / _ITERATION), _LONG)
            quickly = replace(tolerances, krylov=min(long, tolerances.krylov))
            try:
                self.last = self.iterative
                return _newton_step(problem, now, self.iterative, quickly, damping, eased)
            except HardSystem:
                self.row = _ROW
        self.row -= 1
        self.last = self.exact
        return _newton_step(problem, now, self.exact, tolerances, damping, eased)


@dataclass
class _Elimination:
    """Brings the few columns that are out of balance into equilibrium, the others held."""

    problem: LayerProblem
    tolerances: Tolerances
    drag: Drag[LayerState] | None
    due: Due
    eases: bool = False
    margin: int = field(default=_MARGIN, init=False)
    left: float = field(default=np.inf, init=False)
    tries: int = field(default=_ELIMINATIONS, init=False)

    def __call__(self, now: Balance, errors: Sequence[float]) -> Balance | None:
        """Return the balance after it; None where it is not due or leads nowhere.

        ``errors`` are those of the iterations so far, the present one last.
        """
        due = self.due
        if self.tries <= 0 or len(errors) <= due.first:
            return None
        if errors[-1] <= due.left * errors[-1 - due.last]:
            return None
        boxes = unbalanced_columns(now.columns, self.margin, due.most, due.share)
        if due.carried:
            boxes = [box for box in boxes if at_free_side(self.problem, box)]
        if not boxes:
            return None
        scale = now.imbalance / now.force_error
        found: list[Part] = []
        left, most = now.imbalance**2, (_PUSHED * now.imbalance) ** 2
        for box in boxes:
            part = self._solved(now.state, box, scale)
            after = left + self._added(now.state, part) if part else np.inf
            if part and after < most:
                found.append(part)
                left = after
        solved = balance(self.problem, put_back(now.state, found), self.drag) if found else None
        if solved is None:
            self.tries -= 3
            self.margin = min(self.margin + _WIDER, _WIDEST)
            return None
        self.tries -= 1
        if solved.force_error > 0.5 * self.left:
            self.margin = min(self.margin + _WIDER, _WIDEST)
        self.left = solved.force_error
        return solved

    def _added(self, state: LayerState, part: Part) -> float:
        """How much more is out of balance with a part that was solved: of the square of it, mN^2.

        That changes in the columns of the part and those where it was cut alone.
        """
        box, problem, solved = part
        wider = widened(box, self.problem.grid.node_shape[1:])
        inner = within(box, wider)
        whole, before = cut_out(self.problem, state, wider)
        after = put_back(before, [(inner, problem, solved)])
        drag = self._drag_of(wider)
        now = balance(whole, after, drag)
        if now.min_jacobian <= 0:
            return np.inf
        return float(now.columns.sum() - balance(whole, before, drag).columns.sum())

    def _drag_of(self, box: Box) -> Drag[LayerState] | None:
        if self.drag is None:
            return None
        origin = cut_out(self.problem, self.drag.origin, box)[1]
        return Drag(self.drag.viscosity, origin, [bound[box] for bound in self.drag.bound])

    def _solved(self, state: LayerState, box: Box, scale: float) -> Part | None:
        """Bring the columns of a box into equilibrium; None where they find none."""
        problem, own = cut_out(self.problem, state, box)
        drag = self._drag_of(box)
        now = balance(problem, own, drag)
        if now.imbalance < _KEEP * self.tolerances.force * scale:
            return None
        # the whole layer's forces are what errors are compared with
        factor = scale * now.force_error / now.imbalance
        force = max(0.3 * self.tolerances.force, _KEEP * now.force_error / factor)
        looser = max(1.0, force / self.tolerances.force) if self.due.carried else 1.0
        wanted = replace(
            self.tolerances,
            force=factor * force,
            volume=max(looser * self.tolerances.volume, _KEEP * now.volume_error),
            nearly=0.0,
        )
        if met(now, wanted):
            return None
        free = problem.edges == "free"
        iterative = MultigridSolver(problem.grid, problem.shear_modulus, free)
        solver = Solvers(iterative, direct_solver(problem))
        try:
            found = equilibrate(problem, own, solver, wanted, drag=drag, eases=self.eases)[0]
        except NotConverged as failure:
            if not self.due.carried or failure.nearest is None:
                return None
            found = failure.nearest[0]
            if found.imbalance > _NEARER * now.imbalance:
                return None
        return box, problem, found.state


def equilibrate(
    problem: LayerProblem,
    state: LayerState,
    solver: LinearSolver | Solvers,
    tolerances: Tolerances,
    on_iteration: Callable[[int, Balance, int], None] | None = None,
    drag: Drag[LayerState] | None = None,
    eliminate: Due | None = None,
    eases: bool | None = None,
) -> tuple[Balance, int]:
    """Bring a state into equilibrium at its load, ``drag`` included.

    Where a few columns keep the layer from equilibrium they are solved alone when they are due, to
    ``eliminate`` them. A layer that ``eases`` (by default one with free sides on a fine grid), and
    with it those columns, goes on with eased tangents (``assemble``) once a linear system is hard.

    Returns
    -------
    tuple
        The balance of the state in equilibrium and the number of Newton iterations.

    Raises
    ------
    NotConverged
        When the iterations run out, an element turns inside out or numbers overflow.
    """
    least = DAMPING * _stiffness(problem)

    # Near equilibrium a step or two remain: dear ones cost less than another way there.
    to_the_end = replace(tolerances, krylov=max(tolerances.krylov, _TO_THE_END))

    if eases is None:
        eases = problem.edges == "free" and problem.grid.n_elements > FINE
    eased = False

    def step(now: Balance, damping: float) -> Direction[Balance]:
        nonlocal eased
        wanted = to_the_end if now.force_error < _CLOSE else tolerances
        if isinstance(solver, Solvers):
            direction = solver.step(problem, now, wanted, damping, eased)
        else:
            direction = _newton_step(problem, now, solver, wanted, damping, eased)
        # The pressure jumps between the elements of a rim, and what it adds to the tangent there
        # is indefinite: once that shows, steps without most of it lead on sooner.
        eased = eased or (eases and direction.krylov >= _ROUGH)
        return direction

    columns = None
    if eliminate and problem.border is None:
        columns = _Elimination(problem, tolerances, drag, eliminate, eases)
    with threads_for(problem.grid.node_shape):
        # no name for the first balance: it would stay in memory until the end
        return iterate(
            balance(problem, state, drag), step, tolerances, least, on_iteration, columns
        )


def _stiffness(problem: LayerProblem) -> float:
    """Shear modulus per square of the thickness, of a part of its least extent, kPa / mm^2."""
    grid, least = problem.grid, problem.grid.typical_thickness
    if any(problem.held):
        least = min(least, grid.x[-1] - grid.x[0], grid.y[-1] - grid.y[0])
    return problem.shear_modulus / least**2


@dataclass
class LoadedLayer:
    """A layer on an imprint as ``Path`` loads it."""

    problem: LayerProblem
    solver: LinearSolver | Solvers
    eliminate: Due | None = SLOW

    @property
    def stiffness(self) -> float:
        """Shear modulus per thickness squared, kPa / mm^2."""
        return _stiffness(self.problem)

    @property
    def volumes(self) -> Array:
        """Volume of each node, (n), mm^3."""
        return self.problem.grid.node_volumes.ravel()

    def resistance(self, moved: Array) -> Array:
        """Forces, mN, of unit resistance (1 kPa / mm^2) to displacements, mm; both (3, n)."""
        body = self.problem.body
        return body.resistance.force(moved.reshape(3, *body.grid.node_shape)).reshape(3, -1)

    def displacement(self, state: LayerState) -> Array:
        """Displacement (x, y, z) of the nodes, (3, n), mm."""
        return state.u.reshape(3, -1)

    def covered(self, state: LayerState) -> float:
        """Share of where the layer was that it still covers."""
        return self.problem.grid.covered(state.u)

    def contact_forces(self, state: LayerState) -> Sequence[Array]:
        """Normal forces at window and sample, (ny + 1, nx + 1) each, mN."""
        return list(state.normal_force)

    def balance(self, state: LayerState) -> Balance:
        """How far a state is from equilibrium."""
        return balance(self.problem, state)

    def equilibrate(
        self,
        trial: LayerState,
        tolerances: Tolerances,
        on_iteration: Callable[[int, Balance, int], None],
        drag: Drag[LayerState] | None,
    ) -> tuple[Balance, int]:
        """Equilibrium at the load of ``trial``, and the Newton iterations; else NotConverged."""
        return equilibrate(
            self.problem,
            trial,
            self.solver,
            tolerances,
            on_iteration,
            drag,
            eliminate=self.eliminate,
        )

    def remember(self, now: Balance) -> LayerState:
        """Return the state of a balance, its reference slip laid."""
        remember_slip(self.problem, now.state, now.sides)
        return now.state


def equilibrate_by(
    system: NewtonSystem,
    problem: LayerProblem,
    state: LayerState,
    solver: LinearSolver,
    tolerances: Tolerances,
) -> LayerState | None:
    """Bring a state into equilibrium by the tangent of another one, which must be very near.

    Nothing is assembled: a step costs a linear solution alone. The system must be the one last
    assembled for the solver.

    Returns
    -------
    LayerState or None
        None where the steps do not lead there quickly.
    """
    with threads_for(problem.grid.node_shape):
        now = balance(problem, state)
        for _ in range(_CHORDS):
            after = _direction(problem, now, system, solver, tolerances).follow(1.0)
            nearer = after.imbalance < _NEARER * now.imbalance
            now = after
            if now.min_jacobian <= 0:
                return None
            if met(now, tolerances):
                return now.state
            if not nearer:
                return None
    return None
