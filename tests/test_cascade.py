"""From grid to grid."""

from itertools import pairwise
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics import cascade
from optical_palpation.mechanics.cascade import OnlyOnCoarser, grids, solve
from optical_palpation.mechanics.grid import (
    EDGE,
    LayerGrid,
    depth_positions,
    edge_width,
    graded_depths,
    node_positions,
)
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.iteration import NotConverged
from optical_palpation.mechanics.path import NEARLY
from optical_palpation.mechanics.problem import LayerProblem
from optical_palpation.palpation import computational_stress
from optical_palpation.palpation.meshing import expected_forces, layer_problem
from optical_palpation.thickness import thickness_map


def grid(count, depth, grading, edge):
    nodes = node_positions(2.0, 2.0 / count, edge=edge)
    thickness = np.full((len(nodes), len(nodes)), 0.5)
    return LayerGrid(nodes, nodes, graded_depths(depth, grading), thickness)


@given(
    counts=st.tuples(st.integers(5, 9), st.integers(8, 20)),
    depths=st.tuples(st.integers(2, 4), st.integers(3, 9)),
    slopes=st.tuples(*[st.floats(-1, 1) for _ in range(3)]),
)
@settings(max_examples=30, deadline=None)
def test_interpolation_keeps_a_homogeneous_deformation(counts, depths, slopes):
    coarse, fine = grid(counts[0], depths[0], 1.2, 0.02), grid(counts[1], depths[1], 1.0, 0.05)

    def field(of):
        return sum(s * x for s, x in zip(slopes, of.nodes, strict=True))

    assert_allclose(fine.interpolate_from(coarse, field(coarse)), field(fine), atol=1e-12)


@given(size=st.floats(0.004, 0.3), edge=st.floats(0.004, 0.1))
@settings(max_examples=200, deadline=None)
def test_rim_elements_have_the_width_of_the_edge_however_fine_the_others(size, edge):
    nodes = node_positions(2.0, size, 1.0, edge=edge)
    widths = np.diff(nodes)
    assert nodes[0] == 1.0
    assert nodes[-1] == pytest.approx(3.0)
    assert_allclose(widths, widths[::-1], rtol=1e-9)
    if not 0.95 < edge / size < 1.05:
        assert widths[0] == pytest.approx(edge)
    assert widths.max() <= max(1.5 * size, 1.001 * edge)


@pytest.mark.parametrize("size", [0.3, 0.04, 0.03, 0.004])
def test_elements_at_the_window_of_free_edges_are_no_flatter_than_those_of_the_rim(size):
    free, confined = depth_positions(size, True), depth_positions(size, False)
    assert free[0] == confined[0] == 0
    assert free[-1] == confined[-1] == pytest.approx(1)
    assert free[1] >= EDGE * (1 - 1e-9)
    assert confined[1] == pytest.approx(1 / round(1 / size))
    assert np.diff(free)[1:] == pytest.approx(size, rel=0.2)


@given(
    count=st.integers(12, 400),
    depth=st.integers(1, 30),
    field=st.floats(0.5, 20),
    edges=st.sampled_from(["free", "roller"]),
)
@settings(max_examples=60, deadline=None)
def test_every_grid_leads_down_to_a_small_one(count, depth, field, edges):
    nodes = node_positions(field, field / count)
    layer = LayerGrid(nodes, nodes, graded_depths(depth), np.full((count + 1, count + 1), 0.5))
    pixels = np.linspace(0, field, 9)
    flat = np.full((9, 9), 0.5)
    imprint = Imprint(pixels, pixels, flat, 0.9 * flat)
    problem = LayerProblem(layer, imprint, MooneyRivlin(2.2, 0.7), (0.1, 0.1), edges=edges)
    levels = grids(problem)
    counts = [level.grid.n_elements for level in levels]
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] <= 16000 or min(levels[-1].grid.shape[1:]) < 12
    for level in levels:
        assert np.all(np.diff(level.grid.x) > 0)
        assert_allclose(level.grid.x[[0, -1]], [0, field], atol=1e-12)
        assert_allclose(level.grid.thickness, 0.5)


@given(count=st.integers(2, 20), long=st.floats(1, 5), deep=st.integers(1, 8))
@settings(max_examples=60, deadline=None)
def test_grids_of_which_most_elements_are_at_free_edges_end(count, long, deep):
    field, thickness = 4.5, 0.14
    depth = depth_positions(1 / deep, True)
    edge = edge_width(depth, thickness)
    x = node_positions(field, field / count, edge=edge)
    y = node_positions(long * field, field / count, edge=edge)
    layer = LayerGrid(x, y, depth, np.full((len(y), len(x)), thickness))
    flat = np.full((9, 9), thickness)
    imprint = Imprint(np.linspace(0, field, 9), np.linspace(0, long * field, 9), flat, 0.9 * flat)
    problem = LayerProblem(layer, imprint, MooneyRivlin(2.2, 0.7), (0.1, 0.1))
    with mock.patch.object(cascade, "_PATH_ELEMENTS", (100, 16000)):
        counts = [level.grid.n_elements for level in grids(problem)]
    assert all(fewer < 0.6 * many for many, fewer in pairwise(counts))


def test_interpolation_is_smoother_than_straight_lines():
    coarse, fine = grid(12, 3, 1.0, None), grid(48, 3, 1.0, None)

    def field(of):
        return np.sin(3 * of.nodes[0]) * of.nodes[2]

    inside = slice(8, -8)  # four-point differences are one-sided at the ends
    error = (fine.interpolate_from(coarse, field(coarse)) - field(fine))[:, inside, inside]
    straight = [np.interp(fine.x, coarse.x, line) for line in field(coarse)[:, 0]]
    kinked = (np.array(straight) - field(fine)[:, 0])[:, inside]
    assert np.abs(error).max() < 0.3 * np.abs(kinked).max()


def test_elements_finer_than_the_rim_agree_with_coarser_ones():
    x = np.linspace(0, 1.5, 41)
    height = 0.44 - 0.05 * np.exp(-((x - 0.8) ** 2 + (x[:, None] - 0.7) ** 2) / 0.1)
    bump = xr.DataArray(height, {"y": x, "x": x}, ("y", "x"), attrs={"units": "mm"})

    def force(depth):
        result = computational_stress(
            bump,
            0.5,
            MooneyRivlin(c10=2.23, c01=0.703),
            window_friction=0.2,
            sample_friction=0.1,
            element_size=(0.05, 0.05, depth),
            imprint_smoothing=0.03,
            edge_check=False,
            input_errors=None,
        )
        return result.maps.attrs["sample_force_mN"]

    assert force(0.025) == pytest.approx(force(0.05), rel=0.03)


LAW = MooneyRivlin(c10=2.23, c01=0.703)


def wavy(size=0.16, friction=(0.3, 0.2)):
    x = np.linspace(0, 4, 81)
    waves = thickness_map(0.37 + 0.04 * np.cos(3 * x) * np.cos(2.4 * x[:, None] + 0.5), x=x, y=x)
    held = dict(zip(("window", "sample"), friction, strict=True))
    sizes = (size, size, 0.125)
    return layer_problem(waves, 0.5 + 0 * waves, None, LAW, held, sizes, "free", 0.08, 1e-3)


def loads_on_the_finest(problem, solution):
    return [load for count, load, _ in solution.record if count == problem.grid.n_elements]


@pytest.mark.parametrize(("left", "taken"), [(0.5, True), (1.5, False)])
def test_a_huge_layer_is_taken_as_it_is_where_little_is_left(monkeypatch, left, taken):
    """The load path on that grid would take hours."""
    problem, solved = wavy(friction=(0.05, 0.05)), cascade.equilibrate

    def nearly(*arguments, **options):
        now, count = solved(*arguments, **options)
        failure = NotConverged("flickers")
        nearest = SimpleNamespace(state=now.state, distance=left * NEARLY[1], volume_distance=0.0)
        failure.nearest = nearest, count
        raise failure

    monkeypatch.setattr(cascade, "equilibrate", nearly)
    monkeypatch.setattr(cascade, "FINE", 3000)
    monkeypatch.setattr(cascade, "_HUGE", 3000)
    solution = solve(problem, lambda level: expected_forces(level, LAW))
    assert (loads_on_the_finest(problem, solution) == [1.0]) == taken


def test_what_cannot_be_carried_over_is_given_up_before_long(monkeypatch):
    """In favour of the solution on coarser elements."""
    problem = wavy()
    assert problem.grid.n_elements > 3000
    monkeypatch.setattr(cascade, "FINE", 3000)
    monkeypatch.setattr(cascade, "_FAR", 0.0)
    monkeypatch.setattr(cascade, "_PATIENCE", 0.0)
    monkeypatch.setattr(cascade, "_AGAIN", 1.2)
    with pytest.raises(OnlyOnCoarser) as stopped:
        solve(problem, lambda level: expected_forces(level, LAW), patience=50.0, other_edges=False)
    assert stopped.value.solution.problem.grid.n_elements < 3000
    monkeypatch.setattr(cascade, "_AGAIN", np.inf)
    solution = solve(problem, lambda level: expected_forces(level, LAW), patience=50.0)
    assert solution.problem is problem


def test_what_is_too_far_at_full_load_is_carried_over_before_that(monkeypatch):
    """Rough faces: the friction of a layer carried over at full load would be another one."""
    problem = wavy(size=0.155)

    def solved(**options):
        solution = solve(problem, lambda level: expected_forces(level, LAW), **options)
        return solution.state.normal_force[1].sum(), loads_on_the_finest(problem, solution)

    followed, _ = solved(cascade=False)
    monkeypatch.setattr(cascade, "FINE", 3000)
    force, loads = solved()
    assert 0.3 < loads[0] < 0.9
    assert force == pytest.approx(followed, rel=7e-3)
    monkeypatch.setattr(cascade, "_FAR", np.inf)
    force, loads = solved()
    assert loads == [1.0]
    assert force != pytest.approx(followed, rel=1.5e-2)
