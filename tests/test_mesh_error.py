"""The discretisation error that each result carries."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.cascade import LoadNotReached, Solution, coarsened, halved
from optical_palpation.mechanics.effort import Effort
from optical_palpation.mechanics.grid import LayerGrid, graded_depths, node_positions
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.palpation import computational_stress, mesh_error
from optical_palpation.present import summarise
from optical_palpation.thickness import thickness_map

GEL = MooneyRivlin(2.23, 0.703)
AXIS = np.linspace(0, 1.2, 61)


def problem(count, depth=4, edges="roller"):
    nodes = np.linspace(0, 2, count + 1)
    layer = LayerGrid(nodes, nodes, graded_depths(depth), np.full((count + 1, count + 1), 0.5))
    flat = np.full((9, 9), 0.5)
    pixels = np.linspace(0, 2, 9)
    imprint = Imprint(pixels, pixels, flat, 0.9 * flat)
    return LayerProblem(layer, imprint, GEL, (0.1, 0.1), edges=edges)


def unloaded(of):
    return LayerState.unloaded(of.grid)


def solved(level, *_, **__):
    return Solution(level, unloaded(level))


def press(size):
    relief = 0.42 - 0.04 * np.exp(-((AXIS - 0.5) ** 2 + (AXIS[:, None] - 0.7) ** 2) / 0.05)
    return computational_stress(
        thickness_map(relief, x=AXIS, y=AXIS, where="bump"),
        0.5,
        GEL,
        window_friction=0.2,
        sample_friction=0.1,
        element_size=size,
        threads=1,
        edge_check=False,
        input_errors=None,
    )


@given(
    order=st.floats(1, 2),
    error=st.sampled_from([-1.0, -0.01, 0.3]),
    depth=st.sampled_from([2, 4, 8]),
)
@settings(max_examples=30, deadline=None)
def test_the_error_of_a_method_of_order_one_to_two_lies_within_the_estimate(order, error, depth):
    fine = problem(16, depth)
    coarse = coarsened(fine)
    for of_depth in (0.0, 0.4):

        def quantities(level, _, of_depth=of_depth):
            across, through = 16 / level.grid.shape[1], depth / level.grid.shape[0]
            off = error * ((1 - of_depth) * across**order + of_depth * through**order)
            return 10 + off, np.full((5, 5), off)

        solution = Solution(fine, unloaded(fine), coarser=(coarse, unloaded(coarse)))
        with mock.patch.object(
            mesh_error, "solve", lambda level, *_, **__: Solution(level, unloaded(level))
        ):
            found = mesh_error.mesh_error(solution, quantities, lambda _: 0)
        assert abs(error) * (1 - 1e-6) <= found.force <= abs(error) * (1.25 * (1 + 2) + 1e-6)
        np.testing.assert_allclose(found.stress, found.force, rtol=1e-6, atol=1e-12)
        assert found.elements == coarse.grid.n_elements


def test_what_neither_grid_resolves_is_compared_on_further_ones(monkeypatch):
    """The nested iteration keeps a layer three elements deep, and flat elements as wide."""
    monkeypatch.setattr(mesh_error, "solve", solved)
    shallow, flat = problem(16, 3), problem(16, 40)
    for fine, axis in ((shallow, 0), (flat, 1)):
        coarse = coarsened(fine)
        assert coarse.grid.shape[axis] == fine.grid.shape[axis]
        mine = fine.grid.shape[axis]

        def quantities(level, _, axis=axis, mine=mine):
            return 10 + (mine / level.grid.shape[axis]) ** 2, np.zeros((4, 4))

        solution = Solution(fine, unloaded(fine), coarser=(coarse, unloaded(coarse)))
        assert mesh_error.mesh_error(solution, quantities, lambda _: 0).force >= 1.0
        assert mesh_error.mesh_error(solution, quantities, lambda _: 0, further=False) is None


def test_narrow_free_edges_of_a_deep_layer_are_compared_too(monkeypatch):
    """They cannot be made coarser for ever: what is left would be as many elements again."""
    asked = []

    def once_more(level, along):
        asked.append(level.grid.shape)
        assert len(asked) < 20
        return halved(level, along)

    monkeypatch.setattr(mesh_error, "solve", solved)
    monkeypatch.setattr(mesh_error, "halved", once_more)
    rolling = problem(16, 12, "free")
    nodes = node_positions(5.0, 0.025, edge=0.02)
    thickness = np.full((len(nodes), len(nodes)), 0.5)
    fine = rolling.on_grid(LayerGrid(nodes, nodes, np.linspace(0, 1, 13), thickness))
    coarse = coarsened(fine)
    assert coarse.grid.shape[0] == 12
    solution = Solution(fine, unloaded(fine), coarser=(coarse, unloaded(coarse)))

    def quantities(level, _):
        return 10 + (12 / level.grid.shape[0]) ** 2, np.zeros((4, 4))

    assert mesh_error.mesh_error(solution, quantities, lambda _: 0).force > 1.0
    assert asked


def test_errors_along_and_across_the_depth_do_not_cancel(monkeypatch):
    monkeypatch.setattr(mesh_error, "solve", solved)
    fine = problem(16, 4)

    def quantities(level, _):
        across, through = 16 / level.grid.shape[1], 4 / level.grid.shape[0]
        return 10 + through - across, np.zeros((4, 4))

    found = mesh_error.mesh_error(Solution(fine, unloaded(fine)), quantities, lambda _: 0)
    assert found.force == pytest.approx(1.25 * 2)


def test_a_layer_that_sticks_is_off_by_what_is_said():
    """Three elements deep, glued to both faces: on one element it could not flow at all."""

    def pressed(depth):
        return computational_stress(
            thickness_map(np.full((31, 31), 0.18), x=AXIS[:31], y=AXIS[:31], where="flat"),
            0.2,
            GEL,
            window_friction="glued",
            sample_friction="glued",
            element_size=(0.06, 0.06, 0.2 / depth),
            threads=1,
            edge_check=False,
            input_errors=None,
        ).maps.attrs

    attrs, fine = pressed(3), pressed(9)
    off = abs(attrs["sample_force_mN"] - fine["sample_force_mN"])
    assert 0.05 * fine["sample_force_mN"] < off < attrs["force_mesh_error_mN"] < 5 * off


@pytest.mark.parametrize("count", [4, 5, 8])
@pytest.mark.parametrize("edge", [None, 0.01, 0.1])
def test_coarse_grids_of_few_elements_are_grids(count, edge):
    nodes = node_positions(2.0, 2.0 / count, edge=edge)
    grid = LayerGrid(nodes, nodes, graded_depths(4), np.full((len(nodes), len(nodes)), 0.4))
    fine = replace(problem(8), grid=grid, edges="roller" if edge is None else "free")
    assert (np.diff(halved(fine, np.array([True, True, True])).grid.x) > 0).all()


def test_coarse_grids_are_coarse_though_most_elements_are_those_of_the_edges():
    nodes = node_positions(2.0, 0.25, edge=0.016)
    assert len(nodes) - 1 == 14
    grid = LayerGrid(nodes, nodes, graded_depths(8), np.full((15, 15), 0.4))
    fine = replace(problem(8), grid=grid, edges="free")
    coarse = halved(fine, np.array([False, True, True]))
    assert np.diff(coarse.grid.x).max() > 1.8 * np.diff(nodes).max()


def test_the_imprint_is_smoothed_where_elements_become_longer_alone():
    fine = problem(16, 8)
    assert halved(fine, np.array([True, False, False])).imprint is fine.imprint
    assert halved(fine, np.array([False, True, True])).imprint is not fine.imprint


def test_free_edges_whose_elements_stay_as_they_are_are_counted():
    fine = problem(16, edges="free")
    solution = Solution(fine, unloaded(fine), coarser=(coarsened(fine), unloaded(fine)))
    found = mesh_error.mesh_error(solution, lambda *_: (100.0, np.zeros((4, 4))), lambda _: 0)
    assert found.force == pytest.approx(0.5)


def test_no_estimate_where_there_is_no_coarser_solution(monkeypatch):
    def quantities(*_):
        raise AssertionError("nothing to compare")

    tiny = problem(3, depth=1)
    lone = Solution(tiny, unloaded(tiny))
    assert mesh_error.mesh_error(lone, quantities, lambda _: 0) is None

    def fails(*_, **__):
        raise LoadNotReached(0.3, "no")

    monkeypatch.setattr(mesh_error, "solve", fails)
    small = problem(8, depth=2)
    assert mesh_error.mesh_error(Solution(small, unloaded(small)), quantities, lambda _: 0) is None
    result = press(0.2)  # a result all the same, which says so
    assert "force_mesh_error_mN" not in result.maps.attrs
    assert "error of the mesh: unknown" in summarise(result)


def test_further_grids_take_no_longer_than_the_solution(monkeypatch):
    given = []

    def slow(level, *_, patience, **__):
        given.append(patience)
        return Solution(level, unloaded(level), effort=Effort(0.75 * patience))

    monkeypatch.setattr(mesh_error, "solve", slow)
    small = problem(8, depth=2)
    for spent, most in ((0.1, 9.0), (20.0, 20.0), (48.0, 6.0), (70.0, 3.0)):
        given.clear()
        solution = Solution(small, unloaded(small), effort=Effort(spent))
        mesh_error.mesh_error(solution, lambda *_: (1.0, np.zeros((4, 4))), lambda _: 0)
        assert given == pytest.approx([most, most / 4])


def test_the_solution_on_finer_elements_lies_within_the_estimate():
    coarse, fine = press(0.125), press(0.0417)
    force, error = (coarse.maps.attrs[f"{key}_mN"] for key in ("sample_force", "force_mesh_error"))
    true = fine.maps.attrs["sample_force_mN"]
    assert 0 < abs(force - true) < error < 0.05 * true
    assert f"error of the mesh, estimated: {error:.2g} mN" in summarise(coarse)
    bound = coarse.maps["axial_stress_mesh_error"]
    assert bound.attrs["units"] == "kPa"
    here = {axis: coarse.maps[axis] for axis in "xy"}
    off = abs(coarse.maps["axial_stress"] - fine.maps["axial_stress"].interp(here))
    known = np.isfinite(off)
    assert (np.isfinite(bound) == np.isfinite(coarse.maps["axial_stress"])).all()
    assert float((off <= bound).sum() / known.sum()) > 0.7
