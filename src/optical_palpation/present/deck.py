"""The problem of the layer as an Abaqus/CalculiX input deck, so that other codes can check it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TextIO

import numpy as np
from numpy.typing import NDArray

from optical_palpation.errors import InputError
from optical_palpation.mechanics.problem import SAMPLE, WINDOW, LayerProblem
from optical_palpation.present.output import atomic
from optical_palpation.runtime import software_version

Array = NDArray[np.float64]
Labels = NDArray[np.int_]

# Nodes of a brick on a lattice that counts half elements, offsets (x, y, z) in the order of both
# codes: eight corners, then the middles of the bottom, the top and the upright edges.
_RING = [(0, 0), (2, 0), (2, 2), (0, 2)]
_SIDES = [(1, 0), (2, 1), (1, 2), (0, 1)]
_CORNERS = [(i, j, k) for k in (0, 2) for i, j in _RING]
_MIDDLES = [(i, j, k) for k in (0, 2) for i, j in _SIDES] + [(i, j, 1) for i, j in _RING]


@dataclass(frozen=True)
class _Bricks:
    """Nodes and elements of a structured block of bricks.

    ``labels`` holds the node numbers on the lattice, (2nz+1, 2ny+1, 2nx+1), 0 where there is none;
    ``positions`` is (3, nodes), ``connectivity`` (elements, 8 or 20).
    """

    labels: Labels
    nodes: Labels
    positions: Array
    elements: Labels
    connectivity: Labels


def _bricks(lattice: Array, quadratic: bool, after: _Bricks | None = None) -> _Bricks:
    """Give numbers to nodes and elements of a block, from 1 or where another block ends.

    ``lattice`` holds the positions of corners, edge middles and centres, (3, 2nz+1, 2ny+1, 2nx+1).
    """
    odd = np.sum([index % 2 for index in np.indices(lattice.shape[1:])], axis=0)
    used = odd <= (1 if quadratic else 0)
    nodes = np.arange(used.sum()) + (after.nodes[-1] + 1 if after else 1)
    labels = np.zeros(used.shape, int)
    labels[used] = nodes
    connectivity = np.stack(
        [
            labels[k : k - 2 or None : 2, j : j - 2 or None : 2, i : i - 2 or None : 2].ravel()
            for i, j, k in _CORNERS + (_MIDDLES if quadratic else [])
        ],
        axis=1,
    )
    elements = np.arange(len(connectivity)) + (after.elements[-1] + 1 if after else 1)
    return _Bricks(labels, nodes, lattice[:, used], elements, connectivity)


def write_deck(
    problem: LayerProblem,
    path: str | Path,
    *,
    element: Literal["C3D20R", "C3D20RH", "C3D8I"] = "C3D20R",
    contact_stiffness: float | None = None,
    first_increment: float = 0.05,
    largest_increment: float = 0.1,
) -> None:
    """Write the problem as an input deck for CalculiX or Abaqus.

    Every element of the grid becomes one brick of the deck. Window and imprint are meshed bricks
    whose nodes are all prescribed: the window is fixed, and each node of the imprint moves from the
    unloaded to the loaded surface, in proportion to the load, along z and, where the sample moves
    sideways, with it. The imprint is quadratic,
    with elements as large as the layer's, and reaches as far beyond the layer as a layer without
    friction would spread, and one thickness more. Contact is surface to surface by penalty, with
    Coulomb friction, on the two large faces of the layer; its free sides meet nothing.

    Parameters
    ----------
    problem
        What to write. CalculiX has no mixed elements and fails well before K/mu = 1e4: give it a
        problem with K/mu about 100, and compare at equal K/mu.
    path
        The deck, ``.inp``.
    element
        ``C3D20R``, quadratic with reduced integration, for both codes; ``C3D8I``, linear with
        incompatible modes, cheaper and less accurate, for both; ``C3D20RH``, quadratic with
        independent pressure for any K/mu, for Abaqus. Plain linear bricks lock.
    contact_stiffness
        Pressure per overlap at both surfaces, kPa/mm. By default the overlap is 0.05 % of the
        thickness where the pressure equals mu; ``roller`` edges, between which a layer yields only
        by its bulk modulus, need a contact about ten times stiffer.
    first_increment, largest_increment
        Load increments, as fractions of the full load, which the code shortens where it has to.
        Friction depends on the path: compare at equal increments.

    Raises
    ------
    InputError
        A face is glued, which the deck cannot say.
    OutputError
        The file cannot be written; nothing is left behind.
    """
    if any(problem.glued):
        raise InputError(
            "a deck holds faces with friction; faces that are glued cannot be written. Give them "
            "the friction that comes nearest"
        )
    mean_thickness = float(problem.grid.thickness.mean())
    if contact_stiffness is None:
        contact_stiffness = problem.shear_modulus / (5e-4 * mean_thickness)
    per_layer = problem.grid.shape[1] * problem.grid.shape[2]
    quadratic = element.startswith("C3D20")
    layer = _bricks(_halved(problem.grid.nodes, (1, 2, 3)), quadratic)
    lattice, loaded = _imprint_lattice(problem)
    imprint = _bricks(lattice, quadratic=True, after=layer)
    x, y = lattice[0, 0, 0, [0, -1]], lattice[1, 0, [0, -1], 0]
    corners = np.stack(np.meshgrid(x, y, [-mean_thickness, 0.0], indexing="ij")).T
    window = _bricks(_halved(np.moveaxis(corners, -1, 0), (1, 2, 3)), False, after=imprint)
    with atomic(path, "deck") as temporary, temporary.open("w") as file:
        _write_heading(file, problem)
        _write_mesh(file, layer, "LAYER", element)
        _write_mesh(file, imprint, "IMPRINT", "C3D20")
        _write_mesh(file, window, "WINDOW", "C3D8")
        file.write(f"""\
**
** The layer: coefficients in kPa and D1 = 2/K in 1/kPa
*MATERIAL, NAME=SILICONE
{_hyperelastic(problem)}
*SOLID SECTION, ELSET=LAYER, MATERIAL=SILICONE
** Window and imprint: all nodes are prescribed, so that this stiffness never matters
*MATERIAL, NAME=PRESCRIBED
*ELASTIC
{problem.shear_modulus:.9g}, 0.
*SOLID SECTION, ELSET=WINDOW, MATERIAL=PRESCRIBED
*SOLID SECTION, ELSET=IMPRINT, MATERIAL=PRESCRIBED
**
** Contact of the two large faces of the layer
""")
        _write_set(file, "*ELSET, ELSET=LAYER_BOTTOM", layer.elements[:per_layer])
        _write_set(file, "*ELSET, ELSET=LAYER_TOP", layer.elements[-per_layer:])
        for face, rigid, elements, sides in (
            (WINDOW, "WINDOW", "LAYER_BOTTOM", ("S1", "S2")),
            (SAMPLE, "IMPRINT", "LAYER_TOP", ("S2", "S1")),
        ):
            _write_contact(file, problem, face, rigid, elements, sides, contact_stiffness)
        file.write("**\n*BOUNDARY\nWINDOW, 1, 3\n")
        if problem.edges == "roller":
            _write_rollers(file, layer)
        file.write(f"""\
**
** The imprint is lowered from the unloaded to the loaded surface
*STEP, NLGEOM, INC=10000
*STATIC
{first_increment:g}, 1., 1e-6, {largest_increment:g}
*BOUNDARY
""")
        for node, moves in zip(imprint.nodes, loaded[:, imprint.labels > 0].T, strict=True):
            for axis, move in enumerate(moves, 1):
                file.write(f"{node}, {axis}, {axis}, {move:.9g}\n")
        file.write("""\
** Total forces, mN, and Cauchy stress at integration points, kPa, as text at the full load
*NODE PRINT, NSET=WINDOW, TOTALS=YES, FREQUENCY=10000
RF
*NODE PRINT, NSET=IMPRINT, TOTALS=YES, FREQUENCY=10000
RF
*EL PRINT, ELSET=LAYER, FREQUENCY=10000
S
*NODE FILE, FREQUENCY=10000
U, RF
*EL FILE, FREQUENCY=10000
S
*CONTACT FILE, FREQUENCY=10000
CDIS, CSTR
*END STEP
""")


@dataclass(frozen=True)
class DeckResult:
    """What a code wrote at the full load.

    Attributes
    ----------
    window_force, imprint_force
        Total forces on the layer, (x, y, z), mN.
    stress
        Cauchy stress at the integration points of the layer's elements, kPa, tension positive;
        shape (6, nz, ny, nx, points), components xx, yy, zz, yz, xz, xy.
    """

    window_force: Array
    imprint_force: Array
    stress: Array


def read_deck_result(path: str | Path, shape: tuple[int, int, int]) -> DeckResult:
    """Read the ``.dat`` file that CalculiX makes of a deck.

    Parameters
    ----------
    path
        The ``.dat`` file.
    shape
        Numbers of elements (nz, ny, nx) of the grid the deck was written from.

    Raises
    ------
    InputError
        The file cannot be read, or lacks the results at the full load.
    """
    try:
        text = Path(path).read_text()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    parts = re.split(r"^ ([a-z].*) and time +0\.10+E\+01$", text, flags=re.MULTILINE)
    tables = dict(zip(parts[1::2], parts[2::2], strict=True))
    try:
        window, imprint = (
            np.array(tables[f"total force (fx,fy,fz) for set {name}"].split(), float)
            for name in ("WINDOW", "IMPRINT")
        )
        stresses = tables["stresses (elem, integ.pnt.,sxx,syy,szz,sxy,sxz,syz) for set LAYER"]
        rows = np.array(stresses.split(), float).reshape(np.prod(shape), -1, 8)
    except (KeyError, ValueError) as error:
        raise InputError(
            f"{path}: holds no complete results of the layer at the full load ({error}); "
            "did the run reach the end, and was the deck written from this grid?"
        ) from error
    stress = np.moveaxis(rows[..., [2, 3, 4, 7, 6, 5]], -1, 0)
    return DeckResult(window, imprint, stress.reshape(6, *shape, -1))


def _halved(field: Array, axes: tuple[int, ...]) -> Array:
    """Insert the mean of neighbours between them, along each axis."""
    for axis in axes:
        values = np.moveaxis(field, axis, 0)
        out = np.empty((2 * len(values) - 1, *values.shape[1:]))
        out[::2] = values
        out[1::2] = 0.5 * (values[1:] + values[:-1])
        field = np.moveaxis(out, 0, axis)
    return field


def _imprint_lattice(problem: LayerProblem) -> tuple[Array, Array]:
    """Lattice of the unloaded imprint, one brick thick, and its displacement at full load."""
    grid, imprint = problem.grid, problem.imprint

    def lines(nodes: Array, stretch: float) -> Array:
        margin = 0.5 * stretch * (nodes[-1] - nodes[0]) + grid.thickness.max()
        size = np.median(np.diff(nodes))
        count = int(np.ceil(margin / size))
        beyond = size * np.arange(1, count + 1)
        nodes = np.concatenate([nodes[0] - beyond[::-1], nodes, nodes[-1] + beyond])
        return _halved(nodes, (0,))

    inside = np.meshgrid(grid.x, grid.y)
    start, end = (imprint.evaluate(*inside, load)[0] for load in (0.0, 1.0))
    spread = max(0.0, float(np.sqrt(start.mean() / end.mean())) - 1)
    x, y = np.meshgrid(lines(grid.x, spread), lines(grid.y, spread))
    sideways = imprint.velocity(x, y, 0.0)
    start = imprint.evaluate(x, y, 0.0)[0]
    end = imprint.evaluate(x + sideways[0], y + sideways[1], 1.0)[0]
    back = np.full_like(start, start.max() + grid.thickness.mean())
    z = _halved(np.stack([start, back]), (0,))
    lattice = np.stack([np.broadcast_to(x, z.shape), np.broadcast_to(y, z.shape), z])
    moves = np.stack([*sideways, end - start])
    return lattice, np.broadcast_to(moves[:, None], lattice.shape)


def _hyperelastic(problem: LayerProblem) -> str:
    c10, c20, c30, c01 = problem.law.coefficients
    compressibility = 2 / problem.bulk_modulus
    law, values = "MOONEY-RIVLIN", [c10, c01, compressibility]
    if c20 != 0 or c30 != 0:
        law, values = "YEOH", [c10, c20, c30, compressibility, 0.0, 0.0]
    return f"*HYPERELASTIC, {law}\n" + ", ".join(f"{value:.9g}" for value in values)


def _write_heading(file: TextIO, problem: LayerProblem) -> None:
    nz, ny, nx = problem.grid.shape
    file.write(f"""\
*HEADING
Compliant layer pressed between a window and an imprint (optical palpation)
** Written by optical-palpation {software_version()}, for CalculiX and Abaqus/Standard.
** Units: mm, kPa, mN. z = 0 at the window, z = L0 at the sample side; tension positive.
** Layer of {nx} x {ny} x {nz} elements, {problem.edges} edges; shear modulus
** {problem.shear_modulus:.9g} kPa, bulk modulus {problem.bulk_modulus:.9g} kPa; friction
** {problem.friction[WINDOW]:g} at the window, {problem.friction[SAMPLE]:g} at the imprint.
** The imprint starts on the unloaded layer and carries the measured loaded thickness at the end.
""")


def _write_mesh(file: TextIO, bricks: _Bricks, name: str, element: str) -> None:
    file.write(f"**\n*NODE, NSET={name}\n")
    for node, (x, y, z) in zip(bricks.nodes, bricks.positions.T, strict=True):
        file.write(f"{node}, {x:.9g}, {y:.9g}, {z:.9g}\n")
    file.write(f"*ELEMENT, TYPE={element}, ELSET={name}\n")
    for label, nodes in zip(bricks.elements, bricks.connectivity, strict=True):
        file.write(_lines([label, *nodes]))


def _lines(numbers: list[int] | Labels, width: int = 10) -> str:
    """Comma-separated integers, continued over lines (a trailing comma continues a line)."""
    rows = [numbers[i : i + width] for i in range(0, len(numbers), width)]
    return ",\n".join(", ".join(map(str, row)) for row in rows) + "\n"


def _write_set(file: TextIO, keyword: str, members: Labels) -> None:
    file.write(f"{keyword}\n{_lines(members)}")


def _write_contact(
    file: TextIO,
    problem: LayerProblem,
    face: int,
    rigid: str,
    elements: str,
    sides: tuple[str, str],
    stiffness: float,
) -> None:
    friction = problem.friction[face]
    file.write(f"""\
*SURFACE, NAME={elements}_FACE
{elements}, {sides[0]}
*SURFACE, NAME={rigid}_FACE
{rigid}, {sides[1]}
*SURFACE INTERACTION, NAME={rigid}_CONTACT
*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR
{stiffness:.9g}
""")
    if friction > 0:
        # Friction builds up over the slip length at a pressure of mu, as it does in the problem.
        slope = friction * problem.shear_modulus / problem.slip_length
        file.write(f"*FRICTION\n{friction:.9g}, {slope:.9g}\n")
    file.write(f"""\
*CONTACT PAIR, INTERACTION={rigid}_CONTACT, TYPE=SURFACE TO SURFACE
{elements}_FACE, {rigid}_FACE
""")


def _write_rollers(file: TextIO, layer: _Bricks) -> None:
    for name, axis, ends in (
        ("SIDES_X", 1, layer.labels[:, :, [0, -1]]),
        ("SIDES_Y", 2, layer.labels[:, [0, -1]]),
    ):
        _write_set(file, f"*NSET, NSET={name}", ends[ends > 0])
        file.write(f"*BOUNDARY\n{name}, {axis}, {axis}\n")
