"""One linearised step of the layer: the stencil, its contact frame and its constraints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from optical_palpation.parallel import in_parallel

from .contact import ContactLinearisation, FaceFriction
from .lanes import FAST
from .problem import SAMPLE, WINDOW, LayerProblem
from .side_contact import SideTangent
from .side_flow import SideFlow
from .stencil import constrain

if TYPE_CHECKING:
    from .newton import Balance, LinearSolver

Array = NDArray[np.float64]
Vector = NDArray[np.floating]

#: Columns of elements along free sides in which a tangent is eased, and the share of the pressure
#: that it has there.
_RIM, _EASED = 4, 0.3


@dataclass
class RightHandSide:
    """What a state leaves out of balance, as the right-hand side of a linearised step.

    ``displacement`` (3, nz + 1, ny + 1, nx + 1) and ``volume`` (nz, ny, nx) are the right-hand
    sides of the free unknowns, beyond the ``prescribed`` step of both faces (face, 3, ny + 1,
    nx + 1): that of the others, and where the search for those of stiff contact springs begins.
    """

    displacement: Vector
    volume: Vector
    prescribed: Array


@dataclass
class NewtonSystem:
    """The tangent of a state in contact coordinates.

    On the sample side the vertical displacement is written u_z = d + h_x u_x + h_y u_y, so that
    contact prescribes the single unknown d. With A the tangent at fixed pressure, B = dv/du and V
    the reference volumes,

        A du + B dp           = -residual
        B^T du - C dp         = -volume_residual,   C = V / K + S

    with S that of ``flow``. ``stencil`` holds A + gamma B V^-1 B^T as the linear solver stores it,
    with the rows and columns of constrained unknowns cleared (their diagonal too), of

        (A + gamma B V^-1 B^T) du + B (1 - gamma V^-1 C) dp = rhs.displacement
        B^T du - C dp                                       = rhs.volume.

    ``vertical_rows`` [face, y, neighbour, column, x] are the rows that give the contact forces,
    ``face_columns`` {(face, plane): [y, 3 dy + dx, row, column, x]} the columns, in the planes next
    to the faces, of what these may have prescribed: d, or all three where glued. All are in the
    solver's precision: only residuals need more.
    """

    stencil: Any
    divergence: Vector
    contact: ContactLinearisation
    friction: FaceFriction
    sides: SideTangent
    free: NDArray[np.bool_]
    volume: Array
    flow: SideFlow | None
    bulk_modulus: float
    gamma: float
    vertical_rows: Vector
    face_columns: dict[tuple[int, int], Vector]

    def right_hand_side(self, problem: LayerProblem, now: Balance) -> RightHandSide:
        """Return what the step must undo: of the state of this tangent or of one near it.

        The state, of a problem that may differ slightly, has the balance ``now``.
        """
        dtype = self.divergence.dtype
        load, prescribed = self.contact.to_undo(problem, now.contact, now.state.normal_force)
        residual = now.force.copy()
        for face, k in ((WINDOW, 0), (SAMPLE, -1)):
            residual[:2, k] += now.contact.row[face] * now.force[2, k] + now.contact.traction[face]
        if now.contact is self.contact:  # else friction of a state near this one, as it is there
            residual[:2, [0, -1]] += np.moveaxis(self.friction.change, 0, 1)
            residual[:2, *self.sides.nodes] += self.sides.change
        residual[2, [0, -1]] -= load
        for (face, k), columns in self.face_columns.items():
            for c in range(-columns.shape[3], 0):
                if prescribed[face, c].any():
                    step = prescribed[face, c].astype(columns.dtype)
                    residual[:, k] += _column_product(columns[:, :, :, c], step)
        residual += self.pressure_force(
            (self.gamma / self.volume * now.volume_residual).astype(dtype)
        )
        residual[~self.free] = 0.0
        du = with_prescribed(np.zeros(self.free.shape, dtype), prescribed)
        volume = -now.volume_residual.astype(dtype) - self.volume_change(du)
        residual *= -1
        return RightHandSide(residual.astype(dtype, copy=False), volume, prescribed)

    def volume_change(self, du: Vector) -> Vector:
        """B^T du: volume change of each element, mm^3, for du in contact coordinates."""
        out = np.empty(self.volume.shape, du.dtype)
        gather_divergence(self.divergence, self.to_cartesian(du), out)
        return out

    def compression(self, dp: Vector) -> Vector:
        """C dp: volume by which pressures compress the elements, mm^3."""
        out = (self.volume / self.bulk_modulus).astype(dp.dtype) * dp
        return out if self.flow is None else out + self.flow.outflow(dp)

    def pressure_force(self, dp: Vector) -> Vector:
        """B dp: nodal forces, mN, in contact coordinates."""
        out = np.empty((3, *(n + 1 for n in dp.shape)), dp.dtype)
        scatter_divergence(self.divergence, dp, out)
        return self.combine_rows(out)

    def to_cartesian(self, du: Vector) -> Vector:
        """Displacement (x, y, z) of a displacement in contact coordinates."""
        out = du.copy()
        column = self.contact.column[SAMPLE].astype(du.dtype)
        out[2, -1] += column[0] * du[0, -1] + column[1] * du[1, -1]
        return out

    def contact_forces(self, force: Array, du: Vector, dp: Vector) -> Array:
        """Vertical contact forces after the step, to first order, (2, ny + 1, nx + 1), mN."""
        pressure = np.empty_like(du)
        penalty = (self.gamma / self.volume).astype(du.dtype) * self.volume_change(du)
        scatter_divergence(self.divergence, dp - penalty, pressure)
        out = force[2, [0, -1]] + pressure[2, [0, -1]]
        out[WINDOW] += _vertical_product(self.vertical_rows[WINDOW], du[:, :2], 1)
        out[SAMPLE] += _vertical_product(self.vertical_rows[SAMPLE], du[:, -2:], 0)
        out[SAMPLE] *= -1
        return out

    def combine_rows(self, force: Vector) -> Vector:
        """Equations in contact coordinates of a Cartesian nodal force (in place)."""
        for face, k in ((WINDOW, 0), (SAMPLE, -1)):
            force[:2, k] += self.friction.row[face].astype(force.dtype) * force[2, k]
        return force


def with_prescribed(du: Vector, prescribed: Array) -> Vector:
    """Put the prescribed step of both faces into du (in place)."""
    du[:, [0, -1]] += np.moveaxis(prescribed, 0, 1).astype(du.dtype)
    return du


def assemble(
    problem: LayerProblem,
    now: Balance,
    solver: LinearSolver,
    resistance: float = 0.0,
    softness: float = 0.0,
    eased: bool = False,
) -> NewtonSystem:
    """Assemble the tangent of the state that has the balance ``now``, for a linear solver.

    ``resistance``, kPa / mm^2, is that of the body to being displaced by the step, ``softness``,
    1 / kPa, a compressibility beside that of the body; where ``eased``, most of the stiffness that
    the pressure gives to the elements at free sides is left out. All this is in the tangent alone.
    It passes through memory plane by plane of nodes, from which the solver stores what it needs.
    """
    grid, contact = problem.grid, now.contact
    nz1, ny1, nx1 = grid.node_shape
    faces = ((WINDOW, 0), (SAMPLE, nz1 - 1))
    free = _free(problem, contact)
    bulk_modulus = 1.0 / (1.0 / problem.bulk_modulus + softness)
    # the penalty of a solver that condenses pressures is the bulk modulus
    gamma = bulk_modulus if solver.gamma == problem.bulk_modulus else solver.gamma
    divergence = np.empty((*grid.shape[:2], 24, grid.shape[2]), solver.dtype)
    system = NewtonSystem(
        stencil=solver.stencil,
        divergence=divergence,
        contact=contact,
        friction=now.friction,
        sides=now.sides.tangent(now.side_friction),
        free=free,
        volume=now.volume_ref,
        flow=None if now.flow is None else now.flow.astype(solver.dtype),
        bulk_modulus=bulk_modulus,
        gamma=gamma,
        vertical_rows=np.empty((2, ny1, 27, 3, nx1), solver.dtype),
        face_columns={},
    )
    # A trace of lateral stiffness in the tangent alone takes the rigid motions out of a layer
    # that nothing holds sideways; it does not enter the residual.
    hold = 1e-6 * problem.shear_modulus * grid.spacing[0]
    sides = [] if problem.border is None else problem.border.side_stiffness(now.state.u)
    p = _eased(problem, now.state.p) if eased else now.state.p
    planes = problem.body.tangent_planes(now.state.u, p, gamma, divergence)
    for k, plane in enumerate(planes):
        diagonal = plane[:, 13, :, :nx1]
        if resistance > 0:
            problem.body.resistance.add_to(plane, k, resistance)
        if problem.border is not None:
            problem.border.add_stiffness(plane, k, sides)
        system.sides.add_stiffness(plane, k)
        for face_folds in now.folds:
            face_folds.add_stiffness(plane, k)
        if k == 0 or k >= nz1 - 2:  # the face of the sample has neighbours in the plane below it
            _to_contact_frame(plane, k, nz1, system.friction.row, contact.column, contact.turning)
        for face, there in faces:
            if k == there:
                block = system.friction.block[face]
                for entry, stiffness in (
                    (0, block[0]),
                    (1, block[1]),
                    (3, block[1]),
                    (4, block[2]),
                ):
                    diagonal[:, entry] += stiffness
                diagonal[:, [0, 4]] += hold
                # the vertical equations of both faces give the contact forces after the step
                system.vertical_rows[face] = plane[:, :, 6:, :nx1]
                diagonal[:, 8] += contact.spring[face]
        for face, there in faces:
            dz = there - k + 1
            if 0 <= dz <= 2:
                columns = plane[:, 9 * dz : 9 * dz + 9, :, :nx1].reshape(ny1, 9, 3, 3, nx1)
                first = 0 if problem.glued[face] else 2
                system.face_columns[face, k] = columns[:, :, :, first:].copy()
        constrain(plane, free, k)
        solver.store(k, plane)
    solver.prepare(system)
    return system


def _eased(problem: LayerProblem, p: Array) -> Array:
    """The pressure of an eased tangent."""
    _, ny, nx = p.shape
    y0, y1, x0, x1 = (_RIM if own else 0 for own in problem.own_sides)
    inside = np.zeros((ny, nx), bool)
    inside[y0 : ny - y1, x0 : nx - x1] = True
    return np.where(inside, p, _EASED * p)


def _free(problem: LayerProblem, contact: ContactLinearisation) -> NDArray[np.bool_]:
    """Degrees of freedom that are not prescribed, (3, nz + 1, ny + 1, nx + 1)."""
    free = np.ones((3, *problem.grid.node_shape), bool)
    free[2, [0, -1]] = ~contact.rigid
    for face, k in ((WINDOW, 0), (SAMPLE, -1)):
        if problem.glued[face]:
            free[:, k] = False
    problem.hold_sides(free, False)
    return free


@nb.njit(cache=True)
def _to_contact_frame(plane, k, nz1, row, column, turning):
    """Transform rows and columns of a plane at the faces, add the turning stiffness (in place)."""
    in_parallel(_frame_rows, len(plane), (plane, k, nz1, row, column, turning))


@nb.njit(fastmath=FAST)
def _frame_rows(plane, k, nz1, row, column, turning, begin, end):
    _, _, ny1, nx1 = row.shape
    top = nz1 - 1
    real = plane.dtype.type
    for j in range(begin, end):
        for face, there in ((WINDOW, 0), (SAMPLE, top)):
            if k == there:
                for m in range(27):
                    for c in range(2):
                        factor = row[face, c, j]
                        for d in range(3):
                            target, source = plane[j, m, 3 * c + d], plane[j, m, 6 + d]
                            for i in range(nx1):
                                target[i] += real(factor[i]) * source[i]
        if k == top:
            for m in range(9):
                for c in range(2):
                    for d in range(3):
                        target = plane[j, 9 + m, 3 * c + d]
                        for i in range(nx1):
                            target[i] += turning[j, i, m, c, d]
        dz = top - k + 1
        if dz <= 2:
            for m in range(9):
                jj, di = j + m // 3 - 1, m % 3 - 1
                if jj < 0 or jj >= ny1:
                    continue
                for c in range(2):
                    factor = column[SAMPLE, c, jj]
                    for d in range(3):
                        line = plane[j, 9 * dz + m]
                        target, source = line[3 * d + c], line[3 * d + 2]
                        for i in range(max(0, -di), min(nx1, nx1 - di)):
                            target[i] += real(factor[i + di]) * source[i]


@nb.njit(cache=True)
def gather_divergence(divergence, u, out):
    """Volume change of each element from nodal displacement (Cartesian)."""
    nz, ny = out.shape[:2]
    in_parallel(_gather_rows, nz * ny, (divergence, u, out))


@nb.njit
def _gather_rows(divergence, u, out, begin, end):
    _, ny, _, nx = divergence.shape
    for row in range(begin, end):
        k, j = row // ny, row % ny
        line = out[k, j]
        line[:] = 0
        for a in range(8):
            kk, jj, di = k + (a >> 2), j + ((a >> 1) & 1), a & 1
            for c in range(3):
                for i in range(nx):
                    line[i] += divergence[k, j, 3 * a + c, i] * u[c, kk, jj, i + di]


@nb.njit(cache=True)
def scatter_divergence(divergence, p, out):
    """Nodal forces (Cartesian) of element pressures."""
    nz1, ny1 = out.shape[1:3]
    in_parallel(_scatter_rows, nz1 * ny1, (divergence, p, out))


@nb.njit
def _scatter_rows(divergence, p, out, begin, end):
    nz, ny, _, nx = divergence.shape
    for row in range(begin, end):
        kk, jj = row // (ny + 1), row % (ny + 1)
        for c in range(3):
            out[c, kk, jj] = 0
        for a in range(8):
            k, j, di = kk - (a >> 2), jj - ((a >> 1) & 1), a & 1
            if k < 0 or k >= nz or j < 0 or j >= ny:
                continue
            for c in range(3):
                for i in range(nx):
                    out[c, kk, jj, i + di] += divergence[k, j, 3 * a + c, i] * p[k, j, i]


@nb.njit(cache=True)
def _vertical_product(rows, du, first):
    """Product of the vertical rows of one face with du of the two node planes next to it."""
    _, _, ny1, nx1 = du.shape
    out = np.zeros((ny1, nx1), du.dtype)
    for j in range(ny1):
        for m in range(18):
            plane, jj, di = m // 9, j + m // 3 % 3 - 1, m % 3 - 1
            if jj < 0 or jj >= ny1:
                continue
            for c in range(3):
                row, near = rows[j, m + 9 * first, c], du[c, plane, jj]
                for i in range(max(0, -di), min(nx1, nx1 - di)):
                    out[j, i] += row[i] * near[i + di]
    return out


@nb.njit(cache=True)
def _column_product(columns, step):
    """Forces (3, ny1, nx1) on a plane by one component of a face's step, [y, 3 dy + dx, row, x]."""
    ny1, _, _, nx1 = columns.shape
    out = np.zeros((3, ny1, nx1), columns.dtype)
    for j in range(ny1):
        for m in range(9):
            jj, di = j + m // 3 - 1, m % 3 - 1
            if jj < 0 or jj >= ny1:
                continue
            for c in range(3):
                row = columns[j, m, c]
                for i in range(max(0, -di), min(nx1, nx1 - di)):
                    out[c, j, i] += row[i] * step[jj, i + di]
    return out
