"""The boundary-value problem of the layer, and a state of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from optical_palpation.material import Law

from .body import Body
from .border import Border, Surroundings
from .grid import LayerGrid, contact_nodes
from .imprint import Imprint
from .side_contact import Facets

Array = NDArray[np.float64]
WINDOW, SAMPLE = 0, 1
#: One value for each side: the lowest and highest in y, then in x.
Sides = tuple[bool, bool, bool, bool]


@dataclass(frozen=True, eq=False)
class LayerProblem:
    """A compliant layer pressed between the window and an imprint.

    Attributes
    ----------
    grid
        The elements of the unloaded layer.
    imprint
        The surface on the sample side; the window is the plane z = 0.
    law
        The law of the layer.
    friction
        Coulomb coefficients at the window and at the sample side; that of a glued face is not used.
    edges
        ``free`` sides carry no stress; ``roller`` sides have no normal displacement.
    mirrors
        Which sides are planes of symmetry instead: the lowest and highest in y, then in x. Two
        opposite ones make plane strain.
    slip_length
        Slip, mm, over which friction builds up (the smoothing of Coulomb's law).
    curved_sides
        Whether elements know of the parabola through the depth of a layer that sticks
        (``side_flow``): for a layer that sticks to both faces worth twice as many elements through
        the depth; one that slides is computed for a quarter longer and no better.
    glued
        Whether window and sample side are glued to the layer: no slip and no opening, so that they
        can pull. The sample side goes with those points of the imprint that it lay on at first.
    surroundings
        The larger layer that this one is a part of; it holds the sides that were cut.
    side_reach
        The gap at which free sides are caught, as a fraction of the usual one.
    held
        Which sides stay where they are, the layer going on beyond them (``elimination``).
    """

    grid: LayerGrid
    imprint: Imprint
    law: Law
    friction: tuple[float, float]
    edges: Literal["free", "roller"] = "free"
    mirrors: Sides = (False, False, False, False)
    slip_length: float = 1e-3
    curved_sides: bool = False
    glued: tuple[bool, bool] = (False, False)
    surroundings: Surroundings | None = None
    side_reach: float = 1.0
    held: Sides = (False, False, False, False)

    @property
    def shear_modulus(self) -> float:
        """Initial shear modulus mu, kPa."""
        return self.law.shear_modulus

    @property
    def bulk_modulus(self) -> float:
        """Bulk modulus K, kPa."""
        return self.law.bulk_modulus

    @property
    def compression(self) -> float:
        """How far the layer is compressed at most, or pulled if it is glued, of its thickness."""
        pulled, pressed = self.imprint.strains
        return max(pressed, -pulled if self.glued[SAMPLE] else 0.0)

    @cached_property
    def indifferent(self) -> tuple[bool, bool]:
        """Whether nothing tells where the layer is along x and y: no friction, relief or side."""
        if any(self.friction) or any(self.glued) or any(self.held) or self.edges == "roller":
            return False, False
        if self.surroundings is not None:
            return False, False
        along_x, along_y = self.imprint.level
        return along_x and not any(self.mirrors[2:]), along_y and not any(self.mirrors[:2])

    @cached_property
    def body(self) -> Body:
        """The layer's elements."""
        return Body(self.grid, self.law, curved_sides=self.curved_sides)

    @cached_property
    def border(self) -> Border | None:
        """What holds the sides that were cut out of a larger layer."""
        return None if self.surroundings is None else self.surroundings.border(self.grid)

    @property
    def own_sides(self) -> Sides:
        """Which sides are the layer's own: the lowest and highest in y, then in x."""
        no_cut = (False, False, False, False)
        cut = no_cut if self.surroundings is None else self.surroundings.cut(self.grid)
        y0, y1, x0, x1 = (not any(of) for of in zip(cut, self.mirrors, self.held, strict=True))
        return y0, y1, x0, x1

    @cached_property
    def held_columns(self) -> NDArray[np.bool_] | None:
        """Columns of nodes that stay where they are, (ny + 1, nx + 1); None: there are none."""
        if not any(self.held):
            return None
        columns = np.zeros(self.grid.node_shape[1:], bool)
        for number, held in enumerate(self.held):
            if held:
                axis, end = divmod(number, 2)
                np.moveaxis(columns, axis, 0)[-end] = True
        return columns

    @cached_property
    def side_facets(self) -> Facets:
        """The element faces of the layer's own free sides."""
        free = self.own_sides if self.edges == "free" else (False, False, False, False)
        return Facets.of(self.grid, free)

    @cached_property
    def side_points(self) -> tuple[Array, Array]:
        """Integration points of ``side_facets``, and how high the imprint is there.

        Unloaded positions, (3, points, nz, n), mm, and heights before and at the full load, (2,
        points, nz, n), mm: in proportion to the load in between.
        """
        points = self.side_facets.at_points(self.grid.nodes, ...)
        x, y = np.ascontiguousarray(points[:2, :, 0])  # all points of a column lie on one line
        heights = np.stack([self.imprint.evaluate(x, y, load)[0] for load in (0.0, 1.0)])
        return points, np.broadcast_to(heights[:, :, None], (2, *points.shape[1:]))

    def hold_sides(self, field: NDArray, value: float | bool) -> None:
        """Set a nodal field (3, ...) to a value where sides have no displacement."""
        if self.held_columns is not None:
            field[..., self.held_columns] = value
        for number, mirror in enumerate(self.mirrors):
            if mirror or self.edges == "roller":
                axis, end = divmod(number, 2)
                np.moveaxis(field[1 - axis], 1 + axis, 0)[-end] = value

    def on_grid(self, grid: LayerGrid, imprint: Imprint | None = None) -> LayerProblem:
        """Return the same problem on another grid."""
        return replace(self, grid=grid, imprint=imprint or self.imprint)


@dataclass
class LayerState:
    """Displacement, pressure, contact and friction state at one load.

    Attributes
    ----------
    load
        Fraction of the full load, 0 to 1.
    u
        Displacement, (3, nz + 1, ny + 1, nx + 1), mm.
    p
        Element pressure, tension positive, (nz, ny, nx), kPa.
    slip
        Friction memory w at window and sample side: slip / slip_length at ``anchor``, (2, 2, m) on
        the nodes of ``contact_nodes``.
    anchor
        Lateral displacement to which ``slip`` belongs, likewise, mm.
    normal_force
        Vertical contact forces, compression positive, (2, ny + 1, nx + 1), mN; of a glued face what
        holds it, which may be tension.
    anchor_load
        Load at which ``anchor`` was laid; by default that of the state.
    """

    load: float
    u: Array
    p: Array
    slip: Array
    anchor: Array
    normal_force: Array
    anchor_load: float = np.nan

    def __post_init__(self) -> None:
        if np.isnan(self.anchor_load):
            self.anchor_load = self.load

    @classmethod
    def unloaded(cls, grid: LayerGrid) -> LayerState:
        """Return the stress-free layer that just touches both rigid surfaces."""
        u = np.zeros((3, *grid.node_shape))
        return cls(
            load=0.0,
            u=u,
            p=np.zeros(grid.shape),
            slip=contact_nodes(u[:2]),
            anchor=contact_nodes(u[:2]),
            normal_force=np.zeros((2, *grid.node_shape[1:])),
        )

    def copy(self) -> LayerState:
        """Return an independent copy."""
        arrays = ("u", "p", "slip", "anchor", "normal_force")
        return replace(self, **{name: getattr(self, name).copy() for name in arrays})

    def at_load(self, load: float) -> LayerState:
        """Return the same state at another load."""
        return replace(self, load=load)

    def towards(self, other: LayerState, load: float) -> LayerState:
        """Go on to a load on the straight line through another state."""
        out = self.copy()
        out.load = load
        ratio = (load - self.load) / (other.load - self.load)
        out.u += ratio * (other.u - self.u)
        out.p += ratio * (other.p - self.p)
        out.normal_force += ratio * (other.normal_force - self.normal_force)
        np.maximum(out.normal_force, 0.0, out=out.normal_force)
        return out

    def following(self, start: LayerState, end: LayerState) -> LayerState:
        """Go on as another layer did from ``start`` to ``end``, to the load of ``end``."""
        out = self.copy()
        out.load = end.load
        out.u += end.u - start.u
        out.p += end.p - start.p
        out.normal_force += end.normal_force - start.normal_force
        np.maximum(out.normal_force, 0.0, out=out.normal_force)
        return out

    def lateral(self) -> Array:
        """Return the lateral displacement at window and sample side, (2, 2, m), mm."""
        return contact_nodes(self.u[:2])

    def touching(self, problem: LayerProblem) -> NDArray[np.bool_]:
        """Return which surface nodes are in contact, (2, ny + 1, nx + 1); all of a glued face."""
        nodes = problem.grid.nodes + self.u
        height = problem.imprint.evaluate(nodes[0, -1], nodes[1, -1], self.load)[0]
        gap = np.stack([nodes[2, 0], height - nodes[2, -1]])
        scale = problem.shear_modulus / problem.grid.spacing[0]
        closed = self.normal_force > scale * problem.grid.surface_areas(nodes[:, -1]) * gap
        closed[list(problem.glued)] = True
        return closed
