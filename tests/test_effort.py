"""A layer that takes too long is given up, after the same steps on every machine."""

import pytest

from optical_palpation.errors import ConvergenceError
from optical_palpation.mechanics import cascade
from optical_palpation.mechanics.effort import counted, spend
from optical_palpation.mechanics.path import TOO_LONG, LoadNotReached
from optical_palpation.palpation import computational_stress
from optical_palpation.palpation.sensitivity import changes
from tilted_case import GIVEN, SILICONE, bound, problem, tilted

SHAPE = 5, 10, 20


def solved(layer, **options):
    return cascade.solve(layer, bound, **options)


def spent(layer, **options):
    return solved(layer, **options).effort.spent


def test_steps_are_counted_within_and_nowhere_else():
    spend(SHAPE, 10, 0.0)
    with counted() as outer:
        spend(SHAPE, 10, 0.0)
        before = outer.spent
        with counted() as inner:
            spend(SHAPE, 20, 0.0)
        assert outer.spent == before > 0
        assert inner.spent > before
        spend(SHAPE, 0, 1e9)
        assert outer.spent > 2 * before


def test_effort_grows_with_the_elements_and_not_with_the_machine():
    small = spent(problem())
    assert small == spent(problem())
    assert spent(problem(size=0.125), solver="direct") > spent(problem(), solver="direct") > 0
    assert spent(problem(size=0.125)) > small


def test_neighbours_do_not_count():
    """They must not keep a layer from arriving."""
    beside = changes(problem())
    assert spent(problem(), neighbours=beside) == spent(problem())
    assert len(beside.states) == 6
    assert not beside.failure


def test_a_layer_that_takes_too_long_is_given_up(monkeypatch):
    whole = spent(problem())
    monkeypatch.setattr(cascade, "_PATIENCE", 0.5 * whole)
    with pytest.raises(LoadNotReached, match=TOO_LONG) as stopped:
        solved(problem())
    assert 0 < stopped.value.load < 1
    with pytest.raises(ConvergenceError, match=r"loaded to .* % only: it took too long"):
        computational_stress(tilted(), 0.5, SILICONE, **GIVEN)
    # the reference takes its time, and as large a layer as this one has more of it
    assert solved(problem(), solver="direct").state.load == 1.0
    monkeypatch.setattr(cascade, "_PATIENT", problem().grid.n_elements / 10)
    assert solved(problem()).state.load == 1.0


def test_patience_may_be_given_and_edges_kept(monkeypatch):
    """As for the grids that a solution is compared with."""
    whole = spent(problem())
    assert spent(problem(), patience=4 * whole) == whole
    with pytest.raises(LoadNotReached, match=TOO_LONG):
        solved(problem(), patience=0.5 * whole)
    tried = []
    wider = cascade._Nested._by_wider_edges
    monkeypatch.setattr(cascade._Nested, "_by_wider_edges", lambda n: tried.append(1) or wider(n))
    for other_edges in (False, True):
        tried.clear()
        with pytest.raises(LoadNotReached):
            solved(problem(), patience=0.1 * whole, other_edges=other_edges)
        assert bool(tried) == other_edges


def test_edges_become_narrower_while_there_is_time(monkeypatch):
    """The layer arrives with coarse edges, and narrow ones are given up at once."""
    loaded = cascade._Nested._loaded

    def stop(nested, level, carried):
        if level is layer and not nested.narrows:
            raise LoadNotReached(0.7, "the rim snaps")
        return loaded(nested, level, carried)

    layer = problem()
    monkeypatch.setattr(cascade._Nested, "_loaded", stop)
    monkeypatch.setattr(cascade._Nested, "_carried_over", lambda *_: None)
    solution = solved(layer)
    assert solution.problem is layer
    assert solution.wider is not None
    coarse = spent(cascade.with_edges(layer, None))
    monkeypatch.setattr(cascade, "_PATIENCE", coarse + 1e-6)
    with pytest.raises(cascade.OnlyOnCoarser, match=TOO_LONG) as stopped:
        solved(layer)
    assert stopped.value.at_edges
    assert stopped.value.solution.problem.grid.edge_widths[0] > 0.2


def test_a_failure_says_how_far_the_layer_came_with_any_edges(monkeypatch):
    def stop(nested, level, carried):
        narrow = cascade._narrow_edges(level)
        raise LoadNotReached(*((0.4, "the rim snaps") if narrow else (1.0, "it rolls")))

    monkeypatch.setattr(cascade._Nested, "_loaded", stop)
    with pytest.raises(LoadNotReached, match="full load, but to no equilibrium there: it rolls"):
        solved(problem())


def test_what_there_is_on_coarser_elements_with_coarse_edges_is_better_than_nothing(monkeypatch):
    fine = problem(size=0.06)
    loaded = cascade._Nested._loaded

    def stop(nested, level, carried):
        if cascade._narrow_edges(level) or level is nested.problem:
            raise LoadNotReached(0.7, "the rim snaps")
        return loaded(nested, level, carried)

    monkeypatch.setattr(cascade._Nested, "_loaded", stop)
    for method in ("_carried_over", "_settled"):
        found = getattr(cascade._Nested, method)

        def not_on_the_finest(nested, level, *given, found=found):
            finest = cascade._narrow_edges(level) or level is nested.problem
            return None if finest else found(nested, level, *given)

        monkeypatch.setattr(cascade._Nested, method, not_on_the_finest)
    monkeypatch.setattr(cascade, "_PATH_ELEMENTS", (300, 16000))
    with pytest.raises(cascade.OnlyOnCoarser, match="the rim snaps") as stopped:
        solved(fine)
    assert not stopped.value.at_edges
    solution = stopped.value.solution
    assert solution.state.load == 1.0
    assert not cascade._narrow_edges(solution.problem)
    assert solution.problem.grid.n_elements < fine.grid.n_elements / 2


def test_a_coarse_grid_that_took_all_the_time_says_how_far_it_came(monkeypatch):
    """The finest grid is not begun then, and so does not count as loaded to nothing."""
    begun = []

    def stop(nested, level, carried):
        begun.append(level.grid.n_elements)
        nested.effort.spent = 2 * nested.patience
        raise LoadNotReached(0.9, TOO_LONG)

    monkeypatch.setattr(cascade._Nested, "_loaded", stop)
    monkeypatch.setattr(cascade, "_PATH_ELEMENTS", (100, 16000))
    layer = problem("padded", size=0.125)
    with pytest.raises(LoadNotReached, match=r"90\.0 % of the load"):
        solved(layer)
    assert begun[0] < layer.grid.n_elements
    assert layer.grid.n_elements not in begun


def test_a_coarse_grid_without_narrow_edges_may_take_as_many_iterations_as_the_finest(monkeypatch):
    allowed = {}

    class Noted(cascade.Path):
        def follow(self, *given, **more):
            grid = self.loaded.problem.grid
            allowed[grid.n_elements] = self.allowed
            return super().follow(*given, **more)

    monkeypatch.setattr(cascade, "Path", Noted)
    monkeypatch.setattr(cascade, "_PATH_ELEMENTS", (100, 16000))
    for edges, most in (("free", cascade.FOLLOWED), ("padded", cascade._ITERATIONS)):
        allowed.clear()
        layer = problem(edges, size=0.125)
        solved(layer)
        coarse = min(allowed)
        assert coarse < layer.grid.n_elements
        assert allowed[coarse] == most
