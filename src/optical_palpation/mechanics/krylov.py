"""The fast linear solver: GMRES on displacement and pressure.

Preconditioned by the augmented-Lagrangian block-triangular factor: one multigrid V-cycle for the
displacement block A + gamma B V^-1 B^T, and the Schur complement of the pressure in cosine modes.
All in single precision: Newton's residual, in double, sets the accuracy.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from optical_palpation.runtime.heap import give_back

from .contact import left_to_body, surface_stiffness
from .grid import LayerGrid
from .multigrid import Hierarchy
from .schur import Lubrication, SchurComplement
from .stencil import (
    Stencil,
    exchanged,
    interior,
    store,
    subtract_product,
    turned,
)
from .system import NewtonSystem, RightHandSide, with_prescribed

Vector = NDArray[np.floating]

#: Penalty of the displacement block in units of the shear modulus.
_GAMMA = 3.0
#: Krylov iterations at which a linear solve ends whatever it has reached: many where they cost
#: little, on the coarse grids on which the load is followed, few where their vectors would take
#: more memory than all else.
_LONGEST, SMALL = (10, 30, 100), 200_000
#: What a vector keeps when the directions found before are taken out of it, below which rounding
#: is too much of that and they are taken out again. A layer that snaps has a mode that the
#: preconditioner blows up by thousands: every iteration would find it anew.
_CANCELLED = 0.1
#: Unknowns up to which preconditioned vectors are kept, a tenth of the solver's memory. The
#: solution is theirs: without them it is preconditioned once more, and of a mode blown up by
#: thousands only rounded.
KEPT = 8_000_000


class MultigridSolver:
    """Solve Newton systems of one grid by preconditioned GMRES; work grows with the unknowns."""

    dtype: ClassVar[type[np.floating]] = np.float32

    def __init__(self, grid: LayerGrid, shear_modulus: float, free_sides: bool) -> None:
        self.gamma = _GAMMA * shear_modulus
        self.shear_modulus = shear_modulus
        depth = grid.depth * grid.typical_thickness
        #: Whether the hierarchy has the axes y and x exchanged.
        self.turned = turned(grid.node_shape)
        lateral = (grid.x, grid.y) if self.turned else (grid.y, grid.x)
        self.hierarchy = Hierarchy((depth, *lateral))
        self.schur = SchurComplement(grid.shape, grid.spacing, shear_modulus, self.gamma)
        self.lubrication = Lubrication(depth, grid.y, grid.x, free_sides, shear_modulus)
        self.areas = grid.areas
        #: Stiffness of the body at a face, mN / mm; a contact that is stiffer counts as closed.
        self.own = surface_stiffness(grid, shear_modulus)

    @property
    def stencil(self) -> Stencil:
        """The displacement block."""
        return self.hierarchy.levels[0].stencil

    def store(self, k: int, plane: Vector) -> None:
        """Take plane k of the displacement block."""
        if self.turned:
            plane = exchanged(plane, len(self.stencil.entries[k]))
        store(plane, self.stencil, k)

    def inside(self, vector: Vector) -> Vector:
        """View of a vector of the hierarchy as a displacement (3, nz + 1, ny + 1, nx + 1)."""
        own = interior(vector, self.hierarchy.levels[0].node_shape)
        return own.swapaxes(2, 3) if self.turned else own

    def prepare(self, system: NewtonSystem) -> None:
        """Update the preconditioner to a system whose planes have all been stored."""
        f32 = np.float32
        self.system = system
        free = system.free.swapaxes(2, 3) if self.turned else system.free
        self.hierarchy.update(np.ascontiguousarray(free))  # for which the kernels are compiled
        volume = self.volume = system.volume.astype(f32)
        self.weight = f32(self.shear_modulus + system.gamma) / np.cbrt(volume)
        self.schur.prepare(volume, system.bulk_modulus, system.flow is not None)
        contact = system.contact
        stiffness = _of_elements(system.friction.block[:, [2, 0]] / self.areas)
        touching = _of_elements(np.where(contact.rigid, 1.0, contact.spring > self.own))
        self.lubrication.prepare(stiffness, touching, system.bulk_modulus)
        along_x, _, along_y = np.moveaxis(system.friction.block, 1, 0)
        self.share = left_to_body(self.own, along_x, along_y, contact.spring).astype(f32)
        # The uniform pressure is the mode that cosine modes miss most (a layer with nowhere to go
        # answers to it with its bulk modulus alone): it is solved for by itself.
        self.inside(self.hierarchy.levels[0].b)[:] = self.pressed(np.ones_like(volume))
        compressibility = float((volume / f32(system.bulk_modulus)).sum())
        uniform = self.hierarchy.compliance() + compressibility
        total = self.total = float(volume.sum())
        # what lubrication says of that mode is not counted twice
        held = float((volume * self.lubrication.solve(volume)).sum()) / total
        self.rest = max(0.0, 1 / uniform - held / total)

    def pressed(self, p: Vector) -> Vector:
        """B p on the free unknowns: nodal forces, mN, in contact coordinates."""
        force = self.system.pressure_force(p)
        force *= self.system.free
        return force

    def solve(
        self, rhs: RightHandSide, tolerance: float, limit: int | None = None
    ) -> tuple[Vector, Vector, int]:
        """Return the step (du in contact coordinates, dp) and the number of iterations.

        There are at most ``limit`` of these. ``tolerance`` is the reduction of the residual of both
        equations together, each pressure equation weighted by (mu + gamma) / V^(1/3) to make it a
        force, each force by the share of it that contact leaves to the body.
        """
        f32 = np.float32
        system, volume, weight, share = self.system, self.volume, self.weight, self.share
        penalty, nodes = f32(system.gamma) / volume, system.free.shape
        finest = self.hierarchy.levels[0]  # whose vectors serve products as well: memory
        b, r = self.inside(finest.b), self.inside(finest.r)
        size, total = system.free.size, self.total

        def split(v: Vector) -> tuple[Vector, Vector]:
            return v[:size].reshape(nodes), v[size:].reshape(volume.shape)

        # of what was preconditioned last, and is multiplied next
        compression = pressed = np.zeros(0, f32)

        def precondition(v: Vector, out: Vector) -> None:
            nonlocal compression, pressed
            (r_u, r_p), (out_u, out_p) = split(v), split(out)
            r_p = r_p / weight
            mean = float(r_p.sum(dtype=np.float64))
            out_p[:] = -self.schur.solve(r_p - volume * f32(mean / total)) - f32(mean * self.rest)
            out_p -= self.lubrication.solve(r_p)
            compression = system.compression(out_p)
            pressed = self.pressed(out_p - penalty * compression)
            b[:] = r_u
            b[:, [0, -1]] /= share
            b[:] -= pressed
            out_u[:] = self.inside(self.hierarchy.cycle())

        def operator(v: Vector, out: Vector) -> None:
            (u, _), (out_u, out_p) = split(v), split(out)
            np.negative(pressed, out=b)
            subtract_product(system.stencil, finest.x, finest.b, finest.r)  # x is u
            np.negative(r, out=out_u)
            out_u[:, [0, -1]] *= share
            np.subtract(system.volume_change(u), compression, out=out_p)
            out_p *= weight

        b0 = np.concatenate([rhs.displacement.ravel(), (weight * rhs.volume).ravel()])
        split(b0)[0][:, [0, -1]] *= share
        most = longest(b0.size) if limit is None else min(limit, longest(b0.size))
        prescribed = rhs.prescribed
        del rhs  # memory peaks here
        if b0.size > SMALL:
            give_back()
        # a preconditioner may blow up where the layer snaps: Newton's method then tries otherwise
        with np.errstate(over="ignore", invalid="ignore"):
            solution, iterations = gmres(operator, precondition, b0, tolerance, most)
        du, dp = split(solution)
        return with_prescribed(du, prescribed), dp, iterations


def longest(unknowns: int) -> int:
    """Krylov iterations at which a linear solve ends."""
    return _LONGEST[(unknowns <= KEPT) + (unknowns <= SMALL)]


def _of_elements(field: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the four nodes of each face, over the last two axes."""
    rows = field[..., 1:, :] + field[..., :-1, :]
    return 0.25 * (rows[..., 1:] + rows[..., :-1])


def gmres(operator, precondition, rhs: Vector, tolerance: float, longest: int):
    """GMRES from a zero guess, without restart, preconditioned from the right.

    ``operator`` and ``precondition`` take a vector and the memory of their result; what is
    multiplied is what was preconditioned just before. Returns the solution and the number of
    iterations, each one preconditioning and one product.
    """
    size = float(np.linalg.norm(rhs))
    if size == 0:
        return np.zeros_like(rhs), 0
    keeps = rhs.size <= KEPT
    # not touched, and so not in memory, before it is needed
    basis = np.empty((longest + 1, rhs.size), rhs.dtype)
    kept = np.empty((longest if keeps else 1, rhs.size), rhs.dtype)
    np.divide(rhs, rhs.dtype.type(size), out=basis[0])
    h = np.zeros((longest + 1, longest))
    g = np.zeros(longest + 1)
    g[0] = size
    rotations: list[tuple[float, float]] = []
    n = 0
    for n in range(1, longest + 1):
        step, w = kept[n - 1 if keeps else 0], basis[n]
        precondition(basis[n - 1], step)
        operator(step, w)
        along = basis[:n] @ w
        w -= along @ basis[:n]
        left = float(np.linalg.norm(w))
        if left < _CANCELLED * float(np.linalg.norm(along)):
            again = basis[:n] @ w
            w -= again @ basis[:n]
            along += again
            left = float(np.linalg.norm(w))
        h[:n, n - 1] = along
        h[n, n - 1] = left
        w /= rhs.dtype.type(max(left, 1e-30))
        for i, (c, s) in enumerate(rotations):
            h[i, n - 1], h[i + 1, n - 1] = (
                c * h[i, n - 1] + s * h[i + 1, n - 1],
                -s * h[i, n - 1] + c * h[i + 1, n - 1],
            )
        r = float(np.hypot(h[n - 1, n - 1], h[n, n - 1]))
        c, s = h[n - 1, n - 1] / r, h[n, n - 1] / r
        rotations.append((c, s))
        h[n - 1, n - 1], h[n, n - 1] = r, 0.0
        g[n - 1], g[n] = c * g[n - 1], -s * g[n - 1]
        if abs(g[n]) <= tolerance * size:
            break
    y = np.linalg.solve(h[:n, :n], g[:n]).astype(rhs.dtype)
    if keeps:
        return y @ kept[:n], n
    precondition(y @ basis[:n], kept[0])
    return kept[0], n
