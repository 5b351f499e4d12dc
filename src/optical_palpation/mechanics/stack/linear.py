"""One Newton step of two bodies in contact: GMRES on the displacements and pressures of both.

Of a contact, what counts is the displacement d normal to it, relative to what is met. It takes the
place of the slave's vertical displacement, so that closed contact prescribes a single unknown:

    u_z = d + c . u_lat + sum_a w_a (u_z - c . u_lat)_a,

with c the slope of the master's surface and w its weights at the slave. In turn, the slave's
vertical force, less what is put on its own lateral equations by slope and friction (``row`` r),
goes to the master: its nodes get the shares w of (-r, 1) of it. Products are those of the stencils
of the two bodies and of the interface's sparse matrices.

The preconditioner of the displacements is multiplicative, of two subspaces that together hold all
that closed contact allows. In the first the bodies are glued, the slave's surface moving as the
master's at its points: that is one body, on whose grid a multigrid V-cycle is done as if the
surfaces met node by node. In the second the slave alone moves, sliding on the other body: a V-cycle
on its own grid. The pressures are preconditioned as in ``krylov``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..body import Body
from ..contact import left_to_body, surface_stiffness
from ..krylov import gmres
from ..multigrid import Hierarchy
from ..schur import SchurComplement
from ..side_contact import SideTangent
from ..stencil import (
    constrain,
    empty_stencil,
    halo_zeros,
    interior,
    padded,
    store,
    subtract_product,
    threads_for,
)
from ..system import gather_divergence, scatter_divergence

Array = NDArray[np.float64]
Vector = NDArray[np.float32]

#: Penalty of the displacement blocks in units of the shear modulus.
_GAMMA = 3.0
#: Krylov iterations at which a linear solve ends whatever it has reached. Under the edges of a
#: stiff cube 60 to 100 are needed; with 25 Newton's method hardly moved there.
_LONGEST = 100


@dataclass(frozen=True, eq=False)
class Surface:
    """Linearised contact of a face; all arrays end in (ny + 1, nx + 1).

    ``row`` r and ``column`` c (x, y) are the factors with which the vertical equation enters the
    lateral ones and the lateral displacement the vertical one; ``friction`` (2, 2) is the lateral
    stiffness, ``spring`` that of d and ``load`` what belongs to it on the left-hand side, mN. Where
    ``rigid``, d is prescribed as ``step``, mm.
    """

    row: Array
    column: Array
    friction: Array
    spring: Array
    load: Array
    rigid: NDArray[np.bool_]
    step: Array


@dataclass(frozen=True, eq=False)
class ContactTangent:
    """Derivative of what a contact puts on the nodes, but for what follows from N, in factors.

    All have a row for x and y of each slave, and columns for x, y and z of each node: ``way`` is
    how far the slave moves from where the master was, ``lateral`` the stiffness by which its
    lateral force changes, by friction and by the turning of its faces, mN / mm, and ``shares`` what
    the nodes get of the whole force less for a unit of the way, mN / mm.
    """

    way: sp.csr_matrix
    lateral: sp.csr_matrix
    shares: sp.csr_matrix

    def astype(self, dtype: type) -> ContactTangent:
        """Return it in another precision."""
        return ContactTangent(*(m.astype(dtype) for m in (self.way, self.lateral, self.shares)))

    def __matmul__(self, u: NDArray[Any]) -> NDArray[Any]:
        """Forces by displacements, node by node."""
        return self.way.T @ (self.lateral @ u) + self.shares.T @ (self.way @ u)

    def matrix(self) -> sp.csr_matrix:
        """Return it as one matrix."""
        return sp.csr_matrix(self.way.T @ self.lateral + self.shares.T @ self.way)


@dataclass(frozen=True, eq=False)
class Coupling:
    """How the slaves, the nodes of a face, hang on the master's face of the other body.

    ``surface`` is the linearised contact of the slaves, ``weights`` w (slaves, masters) of the
    masters where the slaves are; ``tangent`` counts the slaves first, then the masters.
    ``turning`` (slaves, 9, 2, 3), mN / mm, is the derivative of a slave's lateral force by the
    positions of those around it, ``slope`` (2, ny + 1, nx + 1) that of the master's surface.
    """

    surface: Surface
    weights: sp.csr_matrix
    tangent: ContactTangent
    turning: Array
    slope: Array


@dataclass(frozen=True, eq=False)
class BodyEquations:
    """Linearised equations of one body at displacement ``u`` and pressure ``p``.

    ``residual`` are the nodal forces out of balance with the contact forces as they are, of the
    shape of u, mN; ``sides`` what presses the sides; ``volume_residual`` and ``volume`` as of
    ``ElementForces``.
    """

    u: Array
    p: Array
    residual: Array
    sides: SideTangent
    volume_residual: Array
    volume: Array


@dataclass(frozen=True, eq=False)
class StackEquations:
    """Linearised equations of two bodies, of their ``interface`` and of their outer faces.

    ``outer`` is the contact of the first body's face towards -z and of the second's towards +z with
    rigid planes. All nodes are held by a stiffness ``hold``, mN / mm, and by ``resistance``,
    kPa / mm^2. ``softness``, 1 / kPa, is a compressibility beside that of bodies of a stiffness
    factor of 1.
    """

    bodies: tuple[BodyEquations, BodyEquations]
    outer: tuple[Surface, Surface]
    interface: Coupling
    hold: float = 0.0
    resistance: float = 0.0
    softness: float = 0.0


@dataclass(frozen=True, eq=False)
class StackStep:
    """Newton step of displacements (3, ...), mm, and pressures, kPa, of both bodies.

    ``reactions``, mN: what is out of balance vertically after the step, to first order, on the
    nodes of the first body's outer face, the slaves and the second's outer face.
    """

    displacement: list[Array]
    pressure: list[Array]
    reactions: list[Array]
    iterations: int


class StackSolver:
    """Solves Newton systems of two bodies, the first towards -z.

    Parameters
    ----------
    bodies
        Their lateral nodes must be equal where both bodies are.
    slave
        The body, 0 or 1, whose nodes are held against the surface of the other.
    """

    def __init__(self, bodies: tuple[Body, Body], slave: int) -> None:
        self.bodies, self.slave, self.master = bodies, slave, 1 - slave
        grids = [body.grid for body in bodies]
        self.shapes = [grid.node_shape for grid in grids]
        #: Plane of nodes of each body that faces the other.
        self.facing = (self.shapes[0][0] - 1, 0)
        y, along_y = _merged(grids[0].y, grids[1].y)
        x, along_x = _merged(grids[0].x, grids[1].x)
        heights = [grid.depth * grid.typical_thickness for grid in grids]
        z = np.concatenate([heights[0], heights[0][-1] + heights[1][1:]])
        #: Where the nodes of each body lie in the grid of both glued together.
        self.places = [
            (slice(start, start + shape[0]), *lateral)
            for start, shape, lateral in zip(
                (0, self.facing[0]), self.shapes, zip(along_y, along_x, strict=True), strict=True
            )
        ]
        self.glued = Hierarchy((z, y, x))
        self.sliding = Hierarchy((heights[slave], grids[slave].y, grids[slave].x))
        self.penalties = [_GAMMA * body.law.shear_modulus for body in bodies]
        self.schur = [
            SchurComplement(b.grid.shape, b.grid.spacing, b.law.shear_modulus, gamma)
            for b, gamma in zip(bodies, self.penalties, strict=True)
        ]
        self.stencils = [empty_stencil(shape) for shape in self.shapes]
        self.work = [tuple(halo_zeros(shape) for _ in range(3)) for shape in self.shapes]

    def solve(self, equations: StackEquations, tolerance: float) -> StackStep:
        """Solve the linearised equations.

        ``tolerance`` is the reduction of the residual of all equations together, those of volumes
        weighted as in ``krylov``.
        """
        with threads_for(self.glued.levels[0].node_shape):
            return _System(self, equations).solve(tolerance)


def _merged(first: Array, second: Array) -> tuple[Array, tuple[slice, slice]]:
    """Nodes of two bodies along an axis, and where those of each are among them."""
    longer, shorter = (first, second) if len(first) >= len(second) else (second, first)
    start = int(np.argmin(np.abs(longer - shorter[0])))
    inside = slice(start, start + len(shorter))
    within = 1e-6 * (longer[-1] - longer[0])
    if len(longer[inside]) < len(shorter) or np.abs(longer[inside] - shorter).max() > within:
        raise ValueError("the lateral nodes of two bodies must be equal where both are")
    whole = slice(0, len(longer))
    return longer, (whole, inside) if longer is first else (inside, whole)


class _System:
    """One assembled system. Displacements are lists of the two bodies' fields."""

    def __init__(self, solver: StackSolver, equations: StackEquations) -> None:
        self.solver, self.equations = solver, equations
        self.link = _Link(solver, equations.interface)
        bodies = solver.bodies
        self.sizes = [3 * int(np.prod(shape)) for shape in solver.shapes]
        self.free, self.prescribed = self._constraints()
        self.mask = [free.astype(np.float32) for free in self.free]
        self.divergence = [
            np.empty((*body.grid.shape[:2], 24, body.grid.shape[2]), np.float32) for body in bodies
        ]
        self.volume = [e.volume.astype(np.float32) for e in equations.bodies]
        factors = [body.factor.astype(np.float32) for body in bodies]
        gammas = [g * f for g, f in zip(solver.penalties, factors, strict=True)]
        self.penalty = [g / v for g, v in zip(gammas, self.volume, strict=True)]
        moduli = [1.0 / (1.0 / b.law.bulk_modulus + equations.softness) for b in bodies]
        self.compressibility = [
            v / (np.float32(k) * f) for v, k, f in zip(self.volume, moduli, factors, strict=True)
        ]
        self.coupling = [
            np.float32(1 - g / k) for g, k in zip(solver.penalties, moduli, strict=True)
        ]
        self.weight = [
            ((np.float32(body.law.shear_modulus) * f + g) / np.cbrt(v)).astype(np.float32)
            for body, f, g, v in zip(bodies, factors, gammas, self.volume, strict=True)
        ]
        #: Volumes over stiffness factors, to which Schur complements are in proportion.
        self.softness = [v / f for v, f in zip(self.volume, factors, strict=True)]
        for schur, soft, k in zip(solver.schur, self.softness, moduli, strict=True):
            schur.prepare(soft, k)
        #: Of an imbalance at a contact, the share that this leaves to the body.
        self.shares = [(body, k, self._share(body, each)) for body, k, each in self._surfaces()]
        self._assemble()
        modes = [
            [np.ones_like(v) if n == m else np.zeros_like(v) for m, v in enumerate(self.volume)]
            for n in (0, 1)
        ]
        # The uniform pressures are what cosine modes miss most: they are solved for by themselves.
        uniform = np.zeros((2, 2))
        for n, mode in enumerate(modes):
            # that the slave may slide besides changes next to nothing here
            change = self.volume_change(self._glued(self.masked(self.pressure_force(mode))))
            uniform[:, n] = [part.sum(dtype=np.float64) for part in change]
            uniform[n, n] += self.compressibility[n].sum(dtype=np.float64)
        self.uniform = np.linalg.inv(uniform)

    def _constraints(self) -> tuple[list[NDArray[np.bool_]], list[Vector]]:
        """Free unknowns, and the prescribed step of the others."""
        free = [np.ones((3, *shape), bool) for shape in self.solver.shapes]
        step = [np.zeros((3, *shape), np.float32) for shape in self.solver.shapes]
        for body, k, surface in self._surfaces():
            free[body][2, k] = ~surface.rigid
            step[body][2, k] = np.where(surface.rigid, surface.step, 0.0)
        return free, step

    def _share(self, body: int, surface: Surface) -> Vector:
        """Of an imbalance of a face, (3, ny + 1, nx + 1), the share that contact does not take."""
        solver, grid = self.solver, self.solver.bodies[body].grid
        moduli = [each.median_shear_modulus for each in solver.bodies]
        # of two bodies the softer one gives way
        between = surface is self.equations.interface.surface
        own = surface_stiffness(grid, min(moduli) if between else moduli[body])
        (along_x, _), (_, along_y) = surface.friction
        return left_to_body(own, along_x, along_y, surface.spring).astype(np.float32)

    def _surfaces(self) -> list[tuple[int, int, Surface]]:
        """Body, plane of nodes and linearised contact of the outer faces and the slaves."""
        (first, last), slave = self.equations.outer, self.solver.slave
        inner = (slave, self.solver.facing[slave], self.equations.interface.surface)
        return [(0, 0, first), inner, (1, self.solver.shapes[1][0] - 1, last)]

    def _assemble(self) -> None:
        """Store the stencils: Cartesian ones for products, those of the two hierarchies."""
        solver, outer, much = self.solver, self.equations.outer, self.equations.resistance
        slave, master = solver.slave, solver.master
        z, y, x = solver.glued.levels[0].node_shape
        glued = np.zeros((y, 27, 9, padded(x)), np.float32)
        free = np.zeros((3, z, y, x), bool)
        for body in (0, 1):
            free[:, *solver.places[body]] |= self.free[body]
        free[:, solver.facing[0], *solver.places[master][1:]] = True
        within = self.free[slave].copy()
        for body, equations in enumerate(self.equations.bodies):
            nz1, _, nx1 = solver.shapes[body]
            _, at_y, at_x = solver.places[body]
            at_z = solver.places[body][0].start
            k_outer = 0 if body == 0 else nz1 - 1
            planes = solver.bodies[body].tangent_planes(
                equations.u, equations.p, solver.penalties[body], self.divergence[body]
            )
            for k, plane in enumerate(planes):
                diagonal = plane[:, 13, :, :nx1]
                diagonal[:, [0, 4, 8]] += self.equations.hold
                if much > 0:
                    solver.bodies[body].resistance.add_to(plane, k, much)
                equations.sides.add_stiffness(plane, k)
                if k == k_outer:
                    diagonal[:, [0, 1, 3, 4]] += _blocks(outer[body].friction)
                store(plane, solver.stencils[body], k)
                if k == k_outer:
                    _combine_rows(plane, outer[body].row)
                    diagonal[:, 8] += outer[body].spring
                self.link.to_frame(plane, body, k)
                if k != solver.facing[1] or body == 0:
                    glued[:] = 0
                glued[at_y, :, :, at_x.start : at_x.stop] += plane[..., :nx1]
                if k != solver.facing[0] or body == 1:
                    constrain(glued, free, at_z + k)
                    store(glued, solver.glued.levels[0].stencil, at_z + k)
                if body == slave:
                    if k == solver.facing[slave]:
                        surface = self.equations.interface.surface
                        diagonal[:, [0, 1, 3, 4]] += _blocks(surface.friction)
                        diagonal[:, 8] += surface.spring
                    constrain(plane, within, k)
                    store(plane, solver.sliding.levels[0].stencil, k)
        self.glued_mask = free.astype(np.float32)
        solver.glued.update(free)
        solver.sliding.update(within)

    def masked(self, force: list[Vector]) -> list[Vector]:
        """Clear the equations of constrained unknowns."""
        return [m * f for m, f in zip(self.mask, force, strict=True)]

    def combined(self, force: list[Vector]) -> list[Vector]:
        """Equations of the unknowns from Cartesian nodal forces (in place)."""
        for body, k, surface in self._surfaces():
            force[body][:2, k] += surface.row.astype(np.float32) * force[body][2, k]
        return self.link.pass_on(force)

    def product(self, u: list[Vector]) -> list[Vector]:
        """Forces by the displacement block, the equations of constrained unknowns included."""
        cartesian = self.link.to_cartesian(u)
        out = []
        for field, stencil, (x, b, r), shape in zip(
            cartesian, self.solver.stencils, self.solver.work, self.solver.shapes, strict=True
        ):
            interior(x, shape)[:] = field
            b[:] = 0
            subtract_product(stencil, x, b, r)
            out.append(-interior(r, shape))
        self.link.add_contact(cartesian, out)
        out = self.combined(out)
        for body, k, surface in self._surfaces():
            out[body][2, k] += surface.spring.astype(np.float32) * u[body][2, k]
        return out

    def volume_change(self, u: list[Vector]) -> list[Vector]:
        """B^T u: volume changes of the elements, mm^3."""
        out = []
        for divergence, field, v in zip(
            self.divergence, self.link.to_cartesian(u), self.volume, strict=True
        ):
            out.append(np.empty_like(v))
            gather_divergence(divergence, field, out[-1])
        return out

    def pressure_force(self, p: list[Vector]) -> list[Vector]:
        """B p: forces of pressures, mN."""
        out = []
        for divergence, part, shape in zip(self.divergence, p, self.solver.shapes, strict=True):
            out.append(np.empty((3, *shape), np.float32))
            scatter_divergence(divergence, part.astype(np.float32), out[-1])
        return self.combined(out)

    def displace(self, force: list[Vector]) -> list[Vector]:
        """Displacements by a force, approximately: one V-cycle in each of two subspaces."""
        glued = self._glued(force)
        left = [f - p for f, p in zip(force, self.product(glued), strict=True)]
        slave, hierarchy = self.solver.slave, self.solver.sliding
        shape = self.solver.shapes[slave]
        interior(hierarchy.levels[0].b, shape)[:] = self.mask[slave] * left[slave]
        glued[slave] += interior(hierarchy.cycle(), shape)
        return glued

    def _glued(self, force: list[Vector]) -> list[Vector]:
        """Displacements of both bodies glued together."""
        solver, hierarchy = self.solver, self.solver.glued
        shape = hierarchy.levels[0].node_shape
        inside = interior(hierarchy.levels[0].b, shape)
        inside[:] = 0
        for part, place in zip(self.link.to_glued(force), solver.places, strict=True):
            inside[:, *place] += part
        inside *= self.glued_mask
        solution = interior(hierarchy.cycle(), shape)
        out = self.link.from_glued([solution[:, *place].copy() for place in solver.places])
        return self.masked(out)

    def solve(self, tolerance: float) -> StackStep:
        """Solve by GMRES, preconditioned by the augmented block-triangular factor."""
        equations = self.equations.bodies
        residual = [e.residual.astype(np.float32) for e in equations]
        lifted = [
            p * e.volume_residual.astype(np.float32)
            for p, e in zip(self.penalty, equations, strict=True)
        ]
        known = self.product(self.prescribed)
        combined = self.combined([r.copy() for r in residual])
        for body, k, surface in self._surfaces():
            known[body][2, k] += surface.load.astype(np.float32)
        rhs_u = self.masked(
            [
                -(r + f + q)
                for r, f, q in zip(combined, self.pressure_force(lifted), known, strict=True)
            ]
        )
        rhs_p = [
            -w * (e.volume_residual.astype(np.float32) + v)
            for w, e, v in zip(
                self.weight, equations, self.volume_change(self.prescribed), strict=True
            )
        ]
        whole = self._join(self._shared(rhs_u), rhs_p)
        solution, iterations = gmres(self._operator, self._precondition, whole, tolerance, _LONGEST)
        u, dp = self._split(solution)
        u = [x + s for x, s in zip(u, self.prescribed, strict=True)]
        reactions = self._reactions(residual, u, dp)
        return StackStep(
            displacement=[x.astype(float) for x in self.link.to_cartesian(u)],
            pressure=[p.astype(float) for p in dp],
            reactions=reactions,
            iterations=iterations,
        )

    def _reactions(self, residual: list[Vector], u: list[Vector], dp: list[Vector]) -> list[Array]:
        penalised = [
            p - q * v for p, q, v in zip(dp, self.penalty, self.volume_change(u), strict=True)
        ]
        total = [
            a + b for a, b in zip(self.product(u), self.pressure_force(penalised), strict=True)
        ]
        return [
            (total[body][2, k] - surface.spring * u[body][2, k] + residual[body][2, k]).astype(
                float
            )
            for body, k, surface in self._surfaces()
        ]

    def _operator(self, v: Vector, out: Vector) -> None:
        u, p = self._split(v)
        change = self.volume_change(u)
        balance = self.masked([a + b for a, b in zip(self.product(u), self._pressed, strict=True)])
        out[:] = self._join(
            self._shared(balance),
            [
                (w * (dv - c * q)).astype(np.float32)
                for w, dv, c, q in zip(self.weight, change, self.compressibility, p, strict=True)
            ],
        )

    def _precondition(self, v: Vector, out: Vector) -> None:
        force, change = self._split(v.copy())
        change = [c / w for c, w in zip(change, self.weight, strict=True)]
        means = np.array([c.sum(dtype=np.float64) for c in change])
        levels = self.uniform @ means
        p: list[Vector] = []
        for n, schur in enumerate(self.solver.schur):
            share = np.float32(means[n] / self.softness[n].sum(dtype=np.float64))
            p.append(-schur.solve(change[n] - share * self.softness[n]))
            p[n] -= np.float32(levels[n])
        # the same pressures are multiplied next
        self._pressed = self.pressure_force([c * q for c, q in zip(self.coupling, p, strict=True)])
        for body, k, left_to_it in self.shares:
            force[body][:, k] /= left_to_it
        left = self.masked([f - q for f, q in zip(force, self._pressed, strict=True)])
        out[:] = self._join(self.displace(left), p)

    def _shared(self, force: list[Vector]) -> list[Vector]:
        """Forces weighted by the share that contacts leave to the bodies (in place)."""
        for body, k, share in self.shares:
            force[body][:, k] *= share
        return force

    def _join(self, u: list[Vector], p: list[Vector]) -> Vector:
        return np.concatenate([part.ravel() for part in (*u, *p)]).astype(np.float32, copy=False)

    def _split(self, v: Vector) -> tuple[list[Vector], list[Vector]]:
        parts = np.split(v, np.cumsum([*self.sizes, self.volume[0].size]))
        return (
            [
                part.reshape(3, *shape)
                for part, shape in zip(parts, self.solver.shapes, strict=False)
            ],
            [part.reshape(vol.shape) for part, vol in zip(parts[2:], self.volume, strict=True)],
        )


class _Link:
    """The interface's part in changes of unknowns and in products."""

    def __init__(self, solver: StackSolver, interface: Coupling) -> None:
        self.slave, self.master = solver.slave, solver.master
        self.k_slave, self.k_master = (solver.facing[b] for b in (self.slave, self.master))
        surface = interface.surface
        flat = lambda a: a.reshape(*a.shape[:-2], -1).astype(np.float32)  # noqa: E731
        self.row, self.column = flat(surface.row), flat(surface.column)
        self.slope = flat(interface.slope)
        self.frame_row, self.frame_column = surface.row, surface.column
        self.frame_slope = interface.slope
        self.weights = interface.weights.astype(np.float32)
        self.given = self.weights.T.tocsr()
        self.tangent = interface.tangent.astype(np.float32)
        self.turning = interface.turning.astype(np.float32)

    def _faces(self, fields: list[Vector]) -> tuple[Vector, Vector]:
        """Views of the slaves and the masters, (3, ny + 1, nx + 1)."""
        return fields[self.slave][:, self.k_slave], fields[self.master][:, self.k_master]

    def to_cartesian(self, u: list[Vector]) -> list[Vector]:
        """Displacements from unknowns."""
        out = list(u)
        out[self.slave] = u[self.slave].copy()
        slave, master = self._faces(out)
        shape = slave.shape[1:]
        carried = self.weights @ master.reshape(3, -1).T
        own = self.column * (slave[:2].reshape(2, -1) - carried[:, :2].T)
        slave[2] += (own.sum(0) + carried[:, 2]).reshape(shape)
        return out

    def pass_on(self, force: list[Vector]) -> list[Vector]:
        """Put on the masters what the vertical forces of the slaves put there (in place)."""
        slave, master = self._faces(force)
        vertical = slave[2].ravel()
        given = self.given @ np.stack(
            [-self.row[0] * vertical, -self.row[1] * vertical, vertical], 1
        )
        master += given.T.reshape(master.shape)
        return force

    def add_contact(self, u: list[Vector], force: list[Vector]) -> None:
        """Add friction and the turning of contact forces to the forces by a displacement."""
        moved = np.concatenate([face.reshape(3, -1).T for face in self._faces(u)])
        put = (self.tangent @ moved.ravel()).reshape(-1, 3).T
        for face in self._faces(force):
            face += put[:, : face[0].size].reshape(face.shape)
            put = put[:, face[0].size :]

    def to_frame(self, plane: Vector, body: int, k: int) -> None:
        """Transform a plane of stencils to displacements normal to the interface (in place)."""
        k_face = self.k_slave if body == self.slave else self.k_master
        column = self.frame_column if body == self.slave else self.frame_slope
        row = self.frame_row if body == self.slave else self.frame_slope
        if k == k_face:
            if body == self.slave:
                nx1 = row.shape[2]
                turning = self.turning.reshape(*row.shape[1:], 9, 2, 3)
                plane[:, 9:18, :6, :nx1] -= turning.transpose(0, 2, 3, 4, 1).reshape(
                    row.shape[1], 9, 6, nx1
                )
            _combine_rows(plane, row)
        if abs(k_face - k) <= 1:
            _combine_columns(plane, k_face - k, column)

    def to_glued(self, force: list[Vector]) -> list[Vector]:
        """Forces on the glued bodies in the frame of the master's surface."""
        out = list(force)
        for body in (self.slave, self.master):
            out[body] = force[body].copy()
        slave, master = self._faces(out)
        given = self.given @ slave[:2].reshape(2, -1).T
        master[:2] += self.slope.reshape(master[:2].shape) * master[2]
        master[:2] += given.T.reshape(master[:2].shape)
        slave[:] = 0
        return out

    def from_glued(self, u: list[Vector]) -> list[Vector]:
        """Unknowns from displacements of the glued bodies (in place)."""
        slave, master = self._faces(u)
        slave[:2] = (self.weights @ master[:2].reshape(2, -1).T).T.reshape(slave[:2].shape)
        slave[2] = 0
        master[2] += (self.slope.reshape(master[:2].shape) * master[:2]).sum(0)
        return u


def _blocks(friction: Array) -> Array:
    """Entries xx, xy, yx, yy of blocks (2, 2, ny + 1, nx + 1) as a plane of stencils has them."""
    return friction.reshape(4, *friction.shape[2:]).swapaxes(0, 1)


def _combine_rows(plane: Vector, row: Array) -> None:
    """Add the vertical rows times ``row`` (2, ny + 1, nx + 1) to the lateral ones (in place)."""
    nx1 = row.shape[2]
    for c in range(2):
        factor = row[c].astype(np.float32)[:, None, None]
        plane[:, :, 3 * c : 3 * c + 3, :nx1] += factor * plane[:, :, 6:9, :nx1]


def _combine_columns(plane: Vector, dz: int, column: Array) -> None:
    """Add the vertical columns times ``column`` to the lateral ones, of neighbours ``dz`` away."""
    _, ny1, nx1 = column.shape
    there = np.pad(column.astype(np.float32), ((0, 0), (1, 1), (1, 1)))
    for n in range(9):
        dy, dx = n // 3, n % 3
        entries = plane[:, 9 * (dz + 1) + n]
        for c in range(2):
            factor = there[c, dy : dy + ny1, dx : dx + nx1][:, None]
            entries[:, c::3, :nx1] += factor * entries[:, 2::3, :nx1]
