"""One linearised step of the layer: the stencil, its contact frame and its constraints."""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from .contact import ContactLinearisation
from .elements import GRADIENTS, GRADIENTS32, tangent_stencil
from .problem import SAMPLE, WINDOW, LayerProblem, LayerState
from .stencil import constrain, halo_zeros, interior, multiply

Array = NDArray[np.float64]


@dataclass
class NewtonSystem:
    """The linear system of a Newton step in contact coordinates.

    On the sample side the vertical displacement is written u_z = d + h_x u_x + h_y u_y, so that
    contact prescribes the single unknown d. With A the tangent at fixed pressure, B = dv/du and V
    the reference volumes,

        A du + B dp           = -residual
        B^T du - (V / K) dp   = -volume_residual.

    ``stencil`` holds A + gamma B V^-1 B^T with the rows and columns of constrained unknowns
    cleared (their diagonal too); ``rhs`` and ``volume_rhs`` the right-hand sides of

        (A + gamma B V^-1 B^T) du + (1 - gamma / K) B dp = rhs
        B^T du - (V / K) dp                              = volume_rhs

    for the free unknowns, the ``prescribed`` step of the others taken into account.
    """

    stencil: NDArray[np.floating]
    divergence: NDArray[np.floating]
    contact: ContactLinearisation
    free: NDArray[np.bool_]
    prescribed: Array
    rhs: Array
    volume_rhs: Array
    volume: Array
    bulk_modulus: float
    gamma: float
    vertical_rows: NDArray[np.floating]

    def volume_change(self, du: Array) -> Array:
        """B^T du: volume change of each element, mm^3, for du in contact coordinates."""
        out = np.empty(self.volume.shape, du.dtype)
        gather_divergence(self.divergence, self.to_cartesian(du), out)
        return out

    def pressure_force(self, dp: Array) -> Array:
        """B dp: nodal forces, mN, in contact coordinates."""
        out = np.empty((3, *(n + 1 for n in dp.shape)), dp.dtype)
        scatter_divergence(self.divergence, dp, out)
        return self.combine_rows(out)

    def to_cartesian(self, du: Array) -> Array:
        """Displacement (x, y, z) of a displacement in contact coordinates."""
        out = du.copy()
        column = self.contact.column[SAMPLE].astype(du.dtype)
        out[2, -1] += column[0] * du[0, -1] + column[1] * du[1, -1]
        return out

    def contact_forces(self, force: Array, du: Array, dp: Array) -> Array:
        """Vertical contact forces after the step, to first order, (2, ny + 1, nx + 1), mN."""
        pressure = np.empty(du.shape, du.dtype)
        scatter_divergence(
            self.divergence, dp - self.gamma / self.volume * self.volume_change(du), pressure
        )
        out = force[2, [0, -1]] + pressure[2, [0, -1]]
        out[WINDOW] += _plane_product(self.vertical_rows[WINDOW], du[:, :2], 1)
        out[SAMPLE] += _plane_product(self.vertical_rows[SAMPLE], du[:, -2:], 0)
        out[SAMPLE] *= -1
        return out

    def combine_rows(self, force: Array) -> Array:
        """Equations in contact coordinates of a Cartesian nodal force (in place)."""
        for face, k in ((WINDOW, 0), (SAMPLE, -1)):
            force[:2, k] += self.contact.row[face].astype(force.dtype) * force[2, k]
        return force


def assemble(
    problem: LayerProblem,
    state: LayerState,
    contact: ContactLinearisation,
    force: Array,
    volume: Array,
    volume_ref: Array,
    gamma: float,
    dtype: type[np.floating],
    storage: NDArray[np.floating] | None = None,
    damping: float = 0.0,
) -> NewtonSystem:
    """Assemble the Newton system at ``state``.

    ``storage`` is reused for the stencil if given. ``damping``, kPa / mm^2, is a resistance of each
    volume to being displaced by the step, in the tangent alone.
    """
    grid = problem.grid
    nz1, ny1, nx1 = grid.node_shape
    stencil = np.empty((nz1, ny1, 27, 9, nx1), dtype) if storage is None else storage
    divergence = np.empty((*grid.shape[:2], 24, grid.shape[2]), dtype)
    tangent_stencil(
        grid.nodes,
        state.u,
        state.p,
        problem.c10,
        problem.c01,
        gamma,
        GRADIENTS if dtype == np.float64 else GRADIENTS32,
        stencil,
        divergence,
    )
    if damping > 0:
        for c in (0, 4, 8):
            stencil[:, :, 13, c] += damping * grid.node_volumes
    _to_contact_frame(stencil, contact.row, contact.column, contact.turning)
    # A trace of lateral stiffness in the tangent alone takes the rigid motions out of a layer
    # that nothing holds sideways; it does not enter the residual.
    hold = 1e-6 * problem.shear_modulus * grid.spacing()[0]
    for face, k in ((WINDOW, 0), (SAMPLE, -1)):
        block = contact.block[face]
        stencil[k, :, 13, 0] += block[0] + hold
        stencil[k, :, 13, 1] += block[1]
        stencil[k, :, 13, 3] += block[1]
        stencil[k, :, 13, 4] += block[2] + hold
    free, prescribed = constraints(problem, contact)
    # the vertical equations of both faces give the contact forces after the step
    vertical_rows = np.stack([stencil[0, :, :, 6:], stencil[-1, :, :, 6:]])
    for face, k in ((WINDOW, 0), (SAMPLE, -1)):
        stencil[k, :, 13, 8] += contact.spring[face]
    sides = grid.side_nodes
    if problem.edges == "free":
        for c, d in np.ndindex(3, 3):
            stencil[*sides[:2], 13, 3 * c + d, sides[2]] += contact.sides.stiffness[c, d]
    system = NewtonSystem(
        stencil=stencil,
        divergence=divergence,
        contact=contact,
        free=free,
        prescribed=prescribed,
        rhs=np.empty_like(force),
        volume_rhs=np.empty_like(volume),
        volume=volume_ref,
        bulk_modulus=problem.bulk_modulus,
        gamma=gamma,
        vertical_rows=vertical_rows,
    )
    volume_residual = volume - volume_ref * (1 + state.p / problem.bulk_modulus)
    residual = system.combine_rows(force.copy())
    if problem.edges == "free":
        residual[:, *sides] += contact.sides.force
    residual[2, [0, -1]] -= contact.load
    residual += system.pressure_force(gamma / volume_ref * volume_residual)
    if prescribed.any():
        x = halo_zeros(grid.node_shape, dtype)
        y = halo_zeros(grid.node_shape, dtype)
        interior(x)[:] = prescribed
        multiply(stencil, x, y)
        residual += interior(y)
    system.rhs = np.where(free, -residual, 0.0)
    system.volume_rhs = -volume_residual - system.volume_change(prescribed)
    constrain(stencil, free)
    return system


def constraints(
    problem: LayerProblem, contact: ContactLinearisation
) -> tuple[NDArray[np.bool_], Array]:
    """Free degrees of freedom, and the prescribed step of the others (contact coordinates)."""
    shape = (3, *problem.grid.node_shape)
    free = np.ones(shape, bool)
    prescribed = np.zeros(shape)
    free[2, [0, -1]] = ~contact.rigid
    prescribed[2, [0, -1]] = contact.step
    if problem.edges == "roller":
        free[0, :, :, [0, -1]] = False
        free[1, :, [0, -1], :] = False
    return free, prescribed


@nb.njit(cache=True)
def _to_contact_frame(stencil, row, column, turning):
    """Transform the rows and columns of both surfaces and add the turning stiffness (in place)."""
    nz1, ny1, _, _, nx1 = stencil.shape
    top = nz1 - 1
    for face in range(2):
        k = face * top
        for j in range(ny1):
            for m in range(27):
                for c in range(2):
                    for d in range(3):
                        for i in range(nx1):
                            stencil[k, j, m, 3 * c + d, i] += (
                                row[face, c, j, i] * stencil[k, j, m, 6 + d, i]
                            )
    for j in range(ny1):
        for m in range(9):
            for c in range(2):
                for d in range(3):
                    for i in range(nx1):
                        stencil[top, j, 9 + m, 3 * c + d, i] += turning[j, i, m, c, d]
    for k in (top - 1, top):
        dz = top - k + 1
        for j in range(ny1):
            for m in range(9 * dz, 9 * dz + 9):
                jj = j + (m // 3) % 3 - 1
                if jj < 0 or jj >= ny1:
                    continue
                for i in range(nx1):
                    ii = i + m % 3 - 1
                    if ii < 0 or ii >= nx1:
                        continue
                    for c in range(3):
                        s = stencil[k, j, m, 3 * c + 2, i]
                        stencil[k, j, m, 3 * c, i] += s * column[1, 0, jj, ii]
                        stencil[k, j, m, 3 * c + 1, i] += s * column[1, 1, jj, ii]


@nb.njit(parallel=True, cache=True)
def gather_divergence(divergence, u, out):
    """Volume change of each element from nodal displacement (Cartesian)."""
    nz, ny, _, nx = divergence.shape
    for row in nb.prange(nz * ny):
        k, j = row // ny, row % ny
        line = out[k, j]
        line[:] = 0
        for a in range(8):
            kk, jj, di = k + (a >> 2), j + ((a >> 1) & 1), a & 1
            for c in range(3):
                for i in range(nx):
                    line[i] += divergence[k, j, 3 * a + c, i] * u[c, kk, jj, i + di]


@nb.njit(parallel=True, cache=True)
def scatter_divergence(divergence, p, out):
    """Nodal forces (Cartesian) of element pressures."""
    nz, ny, _, nx = divergence.shape
    for row in nb.prange((nz + 1) * (ny + 1)):
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


def _plane_product(rows: NDArray[np.floating], du: Array, first: int) -> Array:
    """Product of the vertical rows of one face with du of the two node planes next to it."""
    _, ny1, nx1 = du.shape[1:]
    padded = np.pad(du, ((0, 0), (0, 0), (1, 1), (1, 1)))
    out = np.zeros((ny1, nx1))
    for plane in range(2):
        for dy in range(3):
            for dx in range(3):
                m = 9 * (plane + first) + 3 * dy + dx
                for c in range(3):
                    out += rows[:, m, c] * padded[c, plane, dy : dy + ny1, dx : dx + nx1]
    return out
