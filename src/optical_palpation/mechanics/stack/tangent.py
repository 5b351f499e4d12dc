"""The tangent of a stack in equilibrium as one sparse matrix, factorised once for many loads.

Newton's method does not need it (``linear``). Derivatives of a solution by hundreds of parameters
do: each of them is one more right-hand side.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..body import Body
from ..direct import sparse_matrix
from ..elements import GRADIENTS, internal_force
from ..factors import Dissection, Factors
from ..side_contact import SideTangent
from .contact import ContactTerms, sparse_rows
from .newton import balance, linearised_friction
from .problem import LAYER, PLATE, SAMPLE, Stack, State

Array = NDArray[np.float64]

#: Stiffness of closed contact at most, in scales c of its law: it moves by 1e-8 of what it carries.
_CLOSED = 1e8
#: Stiffness, in shear moduli times an element's width, that holds what nothing else holds.
_HOLD = 1e-8
#: Change of shape from which its derivative is computed, as a share of the thickness.
_SHAPE_STEP = 1e-6


class Tangent:
    """The derivative of the equilibrium of a stack, with pressures and contact forces condensed.

    Friction is taken from the slip since the last accepted load.
    """

    def __init__(self, stack: Stack, state: State) -> None:
        self.stack, self.state = stack, state
        now = balance(stack, state)
        # what is not quite in balance is none of the derivative
        frictions, side_frictions = linearised_friction(
            stack, now.terms, now.sides, np.zeros_like(now.residual)
        )
        sides = [
            side.tangent(friction) for side, friction in zip(now.sides, side_frictions, strict=True)
        ]
        blocks = [
            _stiffness(body, u, p)
            for body, u, p in zip(stack.bodies, stack.split(state.u), state.p, strict=True)
        ]
        self._sides = _sides(stack, sides)
        matrix = sp.csr_matrix(sp.block_diag(blocks))
        for pressing in self._sides:
            matrix = matrix + pressing
        numbers = np.arange(stack.n_nodes)
        #: Force of each contact's slaves by displacement, (slaves, 3 n_nodes), mN / mm.
        self.contact_forces: list[sp.csr_matrix] = []
        #: Force of each contact by penetration, (slaves), mN / mm, and what it puts on the nodes.
        self.springs: list[Array] = []
        self.rows: list[sp.csr_matrix] = []
        for n, (term, friction) in enumerate(zip(now.terms, frictions, strict=True)):
            spring = _springs(term, stack.scales[n])
            rows = _matrix(term.rows(friction.sliding), term, stack.n_nodes)
            forces = sp.csr_matrix(sp.diags_array(spring) @ _penetration(term, stack.n_nodes))
            self.springs.append(spring)
            self.rows.append(rows)
            self.contact_forces.append(forces)
            matrix = matrix + rows.T @ forces
            matrix = matrix + term.tangent(friction, numbers, stack.n_nodes).matrix()
        hold = _HOLD * stack.shear_modulus * stack.bodies[LAYER].grid.spacing[2]
        matrix = matrix + hold * sp.eye_array(matrix.shape[0])
        lateral = [body.nodes[:2].reshape(2, -1).T for body in stack.bodies]
        self.matrix = sp.csr_matrix(matrix)
        unknowns = np.arange(3 * stack.n_nodes).reshape(-1, 3)
        dissection = Dissection(_graph(self.matrix), np.concatenate(lateral))
        self._factors = Factors(self.matrix, dissection, unknowns)

    def by_travel(self) -> Array:
        """Derivative of the nodal forces out of balance by the travel of the plate, (3 n_nodes)."""
        up = np.zeros((self.stack.n_nodes, 3))
        up[self.stack.bodies[LAYER].n_nodes :, 2] = 1.0
        of_sides = self._sides[SAMPLE] @ up.ravel()
        return np.asarray(self.rows[PLATE].T @ self.springs[PLATE] + of_sides)

    def displacement(self, force: Array) -> Array:
        """Displacements (3 n_nodes, m), mm, that balance nodal forces (3 n_nodes, m), mN."""
        return self._factors.solve(force)


def _graph(matrix: sp.csr_matrix) -> sp.csr_matrix:
    """Which nodes have entries with which, of a matrix node by node."""
    rows, columns = matrix.nonzero()
    nodes = matrix.shape[0] // 3
    ones = np.ones(rows.size)
    graph = sp.csr_matrix((ones, (rows // 3, columns // 3)), shape=(nodes, nodes))
    return sp.csr_matrix(graph + graph.T)


def _stiffness(body: Body, u: Array, p: Array) -> sp.csr_matrix:
    """Tangent of one body with its pressure condensed, node by node."""
    nz, ny, nx = body.grid.shape
    divergence = np.empty((nz, ny, 24, nx))
    planes = body.tangent_planes(u, p, body.law.bulk_modulus, divergence)
    stencil = np.stack([plane[..., : nx + 1].copy() for plane in planes])
    matrix = sparse_matrix(stencil, np.ones(u.shape, bool))
    by_node = np.arange(u.size).reshape(3, -1).T.ravel()
    return sp.csr_matrix(matrix[by_node][:, by_node])


def _sides(stack: Stack, sides: list[SideTangent]) -> list[sp.csr_matrix]:
    """What presses the sides of each body, by displacements."""
    first, size, out = 0, 3 * stack.n_nodes, []
    for body, side in zip(stack.bodies, sides, strict=True):
        numbers = first + np.arange(body.n_nodes).reshape(body.grid.node_shape)
        corners, nodes = numbers[*side.facets], numbers[*side.nodes]
        parts = [
            (values, 3 * corners[:, None] + c, 3 * corners[None] + d)
            for (c, d), values in zip(
                np.ndindex(3, 3), side.blocks.reshape(9, 4, 4, -1), strict=True
            )
        ]
        parts += [(side.hold[c, d], 3 * nodes + c, 3 * nodes + d) for c, d in np.ndindex(2, 2)]
        entries = [[e.ravel() for e in np.broadcast_arrays(*part)] for part in parts]
        values, rows, columns = (np.concatenate(each) for each in zip(*entries, strict=True))
        out.append(sp.csr_matrix((values, (rows, columns)), shape=(size, size)))
        first += body.n_nodes
    return out


def _matrix(values: Array, term: ContactTerms, n_nodes: int) -> sp.csr_matrix:
    """Sparse (slaves, 3 n_nodes) of values (slaves, q, 3) that belong to nodes."""
    nodes = term.projection.nodes
    columns = 3 * nodes[:, :, None] + np.arange(3)
    n = len(nodes)
    return sparse_rows(columns.reshape(n, -1), values.reshape(n, -1), 3 * n_nodes)


def _springs(term: ContactTerms, scale: Array) -> Array:
    """Stiffness of contact, that of a rigid one limited."""
    return np.minimum(np.where(term.rigid, np.inf, term.spring), _CLOSED * scale)


def _penetration(term: ContactTerms, n_nodes: int) -> sp.csr_matrix:
    """Penetration (slaves) by displacements."""
    projection = term.projection
    by_nodes = -projection.weights[:, :, None] * projection.direction[:, None, :]
    return _matrix(by_nodes, term, n_nodes)


def shape_forces(body: Body, u: Array, p: Array) -> tuple[Array, Array]:
    """Derivative of a body's nodal forces by its unloaded shape, its deformed one being as it is.

    Parameters
    ----------
    u, p
        As for :func:`stiffness_forces`.

    Returns
    -------
    tuple
        By the height of the upper face at each column of nodes, (ny + 1, nx + 1, 3, nz + 1, 3, 3),
        mN / mm, the forces on this and the eight columns of nodes around it; and by the distance of
        the lower face from the window, taken away everywhere, (3, nz + 1, ny + 1, nx + 1), mN / mm.
    """
    grid, top = body.grid, np.broadcast_to(body.top, body.grid.thickness.shape)
    ny1, nx1 = top.shape
    step = _SHAPE_STEP * grid.typical_thickness
    start = body.forces(u, p)
    ratio = start.volume / start.reference_volume

    def forces(higher: Array, shorter: float) -> Array:
        """Forces of the body of another shape, in the same place and as nearly incompressible."""
        thickness = grid.thickness + higher - shorter
        other = replace(body, grid=replace(grid, thickness=thickness), top=top - higher)
        moved = u - (other.nodes - body.nodes)
        volume = other.forces(moved, p)
        change = volume.volume / volume.reference_volume - ratio
        return other.forces(moved, p + body.bulk_modulus * change).force

    def derivative(higher: Array, shorter: float = 0.0) -> Array:
        up, down = (forces(sign * step * higher, sign * step * shorter) for sign in (1.0, -1.0))
        return np.asarray((up - down) / (2 * step), dtype=float)

    out = np.zeros((ny1, nx1, 3, grid.depth.size, 3, 3))
    for first_y in range(3):
        for first_x in range(3):
            these = (slice(first_y, None, 3), slice(first_x, None, 3))
            higher = np.zeros(top.shape)
            higher[these] = 1.0
            change = np.pad(derivative(higher), ((0, 0), (0, 0), (1, 1), (1, 1)))
            for b in range(3):
                for a in range(3):
                    here = change[:, :, first_y + b :: 3, first_x + a :: 3]
                    own = out[these][..., b, a]
                    own[:] = here[:, :, : own.shape[0], : own.shape[1]].transpose(2, 3, 0, 1)
    return out, derivative(np.zeros(top.shape), 1.0)


def stiffness_forces(body: Body, u: Array, p: Array) -> Array:
    """Derivative of a body's nodal forces by the logarithm of the stiffness of its columns.

    Parameters
    ----------
    u, p
        Displacement (3, nz + 1, ny + 1, nx + 1), mm, and pressures (nz, ny, nx), kPa, in
        equilibrium.

    Returns
    -------
    numpy.ndarray
        Forces of each column of elements on its nodes, (ny, nx, 3, nz + 1, 2, 2), mN.
    """
    nz, ny, nx = body.grid.shape
    out = np.zeros((ny, nx, 3, nz + 1, 2, 2))
    whole = np.broadcast_to(body.factor, body.grid.shape)
    for odd_y in range(2):
        for odd_x in range(2):
            factor, own = np.full(body.grid.shape, 1e-300), np.zeros(body.grid.shape)
            these = (slice(None), slice(odd_y, None, 2), slice(odd_x, None, 2))
            factor[these], own[these] = whole[these], p[these]
            force = np.empty(u.shape)
            scratch = np.empty(body.grid.shape), np.empty(body.grid.shape)
            internal_force(
                body.nodes,
                u,
                own,
                factor,
                body.law.coefficients,
                GRADIENTS,
                force,
                *scratch,
                np.empty(body.grid.shape[:2]),
            )
            for b in range(2):
                for a in range(2):
                    corner = force[:, :, odd_y + b :: 2, odd_x + a :: 2]
                    count = out[odd_y::2, odd_x::2].shape[:2]
                    corner = corner[:, :, : count[0], : count[1]]
                    out[odd_y::2, odd_x::2, :, :, b, a] = corner.transpose(2, 3, 0, 1)
    return out
