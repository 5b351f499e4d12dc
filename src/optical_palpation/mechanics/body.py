"""A deformable body on a structured grid."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from optical_palpation.material import Law

from .elements import GRADIENTS, element_stress, internal_force, tangent_planes
from .grid import LayerGrid
from .resistance import Resistance
from .side_flow import SideFlow, side_flow

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Body:
    """A hyperelastic body between two surfaces, nearly incompressible, Q1-P0 elements.

    Attributes
    ----------
    grid
        Lateral nodes, depth fractions and thickness of the body.
    law
        The law of a stiffness factor of 1.
    stiffness
        Factor by which an element is stiffer, its bulk modulus too: one number, or (nz, ny, nx).
    top
        z of the face nearest the window, mm: one number, or (ny + 1, nx + 1).
    curved_sides
        Whether the elements' upright sides may bend into the parabola of a body that sticks
        (``side_flow``).
    """

    grid: LayerGrid
    law: Law
    stiffness: Array | float = 1.0
    top: Array | float = 0.0
    curved_sides: bool = False

    @cached_property
    def nodes(self) -> Array:
        """Reference node positions, (3, nz + 1, ny + 1, nx + 1), mm."""
        nodes = self.grid.nodes
        if np.any(self.top):
            nodes = nodes.copy()
            nodes[2] += self.top
        return nodes

    @cached_property
    def factor(self) -> Array:
        """Stiffness factors as the kernels take them: (nz, ny, nx), or (1, 1, 1) for all equal.

        Raises
        ------
        ValueError
            If ``stiffness`` has another shape, or a factor that is not positive.
        """
        factor = np.array(self.stiffness, dtype=float, order="C")
        if factor.ndim == 0:
            factor = factor.reshape(1, 1, 1)
        elif factor.shape != self.grid.shape:
            raise ValueError(f"stiffness has the shape {factor.shape}, the grid {self.grid.shape}")
        if not (np.isfinite(factor) & (factor > 0)).all():
            raise ValueError("a stiffness factor is not positive")
        return factor

    @cached_property
    def median_shear_modulus(self) -> float:
        """Median of the shear moduli of the elements, kPa."""
        return self.law.shear_modulus * float(np.median(self.factor))

    @cached_property
    def resistance(self) -> Resistance:
        """What resists its displacement against drag and in damped steps."""
        return Resistance(self.grid)

    @cached_property
    def _reference_volume(self) -> Array:
        """Memory for the reference volumes, which are the same at all displacements."""
        return np.empty(self.grid.shape)

    @property
    def bulk_modulus(self) -> Array:
        """Bulk modulus of each element, (nz, ny, nx) or (1, 1, 1), kPa."""
        return self.factor * self.law.bulk_modulus

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.grid.node_shape))

    def forces(self, u: Array, p: Array) -> ElementForces:
        """Internal forces and volumes at displacement ``u`` (mm) and pressure ``p`` (kPa)."""
        force = np.empty(u.shape)
        volume, reference = np.empty(self.grid.shape), self._reference_volume
        jacobian = np.empty(self.grid.shape[:2])
        internal_force(
            self.nodes,
            u,
            p,
            self.factor,
            self.law.coefficients,
            GRADIENTS,
            force,
            volume,
            reference,
            jacobian,
        )
        residual = volume - reference * (1 + p / self.bulk_modulus)
        flow = None
        if self.curved_sides:
            flow = side_flow(self.nodes, u, self.factor, self.law.shear_modulus)
            residual -= flow.outflow(p)
        return ElementForces(force, volume, reference, residual, float(jacobian.min()), flow)

    def tangent_planes(
        self, u: Array, p: Array, gamma: float, divergence: NDArray[np.floating]
    ) -> Iterator[NDArray[np.floating]]:
        """Tangent stiffness, plane by plane of nodes; see ``elements.tangent_planes``."""
        return tangent_planes(
            self.nodes, u, p, self.factor, self.law.coefficients, gamma, divergence
        )

    def stress(self, u: Array, p: Array) -> Array:
        """Volume-averaged Cauchy stress of the elements, (6, nz, ny, nx), kPa.

        Components xx, yy, zz, yz, xz, xy.
        """
        stress = np.empty((6, *self.grid.shape))
        element_stress(self.nodes, u, p, self.factor, self.law.coefficients, GRADIENTS, stress)
        return stress


@dataclass(frozen=True, eq=False)
class ElementForces:
    """Internal forces and volumes of a body.

    Attributes
    ----------
    force
        Internal nodal forces, (3, nz + 1, ny + 1, nx + 1), mN.
    volume, reference_volume
        Deformed and reference volume of each element, (nz, ny, nx), mm^3.
    volume_residual
        What violates J - 1 = p / (s K): v - V (1 + p / (s K)) - S p, mm^3, with S p the outflow
        through curved sides.
    min_jacobian
        Smallest J at any Gauss point.
    flow
        S, where sides are taken as curved.
    """

    force: Array
    volume: Array
    reference_volume: Array
    volume_residual: Array
    min_jacobian: float
    flow: SideFlow | None = None
