"""Contact at the window and at the imprint: unilateral with Coulomb friction, or glued.

Each surface node has a vertical penetration phi of a rigid surface, -z at the window and
z - h(x, y) at the imprint, and a vertical contact force N, the multiplier of phi <= 0.
Complementarity of the two is written as one smooth equation per node,

    psi = N - S(N + c phi) = 0,    S(t) = (t + sqrt(t^2 + 4 eps^2)) / 2,

which for eps -> 0 is N = max(0, N + c phi). N phi = -eps^2 / c: with eps of a thousandth of the
shear modulus a pressed node keeps a gap of less than a nanometre. A hard active set instead of it
flickers for ever on a few nodes at free edges. Of a layer that is hardly pressed eps is smaller in
proportion, or its force would be that of eps.

Friction is that of ``friction``, mu N s along the slip. Where the imprint moves sideways, slip is
relative to that point of it where the node was at the last load. The lateral equations of a surface
node are

    f_x + (a_x - mu s_x) f_z = 0 (imprint),    f_x + mu s_x f_z = 0 (window),

in which the vertical internal force f_z = -+N carries both the slope and the friction bound, so
that these are linearised exactly together with the pressure; s itself is linearised where it will
be (``friction.look_ahead``).

The slope a = -(A_x, A_y) / A_z along which the contact force acts is that of the deformed element
faces, with A the area vector of the node (the gradient of the layer's volume), not that of the
imprint: a uniform pressure is then in exact equilibrium on the mesh. With the imprint's own slope a
pressure well above the shear modulus drives the nodes sideways. Where the layer has rolled so far
that the outermost faces are folded, the area of a node is next to nothing and has no direction;
there the imprint's own slope makes up for it (``push_slope``).

The free sides meet both surfaces too (``side_contact``).

The nodes of a glued face are prescribed altogether: those at the window stay, those at the imprint
go with the point that they lay on at first. What holds them is read off the internal forces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from optical_palpation.runtime.kernels import keep_kernels

from .faces import SHAPE, SLOPE, push_slope
from .friction import friction_direction, look_ahead, node_stiffness, remembered
from .grid import LayerGrid, contact_nodes, face_and_sides
from .problem import SAMPLE, WINDOW, LayerProblem, LayerState
from .side_contact import SideContact, side_contact

keep_kernels()

Array = NDArray[np.float64]

#: Smoothing eps of contact, as a pressure in units of the shear modulus; from the first iteration
#: on, because the pressure of a layer with nowhere to go depends on it and would be sought twice.
_SMOOTHING = 1e-3
#: Compression below which contact and friction are the sharper the less there is, and what counts
#: as none at all.
_COMPRESSED, _NOT_AT_ALL = 0.1, 1e-6
#: A contact spring stiffer than this many times its scale c is a prescribed displacement.
STIFF = 1e3
#: Between rollers, where the layer resists with its bulk modulus, it must be stiffer than this many
#: times c K / mu. A softer one taken as rigid made Newton's method swing between too much pressure
#: and too little. It is sought from where it would be if rigid, or all else drowns in its force.
#: With free edges such springs would only make linear systems harder.
_RIGID = 10.0


@dataclass(frozen=True)
class ContactLinearisation:
    """Everything the Newton system needs from both contact surfaces.

    All arrays end in ``(ny + 1, nx + 1)`` and begin with the face. ``row`` and ``column`` (x, y)
    are the factors with which the vertical equation and the vertical displacement enter the lateral
    ones; ``traction`` (x, y) friction of a bound that is given, mN; ``slip`` (x, y) that of the
    law of friction, ``carried`` its bound mu N, mN, ``coupled`` the mu by which that follows from
    the vertical equations and ``bound`` the same for the stiffness, which a node keeps while its
    reaction comes and goes; ``turning`` (ny + 1, nx + 1, 9, 2, 3; imprint only) the lateral
    stiffness by which contact forces turn with the element faces, over the neighbours
    3 (dy + 1) + (dx + 1); ``spring`` the stiffness of the contact coordinate d, where ``stiff`` so
    great that d is sought from where it would be were it prescribed, where ``rigid`` prescribed
    indeed. ``violation`` is psi, mN, where glued c times the
    distance ``off`` (x, y, z; 0 elsewhere) from where the node belongs.
    """

    penetration: Array
    violation: Array
    off: Array
    row: Array
    column: Array
    traction: Array
    slip: Array
    bound: Array
    carried: Array
    coupled: Array
    turning: Array
    spring: Array
    stiff: NDArray[np.bool_]
    rigid: NDArray[np.bool_]

    def friction(
        self, problem: LayerProblem, residual: Array, whole: Array, resistance: Array | float = 0.0
    ) -> FaceFriction:
        """Linearise friction of a state.

        Parameters
        ----------
        residual
            That of ``Balance``, mN.
        whole
            The bound of all friction at each node, (nz + 1, ny + 1, nx + 1), mN.
        resistance
            How drag resists the nodes of both faces, (2, ny + 1, nx + 1), mN / mm.
        """
        height = problem.grid.typical_thickness
        elastic = node_stiffness(problem.shear_modulus, problem.grid.areas, height) + resistance
        lateral = np.moveaxis(residual[:2, [0, -1]], 1, 0)
        ahead = look_ahead(self.slip, lateral, elastic * problem.slip_length, whole[[0, -1]])
        coupled = self.coupled[:, None] * ahead.turned
        block = self.bound[:, None] / problem.slip_length * ahead.slope
        # not part of the equations; it tells the linear solver that a glued face sticks
        sticks = STIFF * surface_stiffness(problem.grid, problem.shear_modulus)
        block[list(problem.glued)] = sticks * np.array([1.0, 0.0, 1.0])[:, None, None]
        return FaceFriction(
            row=self.row + np.array([1.0, -1.0])[:, None, None, None] * coupled,
            block=block,
            change=self.carried[:, None] * ahead.change,
            turned=self.carried[:, None] * ahead.turned,
        )

    def to_undo(
        self, problem: LayerProblem, now: ContactLinearisation, normal_force: Array
    ) -> tuple[Array, Array]:
        """What a step must undo of the contact ``now`` of this state or of one near it.

        Returns
        -------
        tuple
            The right-hand side of the vertical equations, (2, ny + 1, nx + 1), mN, and the step
            (x, y, d) of both faces that is prescribed or sought from, (2, 3, ny + 1, nx + 1), mm.
        """
        c = surface_stiffness(problem.grid, problem.shear_modulus)
        other = c / (c + self.spring)  # 1 - S', and 1 where rigid
        # d is z: at the window penetration grows with -d
        sign = np.array([-1.0, 1.0])[:, None, None]
        load = np.where(self.rigid, 0.0, sign * (now.violation / other - normal_force))
        step = np.zeros((2, 3, *c.shape))
        step[:, 2] = np.where(self.stiff, sign * now.violation / c, 0.0)
        for face, glued in enumerate(problem.glued):
            if glued:
                load[face], step[face] = 0.0, now.off[face]
        return load, step


@dataclass(frozen=True)
class FaceFriction:
    """Friction of both faces linearised, by the step of the slip (``friction.look_ahead``).

    All arrays begin with the face and end in (ny + 1, nx + 1): ``row`` (x, y) as that of
    ``ContactLinearisation``, with friction as it will be, ``block`` (xx, xy, yy) its lateral
    stiffness, mN / mm, ``change`` (x, y) what it is to begin with beyond that of the state, and
    ``turned`` (x, y) what it will be beyond that where each node comes to rest alone, mN.
    """

    row: Array
    block: Array
    change: Array
    turned: Array


def surface_stiffness(grid: LayerGrid, shear_modulus: float) -> Array:
    """How stiff the elements at a face are against what presses it, mN / mm, (ny + 1, nx + 1).

    It is the scale c of the law of contact.
    """
    return grid.areas * shear_modulus / grid.spacing[0]


def left_to_body(own: Array, x: Array, y: Array, d: Array) -> Array:
    """Share of an imbalance (x, y, d) at a face that contact leaves to a body, (3, ...).

    ``own`` is the stiffness of the body there, the others those of friction and contact, mN / mm.
    """
    return own / (own + np.abs([x, y, d]))


def glued_displacement(problem: LayerProblem, face: int, load: float) -> Array:
    """Displacement of the nodes of a glued face at a load, (3, ny + 1, nx + 1), mm."""
    x, y, z = problem.grid.nodes[:, -1]
    moved = np.zeros((3, *x.shape))
    if face == SAMPLE:
        moved[:2] = load * problem.imprint.velocity(x, y, 0.0)
        moved[2] = problem.imprint.evaluate(x + moved[0], y + moved[1], load)[0] - z
    return moved


def slip_coordinate(problem: LayerProblem, state: LayerState) -> Array:
    """The slip w in slip lengths, memory included, (2, 2, m) on ``contact_nodes``."""
    slip = state.lateral() - state.anchor
    x, y = contact_nodes(problem.grid.nodes[:2])[SAMPLE] + state.anchor[SAMPLE]
    velocity = problem.imprint.velocity(x, y, state.anchor_load)
    slip[SAMPLE] -= (state.load - state.anchor_load) * velocity
    return state.slip + slip / problem.slip_length


def smoothness(compression: float) -> float:
    """How smooth the laws of contact and friction are, as a share of what they may be at most.

    ``compression`` is the greatest of the layer at its full load, a share of its thickness. Where
    that is small the smoothing would be as large as pressure and slip themselves.
    """
    return float(np.clip(compression, _NOT_AT_ALL, _COMPRESSED)) / _COMPRESSED


def smoothing(compression: float) -> float:
    """Return eps, as a pressure in units of the shear modulus."""
    return _SMOOTHING * smoothness(compression)


def smooth_maximum(t: Array, eps: Array) -> tuple[Array, Array]:
    """S(t) = (t + sqrt(t^2 + 4 eps^2)) / 2, and 1 - S'(t)."""
    root = np.sqrt(t**2 + 4 * eps**2)
    # without cancellation: root - t = far for t < 0
    far = root + np.abs(t)
    value = np.where(t > 0, 0.5 * far, 2 * eps**2 / far)
    other = np.where(t > 0, 2 * eps**2 / (root * far), 0.5 * far / root)
    return value, other


def linearise(
    problem: LayerProblem,
    state: LayerState,
    force: Array,
    slip: Array,
    bound: Array | None = None,
) -> ContactLinearisation:
    """Linearise contact and friction at ``state`` with the internal nodal ``force``.

    ``force`` includes what presses the sides; ``slip`` is the w of the faces, (2, 2, ny + 1,
    nx + 1). Friction is bounded by the contact forces themselves or, if given, by the normal forces
    ``bound`` (2, ny + 1, nx + 1), mN.
    """
    nodes = problem.grid.nodes
    bottom = nodes[:, 0] + state.u[:, 0]
    top = nodes[:, -1] + state.u[:, -1]
    h, hx, hy, hxx, hxy, hyy = problem.imprint.evaluate(top[0], top[1], state.load)
    penetration = np.stack([-bottom[2], top[2] - h])
    normal = state.normal_force
    reaction = np.stack([force[2, 0], -force[2, -1]])

    c = surface_stiffness(problem.grid, problem.shear_modulus)
    eps = smoothing(problem.compression) * c * problem.grid.spacing[0]
    t = normal + c * penetration
    s_value, other = smooth_maximum(t, eps)
    slope = 1 - other
    violation = normal - s_value
    stiff = slope > STIFF * other
    rigid = stiff.copy()
    if problem.edges == "roller":
        rigid &= slope > _RIGID * problem.bulk_modulus / problem.shear_modulus * other
    spring = np.where(rigid, 0.0, slope * c / np.where(rigid, 1.0, other))
    off = np.zeros((2, 3, *c.shape))

    s = friction_direction(slip)
    friction = np.asarray(problem.friction)[:, None, None]
    if bound is None:
        coupled = friction * (reaction > 0)
        traction = np.zeros_like(s)
        most = friction * np.maximum(0.0, np.maximum(reaction, normal))
        carried = coupled * reaction
    else:
        coupled = np.zeros_like(reaction)
        most = carried = friction * np.maximum(bound, 0.0)
        traction = most[:, None] * s
    row = coupled[:, None] * s
    push, area, missing = push_slope(top, problem.grid.areas, np.stack([hx, hy]))
    row[SAMPLE] = push - row[SAMPLE]
    column = np.zeros_like(row)
    column[SAMPLE] = hx, hy

    pressed = np.maximum(normal[SAMPLE], 0.0)
    turning = np.zeros((*h.shape, 9, 2, 3))
    turning_stiffness(top, pressed / area, np.where(missing > 0, np.stack([hx, hy]), push), turning)
    curvature = np.moveaxis(np.array([[hxx, hxy], [hxy, hyy]]), (0, 1), (-2, -1))
    turning[..., 4, :, :2] -= (pressed * missing)[..., None, None] * curvature
    for face, k in ((WINDOW, 0), (SAMPLE, -1)):
        if problem.glued[face]:
            off[face] = glued_displacement(problem, face, state.load) - state.u[:, k]
            violation[face] = c * np.linalg.norm(off[face], axis=0)
            for nothing in (row, column, traction, most, carried, coupled, spring):
                nothing[face] = 0.0
            rigid[face] = True
            if face == SAMPLE:
                turning[:] = 0.0
    if problem.held_columns is not None:  # their contact is none of this problem's
        violation[:, problem.held_columns] = 0.0
        off[..., problem.held_columns] = 0.0
    return ContactLinearisation(
        penetration,
        violation,
        off,
        row,
        column,
        traction,
        slip,
        most,
        carried,
        coupled,
        turning,
        spring,
        stiff,
        rigid,
    )


@nb.njit(cache=True)
def turning_stiffness(surface, pressure, slope, out):
    """Lateral stiffness p (dA_x + a_x dA_z), p (dA_y + a_y dA_z) of each node.

    ``pressure`` p is the contact force by the area of ``push_slope``, ``slope`` a that of the faces
    or, where they are folded, of what is met.
    """
    _, ny1, nx1 = surface.shape
    t, s = np.empty((4, 3)), np.empty((4, 3))
    for j in range(ny1 - 1):
        for i in range(nx1 - 1):
            for c in range(3):
                x0, x1 = surface[c, j, i], surface[c, j, i + 1]
                x2, x3 = surface[c, j + 1, i], surface[c, j + 1, i + 1]
                for q in range(4):
                    d = SLOPE[q]
                    t[q, c] = 0.25 * (d[0, 0] * x0 + d[1, 0] * x1 + d[2, 0] * x2 + d[3, 0] * x3)
                    s[q, c] = 0.25 * (d[0, 1] * x0 + d[1, 1] * x1 + d[2, 1] * x2 + d[3, 1] * x3)
            for a in range(4):
                jj, ii = j + (a >> 1), i + (a & 1)
                p, ax, ay = pressure[jj, ii], slope[0, jj, ii], slope[1, jj, ii]
                for b in range(4):
                    # derivative of t x s with respect to node b: the cross product with v
                    v0 = v1 = v2 = 0.0
                    for q in range(4):
                        weight = p * SHAPE[q, a]
                        along_x, along_y = weight * SLOPE[q, b, 0], weight * SLOPE[q, b, 1]
                        v0 += along_y * t[q, 0] - along_x * s[q, 0]
                        v1 += along_y * t[q, 1] - along_x * s[q, 1]
                        v2 += along_y * t[q, 2] - along_x * s[q, 2]
                    k = out[jj, ii, 3 * ((b >> 1) - (a >> 1) + 1) + (b & 1) - (a & 1) + 1]
                    k[0, 0] -= ax * v1
                    k[0, 1] += ax * v0 - v2
                    k[0, 2] += v1
                    k[1, 0] += v2 - ay * v1
                    k[1, 1] += ay * v0
                    k[1, 2] -= v0


def remember_slip(
    problem: LayerProblem, state: LayerState, sides: SideContact | None = None
) -> None:
    """Carry the friction state to the next load (in place); ``sides`` are its, if known."""
    w = slip_coordinate(problem, state)
    rolled = (sides or side_contact(problem, state)).normal_force > 0
    touching = np.concatenate([state.touching(problem).reshape(2, -1), rolled], axis=1)
    state.slip = np.where(touching[:, None], remembered(w), 0.0)
    state.slip[list(problem.glued)] = 0.0
    state.anchor, state.anchor_load = state.lateral(), state.load


def friction_fraction(problem: LayerProblem, state: LayerState) -> Array:
    """Share of the friction bound in use at each node, (2, ny + 1, nx + 1); 1 without friction."""
    w, _ = face_and_sides(slip_coordinate(problem, state), problem.grid.node_shape[1:])
    used = np.sqrt((friction_direction(w) ** 2).sum(1))
    return np.where(np.asarray(problem.friction)[:, None, None] > 0, used, 1.0)
