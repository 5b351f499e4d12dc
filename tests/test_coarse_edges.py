"""A layer that does not arrive with narrow elements at free edges is solved with wider ones."""

import re
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from optical_palpation.analysis import stress_uncertainty
from optical_palpation.errors import ConvergenceError
from optical_palpation.mechanics import path
from optical_palpation.mechanics.cascade import (
    OnlyOnCoarser,
    Solution,
    _edge_widths,
    _narrow_edges,
    _Nested,
    coarsened,
    solve,
    with_edges,
)
from optical_palpation.mechanics.grid import LayerGrid, edge_width
from optical_palpation.mechanics.iteration import TOLERANCES, NotConverged
from optical_palpation.mechanics.newton import balance
from optical_palpation.mechanics.problem import LayerState
from optical_palpation.palpation import InputErrors, computational_stress, mesh_error
from optical_palpation.palpation.meshing import layer_nodes
from optical_palpation.present import summarise
from optical_palpation.study import warnings_about
from tilted_case import GIVEN, SILICONE, SIZE, bound, problem, tilted


def stress(**options):
    return computational_stress(
        tilted(),
        0.5,
        SILICONE,
        **{**GIVEN, "edge_check": False, "input_errors": None, **options},
    )


def solved(layer):
    return solve(layer, bound)


def force(solution):
    return float(solution.state.normal_force[1].sum())


@pytest.fixture
def stops(monkeypatch):
    """Let no layer be loaded with outermost elements narrower than ``width``, mm."""
    loaded = _Nested._loaded
    given = SimpleNamespace(width=0.8 * SIZE, times=np.inf)

    def stop(nested, level, carried):
        if level.grid.edge_widths[1] < given.width and given.times > 0:
            given.times -= 1
            raise path.LoadNotReached(0.7, "the rim snaps")
        return loaded(nested, level, carried)

    monkeypatch.setattr(_Nested, "_loaded", stop)
    # what a layer that is near enough is carried to must be loaded, too
    monkeypatch.setattr(_Nested, "_carried_over", lambda *_: None)
    return given


def test_edges_are_as_coarse_as_all_else_and_then_narrower_by_and_by():
    fine = problem()
    grid = with_edges(fine, None).grid
    for nodes in (grid.x, grid.y):
        assert_allclose(np.diff(nodes), np.diff(nodes).mean())
        assert nodes[1] == pytest.approx(SIZE, rel=0.15)
    widths = _edge_widths(fine)
    assert 0.5 * SIZE / 4 < widths[0] <= 0.5 * SIZE
    assert all(narrow == pytest.approx(wide / 4) for wide, narrow in pairwise(widths))
    assert widths[-1] == pytest.approx(edge_width(fine.grid.depth, 0.5))
    assert_allclose(with_edges(fine, widths[-1]).grid.x, fine.grid.x)
    for width in widths:
        assert with_edges(fine, width).grid.edge_widths == pytest.approx((width, width), rel=0.1)


def test_edges_that_are_not_free_or_not_narrow_stay():
    assert not _narrow_edges(problem("roller"))
    assert not _narrow_edges(problem("padded"))
    # whose ends are narrower than elements of four thicknesses
    depth, y, x = layer_nodes((0, 10, 0, 10), 0.5, (2.0, 2.0, 0.25), "padded")
    assert x[1] - x[0] < 0.9 * 2.0
    wide = problem().on_grid(LayerGrid(x, y, depth, np.full((len(y), len(x)), 0.5)))
    assert not _narrow_edges(wide)
    assert not _narrow_edges(with_edges(problem(), None))
    narrow = problem().grid
    strip = problem().on_grid(
        LayerGrid(narrow.x, np.array([0.0, 0.2]), narrow.depth, 0.5 + 0 * narrow.thickness[:2])
    )
    assert_allclose(with_edges(strip, 0.01).grid.y, strip.grid.y)


@pytest.mark.parametrize("width", [None, 0.05])
def test_a_coarser_grid_keeps_edges_as_wide_as_they_are(width):
    wide = with_edges(problem(size=0.08), width)
    coarse = coarsened(wide).grid
    assert coarse.x[1] == pytest.approx(width or 2 * wide.grid.x[1], rel=0.1)


def test_without_narrow_edges_the_result_is_that_of_the_elements_inside(stops):
    result = stress(edge_check=True, input_errors=InputErrors())
    attrs = result.maps.attrs
    assert attrs["status"] == "converged with coarse free edges"
    assert attrs["force_residual"] < attrs["force_tolerance"]
    assert attrs["edges"] == "free"
    assert "asked_elements_failure" not in attrs
    coarse = with_edges(problem(), None)
    assert attrs["edge_element_size_mm"] == list(coarse.grid.edge_widths)
    assert attrs["asked_edge_element_size_mm"] == pytest.approx([0.02, 0.02], rel=0.1)
    assert attrs["sample_force_mN"] == pytest.approx(force(solved(coarse)), rel=1e-4)
    said = "outermost elements 0.22 and 0.22 mm wide along x and y, not 0.0.* mm: with those the "
    said += "layer was loaded to 70.0 % only: the rim snaps"
    assert re.search(f"WARNING: this is the solution with {said}", summarise(result))
    assert any(re.search(said, text) for text in warnings_about(result))
    assert 0 < attrs["force_error_mN"] < attrs["sample_force_mN"]
    stops.times = 0
    narrow = stress(edge_check=True).maps.attrs
    influence = "edge_influence_force"  # told on a grid with edges as coarse as those of the layer
    assert attrs[influence] == pytest.approx(narrow[influence], rel=0.2)
    assert attrs[influence] != narrow[influence]


def test_the_error_of_the_mesh_holds_what_coarse_edges_are_off_by(stops):
    coarse = stress().maps.attrs
    stops.times = 0
    fine = stress().maps.attrs
    off = abs(coarse["sample_force_mN"] - fine["sample_force_mN"])
    assert 0.001 * fine["sample_force_mN"] < off < coarse["force_mesh_error_mN"]


def test_edges_become_as_narrow_as_the_layer_bears(stops):
    stops.width = 0.05
    with pytest.raises(OnlyOnCoarser) as failure:
        solved(problem())
    assert failure.value.at_edges
    solution = failure.value.solution
    assert solution.problem.grid.edge_widths == pytest.approx((0.08, 0.08), rel=0.1)
    assert balance(solution.problem, solution.state).force_error < TOLERANCES.force
    assert not _narrow_edges(solution.wider.problem)
    assert solution.wider.wider is None
    assert sum(entry[1] == 1.0 for entry in solution.record) == 2
    assert stress().maps.attrs["edge_element_size_mm"] == list(solution.problem.grid.edge_widths)


def test_a_layer_that_bears_its_own_edges_in_the_end_is_converged(stops):
    stops.times = 1  # when it is loaded at first
    result = stress()
    attrs = result.maps.attrs
    assert attrs["status"] == "converged"
    assert not any(key.startswith("asked") for key in attrs)
    assert_allclose(result.problem.grid.x, problem().grid.x)
    assert attrs["force_mesh_error_mN"] > 0
    stops.times = 0
    assert attrs["sample_force_mN"] == pytest.approx(stress().maps.attrs["sample_force_mN"], 5e-3)


def test_a_layer_that_bears_no_edges_at_all_does_not_arrive(stops):
    stops.width = np.inf
    with pytest.raises(ConvergenceError, match=r"loaded to 70\.0 % only: the rim snaps"):
        stress()


def test_other_edges_are_no_error_of_the_inputs(stops):
    with pytest.raises(ConvergenceError, match="the rim snaps"):
        stress_uncertainty(tilted(), 0.5, SILICONE, **GIVEN)


def test_what_slides_away_slides_with_any_edges(monkeypatch):
    def slides(*_):
        raise path.LoadNotReached(1.0, path.SLIDES)

    monkeypatch.setattr(_Nested, "_loaded", slides)
    monkeypatch.setattr(_Nested, "_by_wider_edges", lambda _: pytest.fail("solved again"))
    with pytest.raises(path.LoadNotReached, match="nothing holds the layer sideways"):
        solved(problem())


@pytest.mark.parametrize(("snaps", "drags"), [(0, 0), (1, 1)])
def test_a_path_that_may_not_snap_so_often_is_given_up(snaps, drags, monkeypatch):
    """No load has an equilibrium, and drag carries over a tenth of it at a time."""

    def equilibrate(*_):
        raise NotConverged("it snaps")

    def creep(way, *_, **__):
        layer.drags += 1
        way.state = way.state.at_load(way.state.load + 0.1)

    monkeypatch.setattr(path.Path, "_creep", creep)
    layer = SimpleNamespace(drags=0, equilibrate=equilibrate, contact_forces=lambda _: [])
    rest = LayerState.unloaded(problem().grid)
    way = path.Path(layer, TOLERANCES, TOLERANCES, rest, snaps=snaps)
    with pytest.raises(path.LoadNotReached, match="it snaps"):
        way.follow(rest.at_load(1.0))
    assert layer.drags == drags


def test_what_narrower_edges_change_is_part_of_the_error(monkeypatch):
    """By 2 mN where they are halved: so much again may be missing. Elements inside: by 1 mN."""
    narrow = problem(size=0.08)
    coarse = with_edges(narrow, None)
    coarser = coarsened(coarse)
    forces = {id(narrow): 100.0, id(coarse): 98.0, id(coarser): 97.0}

    def unloaded(level):
        return LayerState.unloaded(level.grid)

    inside = Solution(coarse, unloaded(coarse), coarser=(coarser, unloaded(coarser)))
    whole = Solution(narrow, unloaded(narrow), wider=inside)

    def quantities(level, _):
        return forces.get(id(level), 97.0), np.zeros((4, 4))

    monkeypatch.setattr(
        mesh_error, "solve", lambda level, *_, **__: Solution(level, unloaded(level))
    )
    found = mesh_error.mesh_error(whole, quantities, lambda _: 0)
    of_inside = mesh_error.mesh_error(inside, quantities, lambda _: 0)
    edges = mesh_error.FREE_EDGES
    assert found.force == pytest.approx(1.25 * 2 + of_inside.force + edges * 2)
    assert of_inside.force > 1.0
