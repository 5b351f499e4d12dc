"""A few columns that are out of balance are brought into equilibrium alone, the others held."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics import newton
from optical_palpation.mechanics.cascade import make_solver, solve
from optical_palpation.mechanics.direct import DirectSolver
from optical_palpation.mechanics.elimination import (
    at_free_side,
    cut_out,
    put_back,
    unbalanced_columns,
)
from optical_palpation.mechanics.grid import LayerGrid, node_positions
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.iteration import TOLERANCES, NotConverged, Tolerances
from optical_palpation.mechanics.newton import balance, equilibrate
from optical_palpation.mechanics.path import Drag
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.mechanics.system import assemble
from optical_palpation.palpation.meshing import expected_forces

LAW = MooneyRivlin(2.23, 0.703)


def layer(**options):
    x = node_positions(2.0, 0.16, edge=0.04)
    y = node_positions(1.6, 0.16, edge=0.04)
    px = np.linspace(-1, 3, 41)
    relief = 0.4 + 0.03 * np.cos(2 * px) * np.cos(px)[:, None]
    grid = LayerGrid(x, y, np.linspace(0, 1, 4), np.full((y.size, x.size), 0.5))
    imprint = Imprint(px, px, np.full((41, 41), 0.5), relief)
    return LayerProblem(grid, imprint, LAW, (0.4, 0.2), **options)


def shaken(problem, seed=5):
    """A state far from any equilibrium, in contact here and there, sliding and turned round."""
    rng = np.random.default_rng(seed)
    state = LayerState.unloaded(problem.grid)
    state.load = 1.0
    state.u = rng.normal(0, 0.01, state.u.shape)
    state.u[2] -= 0.2 * problem.grid.nodes[2]
    state.p = rng.normal(-5.0, 5.0, state.p.shape)
    state.slip = rng.normal(0, 1.0, state.slip.shape)
    state.anchor = state.lateral() - rng.normal(0, 1e-3, state.anchor.shape)
    state.normal_force = rng.uniform(0, 0.5, state.normal_force.shape)
    return state


BOXES = [
    (slice(0, 7), slice(0, 6)),
    (slice(4, 9), slice(3, 12)),
    (slice(5, None), slice(0, None)),
]


def test_resultant_error_is_what_a_force_changes_the_whole_by(solved):
    """By its share of the whole force where it acts at one node; too much of it never will do."""
    problem, state = solved.problem, solved.state
    whole = state.normal_force[1].sum()
    average = state.normal_force[1].mean()

    def pushed(extra):
        state_pushed = state.copy()
        state_pushed.normal_force[0, 4, 7] += extra
        return balance(problem, state_pushed)

    for share in (0.3, 0.6):
        now = pushed(share * average)
        # in the residual and, as it is more than contact there asks for, in the law of contact
        held = now.residual(problem)[2, 0, 4, 7], now.contact.violation[0, 4, 7]
        assert_allclose(held[0], -share * average, rtol=1e-2)
        assert_allclose(now.resultant_error, np.linalg.norm(held) / whole, rtol=0.1)
        assert now.force_error > 3 * now.resultant_error
    assert pushed(1.1 * average).resultant_error == np.inf


def test_distance_counts_what_snaps_on_fine_grids_by_what_it_changes_the_whole_by(
    solved, monkeypatch
):
    state = solved.state.copy()
    average = state.normal_force[1].mean()
    for share in (0.5, 1.1):  # that much on a node: it may be left there, and not
        state.normal_force[0, 4, 7] += share * average
        now = balance(solved.problem, state)
        assert now.distance == now.force_error
        with monkeypatch.context() as patch:
            patch.setattr(newton, "FINE", solved.problem.grid.n_elements - 1)
            fine = balance(solved.problem, state).distance
        assert fine == (now.resultant_error if share < 1 else now.force_error)


def test_a_crushed_element_counts_on_fine_grids_by_its_share_of_the_layer(solved, monkeypatch):
    """Not so where the whole layer has too little volume."""
    problem = solved.problem

    def off(elements):
        state = solved.state.copy()
        state.p[elements] -= 1e-3 * problem.bulk_modulus
        now = balance(problem, state)
        assert now.volume_distance == now.volume_error
        with monkeypatch.context() as changes:
            changes.setattr(newton, "FINE", 0)
            return now.volume_error, balance(problem, state).volume_distance

    count = solved.state.p.size
    assert_allclose(off((1, 2, 3)), [1e-3 / np.sqrt(count), 1e-3 / count], rtol=1e-2)
    assert_allclose(off(...), 1e-3, rtol=1e-2)


@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize(
    "options", [{}, {"edges": "roller"}, {"mirrors": (True, False, True, False)}]
)
def test_a_part_is_in_balance_where_the_whole_is(box, options):
    """The forces out of balance at columns that are not held are those of the whole layer."""
    problem = layer(**options)
    shape = problem.grid.node_shape[1:]
    box = tuple(slice(*along.indices(n)[:2]) for along, n in zip(box, shape, strict=True))
    state = shaken(problem)
    origin = shaken(problem, 6)
    bound = list(np.random.default_rng(2).uniform(0, 0.3, (2, *shape)))
    drag = Drag(300.0, origin, bound)
    own, cut = cut_out(problem, state, box)
    free = np.ones(own.grid.node_shape[1:], bool)
    if own.held_columns is not None:
        free &= ~own.held_columns
    dragged = Drag(300.0, cut_out(problem, origin, box)[1], [b[box] for b in bound])
    for whole, local in (
        (balance(problem, state), balance(own, cut)),
        (balance(problem, state, drag), balance(own, cut, dragged)),
    ):
        expected = whole.residual(problem)[:, :, *box][..., free]
        assert np.abs(expected).max() > 0.1
        assert_allclose(local.residual(own)[..., free], expected, atol=1e-10)
        violation = whole.contact.violation[:, *box][..., free]
        assert_allclose(local.contact.violation[..., free], violation, atol=1e-10)
        assert not local.residual(own)[..., ~free].any()


def test_what_is_put_back_unsolved_changes_nothing():
    problem = layer()
    state = shaken(problem)
    box = slice(2, 8), slice(0, 7)
    own, cut = cut_out(problem, state, box)
    again = put_back(state, [(box, own, cut)])
    for name in ("u", "p", "normal_force", "slip", "anchor"):
        assert_array_equal(getattr(again, name), getattr(state, name))
    cut.u += 1.0
    cut.normal_force += 1.0
    changed = (put_back(state, [(box, own, cut)]).u != state.u).all((0, 1))
    expected = np.zeros_like(changed)
    expected[3:7, :6] = (
        True  # the outermost columns are held, but for those of the layer's own side
    )
    assert_array_equal(changed, expected)


def test_boxes_hold_what_is_out_of_balance_and_share_none_but_held_columns():
    imbalance = np.full((40, 50), 1e-6)
    imbalance[3, 4], imbalance[6, 10], imbalance[30, 49] = 1.0, 0.7, 0.5
    boxes = unbalanced_columns(imbalance, 3, 0.35, 0.9)
    assert boxes == [(slice(0, 11), slice(0, 15)), (slice(26, 35), slice(45, 50))]
    assert unbalanced_columns(imbalance, 3, 0.35, 0.7) == boxes[:1]
    assert unbalanced_columns(imbalance, 1, 0.35, 0.9)[:2] == [
        (slice(1, 6), slice(2, 7)),
        (slice(4, 9), slice(8, 13)),
    ]
    assert unbalanced_columns(np.ones((40, 50)), 3, 0.35, 0.9) == []


#: So that two ways to an equilibrium can be told apart by less than they are let to differ.
EXACT = Tolerances(force=1e-6, volume=1e-6)


@pytest.fixture(scope="module")
def solved():
    problem = layer()
    return solve(problem, lambda level: expected_forces(level, LAW), tolerances=EXACT)


def disturbed(solved, width=3):
    """The layer in equilibrium, but for a corner that is out of place."""
    state = solved.state.copy()
    state.u[:, :, :width, :width] += np.random.default_rng(1).normal(0, 0.012, (3, 4, width, width))
    return state


def test_a_disturbed_corner_is_brought_back_by_itself(solved, monkeypatch):
    """To the equilibrium where it was, and sooner than by steps of the whole layer alone."""
    problem = solved.problem
    solver = make_solver(problem, "multigrid")
    start = disturbed(solved)
    assert balance(problem, start).force_error > 0.05

    def iterations(eliminate):
        now, count = equilibrate(problem, start, solver, EXACT, eliminate=eliminate)
        assert_allclose(now.state.u, solved.state.u, atol=2e-5)
        return count

    # from the first iteration on, not only where Newton's method is slow
    at_once = replace(newton.SLOW, first=2, last=1, left=0.0)
    assert iterations(at_once) < iterations(None)


def test_what_a_part_adds_is_told_by_its_own_columns(solved):
    """As the balances of the whole layer, with drag and without, tell it."""
    problem, start = solved.problem, disturbed(solved)
    bound = [0.5 * force for force in start.normal_force]
    for box in ((slice(0, 8), slice(0, 8)), (slice(3, 9), slice(2, 7))):
        own, cut = cut_out(problem, start, box)
        cut.u[..., ~own.held_columns] += 1e-3
        part = box, own, cut
        for drag in (None, Drag(300.0, solved.state, bound)):
            columns = newton._Elimination(problem, TOLERANCES, drag, newton.SLOW)
            before, after = (
                balance(problem, state, drag).imbalance
                for state in (start, put_back(start, [part]))
            )
            assert columns._added(start, part) == pytest.approx(after**2 - before**2, rel=1e-6)


def test_columns_at_a_cut_a_mirror_or_a_roller_are_not_at_a_free_side():
    problem = layer()
    _, ny, nx = problem.grid.node_shape
    inside, corner = (slice(2, 6), slice(2, 6)), (slice(0, 6), slice(2, 6))
    assert not at_free_side(problem, inside)
    for sides, free in (({}, True), ({"held": (True, False, False, False)}, False)):
        assert at_free_side(layer(**sides), corner) == free
    assert not at_free_side(layer(mirrors=(True, False, False, False)), corner)
    assert not at_free_side(replace(problem, edges="roller"), corner)
    assert at_free_side(problem, (slice(ny - 3, ny), slice(nx - 3, nx)))


def test_held_columns_stay_where_they_are(solved):
    problem, start = solved.problem, disturbed(solved)
    box = slice(0, 8), slice(0, 8)
    own, cut = cut_out(problem, start, box)
    solver = make_solver(own, "multigrid")
    now, _ = equilibrate(own, cut, solver, TOLERANCES)
    held = own.held_columns
    assert held is not None
    assert_array_equal(now.state.u[..., held], cut.u[..., held])
    assert_array_equal(now.state.normal_force[..., held], cut.normal_force[..., held])
    after = put_back(start, [(box, own, now.state)])
    assert balance(problem, after).imbalance < 0.1 * balance(problem, start).imbalance


def test_an_eased_tangent_differs_near_free_sides_alone():
    """There by what the pressure adds to it: of a layer without pressure, not at all."""
    problem = layer(held=(False, True, False, False), mirrors=(False, False, True, False))
    state = shaken(problem)

    def difference(state):
        now = balance(problem, state)
        plain, eased = (DirectSolver(problem.grid.node_shape, 0.0) for _ in range(2))
        assemble(problem, now, plain)
        assemble(problem, now, eased, eased=True)
        return np.abs(eased.stencil - plain.stencil).max((0, 2, 3))

    changed = difference(state) > 0
    ny, nx = changed.shape
    # the nodes of the four columns of elements at each side that is neither held nor mirrored
    expected = np.zeros((ny, nx), bool)
    expected[:5] = expected[:, -5:] = True
    expected[-1] = False  # held
    assert_array_equal(changed, expected)
    assert not difference(replace(state, p=0 * state.p)).any()


def test_eased_steps_lead_to_the_same_equilibrium(solved, monkeypatch):
    """Once a linear system takes many iterations, here any, and by other steps."""
    problem, start = solved.problem, disturbed(solved)
    solver = make_solver(problem, "multigrid")
    monkeypatch.setattr(newton, "_ROUGH", 1)
    used = []

    def watched(*arguments):
        used.append(arguments[-1])
        return assemble(*arguments)

    monkeypatch.setattr(newton, "assemble", watched)
    for eases in (False, True):
        used.clear()
        now, count = equilibrate(problem, start, solver, EXACT, eases=eases)
        assert_allclose(now.state.u, solved.state.u, atol=2e-5)
        assert used == [False, *[eases] * (count - 1)]


def test_columns_that_newtons_method_does_not_solve_are_left_nearer_to_equilibrium(solved):
    """On a fine grid, where the whole layer could hardly do it; where the load is followed, not."""
    problem, start = solved.problem, disturbed(solved)
    box = slice(0, 8), slice(0, 8)
    now = balance(problem, start)

    def left(due):
        few = replace(TOLERANCES, iterations=2)
        columns = newton._Elimination(problem, few, None, due)
        return columns._solved(start, box, now.imbalance / now.force_error)

    assert left(newton.SLOW) is None
    after = balance(problem, put_back(start, [left(newton.CARRIED)]))
    assert 10 * TOLERANCES.force < after.force_error < 0.5 * now.force_error


def test_columns_without_an_equilibrium_are_left_to_the_whole_layer(solved, monkeypatch):
    """Nothing changes where the part alone does not converge."""
    problem, start = solved.problem, disturbed(solved)
    at_once = replace(newton.SLOW, first=2, last=1, left=0.0)
    plain, count = equilibrate(problem, start, make_solver(problem, "multigrid"), TOLERANCES)
    few = replace(TOLERANCES, iterations=count)

    whole = newton.iterate

    def only_the_whole(now, *others):
        if now.force.shape != start.u.shape:
            raise NotConverged("not here")
        return whole(now, *others)

    monkeypatch.setattr(newton, "iterate", only_the_whole)
    solver = make_solver(problem, "multigrid")
    now, again = equilibrate(problem, start, solver, few, eliminate=at_once)
    assert again == count
    assert_array_equal(now.state.u, plain.state.u)
