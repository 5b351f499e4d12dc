"""The exported deck: its content, and CalculiX run on it against our own solver."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calculix import CalculixResult, calculix_installed, run_calculix
from optical_palpation.errors import InputError, OutputError
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.cascade import solve
from optical_palpation.mechanics.grid import LayerGrid, graded_depths, node_positions
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.iteration import Tolerances
from optical_palpation.mechanics.path import StepControl
from optical_palpation.mechanics.problem import LayerProblem
from optical_palpation.present.deck import read_deck_result, write_deck

needs_calculix = pytest.mark.skipif(
    not calculix_installed(), reason="CalculiX (Debian package calculix-ccx) is not installed"
)


def bump(lateral: int, deep: int, **changes) -> LayerProblem:
    """Return a 2 x 2 x 0.5 mm layer under an off-centre bump, K/mu = 100."""
    nodes = node_positions(2.0, 2.0 / lateral)
    thickness = np.full((lateral + 1, lateral + 1), 0.5)
    pixels = np.linspace(0, 2, 41)
    x, y = np.meshgrid(pixels, pixels)
    loaded = 0.45 - 0.1 * np.exp(-((x - 1.1) ** 2 + (y - 0.9) ** 2) / (2 * 0.35**2))
    problem = LayerProblem(
        grid=LayerGrid(nodes, nodes, graded_depths(deep), thickness),
        imprint=Imprint(pixels, pixels, np.full_like(loaded, 0.5), loaded),
        law=MooneyRivlin(2.23, 0.703, 100.0),
        friction=(0.2, 0.1),
    )
    return replace(problem, **changes)


def spreading(problem: LayerProblem, strain: float) -> LayerProblem:
    """Return the problem with an imprint that spreads about its centre."""
    imprint = problem.imprint
    motion = strain * (np.stack(np.meshgrid(imprint.x, imprint.y)) - 1.0)
    return replace(problem, imprint=replace(imprint, motion=motion))


class Deck:
    """The blocks of a deck, as plainly as they can be read."""

    def __init__(self, path: Path) -> None:
        text = re.sub(r"^\*\*.*\n", "", path.read_text(), flags=re.MULTILINE)
        text = re.sub(r",\n", ",", text)
        self.blocks = [block.split("\n", 1) for block in re.split(r"^\*", text, flags=re.M)[1:]]

    def rows(self, keyword: str, number: int = 0) -> list[list[str]]:
        found = [body for head, body in self.blocks if head.startswith(keyword)]
        return [re.split(r",\s*", line) for line in found[number].strip().splitlines()]

    def nodes(self, name: str) -> dict[int, np.ndarray]:
        rows = self.rows(f"NODE, NSET={name}")
        return {int(row[0]): np.array(row[1:], float) for row in rows}

    def elements(self, kind: str, name: str) -> dict[int, list[int]]:
        rows = self.rows(f"ELEMENT, TYPE={kind}, ELSET={name}")
        return {int(row[0]): [int(node) for node in row[1:]] for row in rows}


def brick_volume(corners: np.ndarray) -> float:
    """Return the volume of a trilinear brick by 2 x 2 x 2 Gauss points; negative if inside out."""
    signs = np.array([[i, j, k] for k in (-1, 1) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    volume = 0.0
    for point in signs / np.sqrt(3):
        factors = 1 + signs * point
        slopes = np.stack(
            [signs[:, d] * factors[:, d - 1] * factors[:, d - 2] / 8 for d in range(3)]
        )
        volume += np.linalg.det(slopes @ corners)
    return volume


@pytest.mark.parametrize("kind", ["C3D20R", "C3D8I"])
def test_elements_fill_the_layer(tmp_path, kind):
    problem = bump(3, 2)
    problem.grid.thickness[:] += 0.1 * np.arange(4)  # a wedge
    write_deck(problem, tmp_path / "layer.inp", element=kind)
    deck = Deck(tmp_path / "layer.inp")
    nodes, elements = deck.nodes("LAYER"), deck.elements(kind, "LAYER")
    assert len(elements) == problem.grid.n_elements
    assert set(nodes) == {node for element in elements.values() for node in element}
    positions = {tuple(np.round(position, 6)) for position in nodes.values()}
    assert len(positions) == len(nodes)
    assert {tuple(node) for node in np.round(problem.grid.nodes.reshape(3, -1).T, 6)} <= positions
    volumes = [
        brick_volume(np.array([nodes[node] for node in element[:8]]))
        for element in elements.values()
    ]
    assert min(volumes) > 0
    assert sum(volumes) == pytest.approx(4 * problem.grid.thickness.mean(), rel=1e-7)
    # edge middles: bottom ring, top ring, uprights, in the order both codes expect
    ends = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4)]
    ends += [(0, 4), (1, 5), (2, 6), (3, 7)]
    for element in elements.values():
        for middle, (a, b) in zip(element[8:], ends, strict=kind == "C3D20R"):
            np.testing.assert_allclose(
                nodes[middle], 0.5 * (nodes[element[a]] + nodes[element[b]]), atol=1e-8
            )


@pytest.mark.parametrize("drift", [0.0, 0.06])
def test_imprint_starts_on_the_layer_and_ends_on_the_measured_surface(tmp_path, drift):
    problem = spreading(bump(4, 1), drift)
    write_deck(problem, tmp_path / "layer.inp")
    deck = Deck(tmp_path / "layer.inp")
    nodes = deck.nodes("IMPRINT")
    given = {(int(node), int(a)): float(move) for node, a, b, move in deck.rows("BOUNDARY", -1)}
    moves = {node: np.array([given.pop((node, axis)) for axis in (1, 2, 3)]) for node in nodes}
    assert not given
    faces = [element[:4] + element[8:12] for element in deck.elements("C3D20", "IMPRINT").values()]
    face = np.array(sorted({node for corners in faces for node in corners}))
    x, y, z = np.array([nodes[node] for node in face]).T
    move = np.array([moves[node] for node in face]).T
    np.testing.assert_allclose(z, problem.imprint.evaluate(x, y, 0.0)[0], atol=1e-8)
    end = np.array([x, y, z]) + move
    np.testing.assert_allclose(end[2], problem.imprint.evaluate(*end[:2], 1.0)[0], atol=1e-8)
    inside = (abs(end[:2] - 1) < 1).all(0)  # beyond its map the motion goes on level
    np.testing.assert_allclose(move[:2, inside], drift * (end[:2, inside] - 1), atol=1e-5)
    # it reaches beyond the layer by at least one thickness on every side
    assert x.min() < -0.5
    assert y.min() < -0.5
    assert x.max() > 2.5
    assert y.max() > 2.5


def test_material_contact_and_edges(tmp_path):
    problem = bump(2, 1, edges="roller", friction=(0.3, 0.0))
    write_deck(problem, tmp_path / "layer.inp", contact_stiffness=1e4)
    deck = Deck(tmp_path / "layer.inp")
    c10, c01, d1 = (float(number) for number in deck.rows("HYPERELASTIC, MOONEY-RIVLIN")[0])
    assert (c10, c01) == (2.23, 0.703)
    assert 2 / d1 == pytest.approx(586.6)
    assert [float(row[0][0]) for row in (deck.rows("SURFACE BEHAVIOR", n) for n in (0, 1))] == [
        1e4,
        1e4,
    ]
    friction = [body for head, body in deck.blocks if head == "FRICTION"]
    assert len(friction) == 1  # none at the imprint
    assert float(friction[0].split(",")[0]) == 0.3
    nodes = deck.nodes("LAYER")
    for name, axis in (("SIDES_X", 0), ("SIDES_Y", 1)):
        members = {int(node) for node in deck.rows(f"NSET, NSET={name}")[0]}
        assert members == {n for n, position in nodes.items() if position[axis] in (0.0, 2.0)}


def test_nothing_is_written_where_nothing_can_be(tmp_path):
    with pytest.raises(OutputError, match=r"\.inp"):
        write_deck(bump(2, 1), tmp_path / "layer.txt")
    with pytest.raises(OutputError, match="no folder"):
        write_deck(bump(2, 1), tmp_path / "absent" / "layer.inp")
    assert list(tmp_path.iterdir()) == []


def test_results_that_are_absent_or_incomplete(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_deck_result(tmp_path / "layer.dat", (1, 2, 2))
    (tmp_path / "layer.dat").write_text(
        "\n total force (fx,fy,fz) for set WINDOW and time  0.5000000E+00\n\n  0. 0. 1.\n"
    )
    with pytest.raises(InputError, match="full load"):
        read_deck_result(tmp_path / "layer.dat", (1, 2, 2))


def ours(problem: LayerProblem) -> tuple[float, np.ndarray]:
    """Return total force and mean Cauchy stress of 2 x 2 x 2 elements, our solver."""
    grid = problem.grid
    guess = problem.shear_modulus * grid.surface_areas(grid.nodes[:, -1])
    state = solve(
        problem,
        lambda _: guess,
        solver="direct",
        cascade=False,
        tolerances=Tolerances(),
        control=StepControl(0.1, 0.1),
    ).state
    stress = problem.body.stress(state.u, state.p)
    nz, ny, nx = (count // 2 for count in grid.shape)
    blocks = stress.reshape(6, nz, 2, ny, 2, nx, 2)
    return float(state.normal_force[0].sum()), blocks.mean((2, 4, 6))


def calculix(problem: LayerProblem, folder: Path, **deck) -> CalculixResult:
    result = run_calculix(problem, folder, 300, first_increment=0.1, largest_increment=0.1, **deck)
    assert result.converged, (folder / "layer.log").read_text()[-2000:]
    assert result.force_imprint == pytest.approx(result.force_window, rel=1e-5)
    return result


@needs_calculix
@pytest.mark.parametrize("strain", [0.0, pytest.param(0.2, marks=pytest.mark.slow)])
def test_calculix_agrees_on_force_and_stress(tmp_path, strain):
    """Quadratic elements against linear ones of half the size, at equal K/mu and increments.

    Carried outwards by an imprint that spreads by 20 %, the layer bears 17 % less.
    """
    theirs = calculix(spreading(bump(6, 2), strain), tmp_path)
    force, stress = ours(spreading(bump(12, 4), strain))
    assert theirs.force_window == pytest.approx(force, rel=0.01)
    # next to the imprint, relative to the axial stress there; shear is what friction shows in
    difference = theirs.fields.stress[:, -1].mean(-1) - stress[:, -1]
    scale = np.linalg.norm(stress[2, -1])
    errors = np.linalg.norm(difference, axis=(1, 2)) / scale
    assert (errors[:3] < 0.025).all()
    assert (errors[3:] < 0.01).all()


@needs_calculix
def test_calculix_agrees_between_rollers(tmp_path):
    """Held at its sides, the layer yields by its bulk modulus only: D1 and the rollers count."""
    pixels = np.linspace(0, 2, 41)
    x, y = np.meshgrid(pixels, pixels)
    loaded = 0.495 - 0.02 * np.cos(np.pi * x) * np.cos(np.pi * y / 2)
    imprint = Imprint(pixels, pixels, np.full_like(loaded, 0.5), loaded)
    theirs = calculix(bump(4, 2, edges="roller", imprint=imprint), tmp_path, contact_stiffness=1e6)
    force, _ = ours(bump(8, 4, edges="roller", imprint=imprint))
    assert theirs.force_window == pytest.approx(force, rel=0.02)


@needs_calculix
def test_calculix_out_of_time_or_out_of_reach(tmp_path):
    stopped = run_calculix(bump(6, 2), tmp_path, 0.2)
    assert not stopped.converged
    assert stopped.seconds < 5
    assert np.isnan(stopped.force_window)
