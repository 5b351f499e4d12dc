"""The solver arrives where load steps alone do not, says how it ended, and passes nothing wrong."""

import re
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import robustness
from optical_palpation.analysis import stress_uncertainty
from optical_palpation.errors import ConvergenceError
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics import path
from optical_palpation.mechanics.cascade import _Nested, make_solver
from optical_palpation.mechanics.iteration import TOLERANCES, NotConverged, relaxed
from optical_palpation.mechanics.newton import LoadedLayer, balance
from optical_palpation.mechanics.schur import Lubrication
from optical_palpation.palpation import computational, computational_stress
from optical_palpation.palpation.computational import residuals
from optical_palpation.present import summarise
from optical_palpation.study import warnings_about
from optical_palpation.thickness import thickness_map

SILICONE = MooneyRivlin(2.23, 0.703)
MU = SILICONE.shear_modulus


AXIS = np.linspace(0, 2, 41)
TILTED = 0.5 - 0.15 * AXIS / 2


def pressed(height, friction, element_size, **options):
    """Press a layer of 0.5 mm down to so many mm."""
    return computational_stress(
        thickness_map(height, x=AXIS, y=AXIS, where="made"),
        0.5,
        SILICONE,
        window_friction=friction,
        sample_friction=friction,
        element_size=element_size,
        edge_check=False,
        input_errors=None,
        **options,
    )


def tilted(friction, element_size=0.25, **options):
    return pressed(np.tile(TILTED, (41, 1)), friction, element_size, **options)


def under_sawteeth(teeth, compression):
    """Press a padded layer without friction by slopes that all rise towards +x."""
    height = 0.5 * (1 - compression * (0.3 + 0.7 * (AXIS / 2 * teeth % 1.0)))
    return pressed(np.tile(height, (41, 1)), 0.0, 0.2, edges="padded")


@pytest.fixture
def loads(monkeypatch):
    """The loads of all equilibria that are reached, as they are."""
    reached = []
    accept = path.Path._accept

    def counted(self, state, iterations):
        reached.append(state.load)
        accept(self, state, iterations)

    monkeypatch.setattr(path.Path, "_accept", counted)
    return reached


def test_a_layer_that_nothing_holds_slides_away_and_is_no_result(loads):
    with pytest.raises(ConvergenceError, match="nothing holds the layer sideways"):
        tilted(0.0)
    assert max(loads, default=0.0) < 0.5  # it has left its field of view long before the full load


def test_a_layer_that_slides_until_its_time_is_up_is_said_to_slide(monkeypatch, loads):
    monkeypatch.setattr(_Nested, "_enough", lambda *given: loads.count(1.0) > 15)
    with pytest.raises(ConvergenceError, match="nothing holds the layer sideways"):
        under_sawteeth(2, 0.1)
    assert 15 < loads.count(1.0) < 20


def test_a_full_load_without_equilibrium_is_not_called_a_part_of_it(monkeypatch):
    def restless(*given, **options):
        raise path.LoadNotReached(1.0, "the layer does not come to rest")

    monkeypatch.setattr(computational, "solve", restless)
    said = "loaded fully, but did not come to equilibrium there: the layer does not come to rest"
    with pytest.raises(ConvergenceError, match=said):
        tilted(0.2)


@pytest.fixture
def finest_stops(monkeypatch):
    """Let no layer reach its load on the finest of several grids."""
    loaded = _Nested._loaded

    def stops(nested, level, carried):
        if carried is not None and level is nested.problem:
            raise path.LoadNotReached(0.7, "the finest stops")
        return loaded(nested, level, carried)

    settled = _Nested._settled

    def restless(nested, level, *given):
        return None if level is nested.problem else settled(nested, level, *given)

    monkeypatch.setattr(_Nested, "_loaded", stops)
    monkeypatch.setattr(_Nested, "_carried_over", lambda *given: None)
    monkeypatch.setattr(_Nested, "_settled", restless)


def test_a_layer_that_arrives_on_coarser_elements_only_is_solved_there_and_says_so(finest_stops):
    result = tilted(0.3, 0.08)
    attrs = result.maps.attrs
    assert attrs["status"] == "converged on coarser elements"
    assert attrs["force_residual"] < attrs["force_tolerance"]
    assert attrs["asked_element_size_mm"] == pytest.approx([0.08, 0.08, 0.08], rel=0.1)
    sizes = attrs["element_size_mm"]
    assert sizes[0] == pytest.approx(0.16, rel=0.1)
    assert np.prod(attrs["elements"]) == result.problem.grid.n_elements
    # the imprint of the asked elements, smoothed again
    assert attrs["imprint_smoothing_mm"] == pytest.approx(np.hypot(0.04, 0.08), rel=0.1)
    said = "solution on elements of .* not of .* the layer was loaded to 70.0 % only: the finest"
    assert re.search(f"WARNING: this is the {said}", summarise(result))
    assert any(re.search(said, text) for text in warnings_about(result))
    asked = tilted(0.3, sizes).maps.attrs
    assert asked["status"] == "converged"
    assert "asked_elements_failure" not in asked
    assert attrs["sample_force_mN"] == pytest.approx(asked["sample_force_mN"], rel=0.02)


def test_coarser_elements_are_neither_the_wanted_accuracy_nor_an_error_of_inputs(finest_stops):
    with pytest.raises(ConvergenceError, match=r"accuracy of 1.00% takes .*the finest stops"):
        tilted(0.3, None, accuracy=0.01)
    loaded = thickness_map(np.tile(TILTED, (41, 1)), x=AXIS, y=AXIS, where="tilted plate")
    friction = {"window_friction": 0.3, "sample_friction": 0.3}
    with pytest.raises(ConvergenceError, match="the finest stops"):
        stress_uncertainty(loaded, 0.5, SILICONE, **friction, element_size=0.08)


@pytest.mark.parametrize(
    ("load", "far", "of", "end"),
    [
        (0.3, "to 30.0 % only", "to 30.0 % of 2 mm only", "stopped at 30.0 % of the load"),
        (0.9996, "to 99.96 % only", "to 99.96 % of 2 mm only", "stopped at 99.96 % of the load"),
        (1 - 2e-6, "to 99.9998 % only", "to 99.9998 % of 2 mm only", "stopped at 99.9998 % of"),
        (
            1.0,
            "fully, but did not come to equilibrium there",
            "by the whole 2 mm, but did not come to equilibrium there",
            "came to the full load, but to no equilibrium there: why",
        ),
    ],
)
def test_a_load_that_is_not_all_of_it_is_not_said_to_be(load, far, of, end):
    failure = path.LoadNotReached(load, "why")
    assert (failure.how_far(), failure.how_far("2 mm")) == (far, of)
    assert str(failure).startswith(end)


def test_a_result_says_how_it_ended():
    result = tilted(0.2)
    attrs = result.maps.attrs
    assert attrs["status"] == "converged"
    now = balance(result.problem, result.state)
    assert attrs["force_residual"] == now.force_error < attrs["force_tolerance"]
    assert attrs["volume_residual"] == now.volume_error < attrs["volume_tolerance"]
    assert 0 < attrs["smallest_volume_ratio"] <= 1
    assert attrs["slip_length_mm"] == pytest.approx(0.001)


@dataclass(frozen=True)
class Touched:
    """A state of which only the load counts."""

    load: float = 0.0

    def at_load(self, load):
        return replace(self, load=load)

    def towards(self, other, load):
        return replace(self, load=load)


class Stays:
    """Does not move sideways."""

    stiffness = 1.0

    def covered(self, state):
        return 1.0

    def remember(self, now):
        return now.state


class TouchesGently(Stays):
    """In equilibrium wherever the first load is small."""

    def __init__(self, largest):
        self.largest, self.tried, self.reached = largest, [], [0.0]

    def equilibrate(self, trial, tolerances, on_iteration, drag):
        self.tried.append((trial.load, drag))
        if len(self.reached) == 1 and trial.load > self.largest:
            raise NotConverged("too far")
        self.reached.append(trial.load)
        return SimpleNamespace(state=trial), 3


def test_before_anything_is_loaded_nothing_snaps():
    """The first load is made smaller, far below the one at which drag takes over later."""
    loaded = TouchesGently(0.003)
    way = path.Path(loaded, TOLERANCES, TOLERANCES, Touched())
    way.follow(Touched(1.0))
    assert way.state.load == 1.0
    assert all(drag is None for _, drag in loaded.tried)
    assert loaded.reached[1] <= 0.003


class Flickers(Stays):
    """Its last iterates flicker about an equilibrium, at a distance ``left``."""

    def __init__(self, left, swollen=0.0):
        self.left, self.swollen, self.drags = left, swollen, 0

    def equilibrate(self, trial, tolerances, on_iteration, drag):
        self.drags += drag is not None and drag.viscosity > 0.0
        if drag is not None or trial.load == 1.0:
            failure = NotConverged("stagnates")
            failure.nearest = self.balance(trial), 9
            raise failure
        return SimpleNamespace(state=trial), 3

    def contact_forces(self, state):
        return []

    def balance(self, state):
        return SimpleNamespace(
            state=state,
            distance=self.left,
            force_error=self.left,
            volume_error=self.swollen,
            volume_distance=self.swollen,
        )


def test_what_flickers_next_to_equilibrium_is_taken_as_it_is():
    """No smaller load and no drag bring nearer what changes for ever at a few nodes."""
    loaded = Flickers(0.5 * path.NEARLY[0])
    way = path.Path(loaded, TOLERANCES, TOLERANCES, Touched())
    way.follow(Touched(1.0))
    assert way.state.load == 1.0
    assert way.record[-1][1] == 9 * 5  # as many solutions as tell that they come no nearer
    assert loaded.drags == 0
    for far in (2.0 * path.NEARLY[0], 0.0), (0.5 * path.NEARLY[0], 20.0 * TOLERANCES.volume):
        loaded = Flickers(*far)
        with pytest.raises(path.LoadNotReached):
            path.Path(loaded, TOLERANCES, TOLERANCES, Touched()).follow(Touched(1.0))
        assert loaded.drags > 0


def egg_box():
    """A layer on hills and valleys, between which it slides and sticks."""
    relief = np.cos(0.5 * np.pi * AXIS) * np.cos(np.pi * AXIS[:, None])
    return pressed(0.35 + 0.07 * relief, 0.5, 0.2)


@pytest.fixture
def refuse(monkeypatch):
    """Let Newton's method fail where a condition holds on its drag and its load."""

    def refused(condition):
        solved, refusals = LoadedLayer.equilibrate, []

        def equilibrate(layer, trial, tolerances, on_iteration, drag):
            if condition(drag, trial.load):
                refusals.append((layer, trial.load))
                raise NotConverged("refused")
            return solved(layer, trial, tolerances, on_iteration, drag)

        monkeypatch.setattr(LoadedLayer, "equilibrate", equilibrate)
        return refusals

    return refused


def test_friction_that_follows_from_solution_to_solution_carries_the_same(refuse):
    """Each load path goes on in that way from the first failure on."""
    alone = egg_box().maps.attrs
    refused = refuse(lambda drag, load: drag is None and load > 0.3)
    other = egg_box().maps.attrs
    layers = [id(layer) for layer, load in refused if load < 1.0]
    assert 0 < len(layers) == len(set(layers))
    assert other["status"] == "converged"
    assert other["force_residual"] < other["force_tolerance"]
    assert other["sample_force_mN"] == pytest.approx(alone["sample_force_mN"], rel=0.01)


def test_drag_all_the_way_leaves_no_slip_behind(refuse, monkeypatch):
    """Where friction is bounded by the contact forces before each step, it carries a third less."""
    alone = egg_box().maps.attrs
    monkeypatch.setattr(path, "SNAPS", 0)  # drag stays
    without = refuse(lambda drag, load: load > 0.2 and not (drag and drag.viscosity))
    dragged = egg_box().maps.attrs
    assert max(load for _, load in without) == 1.0
    assert dragged["sample_force_mN"] == pytest.approx(alone["sample_force_mN"], rel=0.01)


def disturbed(result):
    """The load path of a result, its full load reached, with the inner nodes out of place."""
    problem, start = result.problem, result.state.copy()
    k, j, i = np.indices(problem.grid.node_shape)
    start.u[:, 1:-1] += 0.004 * np.sin(1.3 * k + 0.7 * j + 0.4 * i)[1:-1]
    assert balance(problem, start).force_error > 1e-2
    layer = LoadedLayer(problem, make_solver(problem, "multigrid"))
    return path.Path(layer, TOLERANCES, relaxed(TOLERANCES, 100.0), start)


def test_a_disturbed_layer_comes_back_to_rest():
    """Drag leaves the equilibrium where it was: the result does not depend on it."""
    result = tilted(0.3)
    way = disturbed(result)
    way.settle()
    assert balance(result.problem, way.state).force_error < TOLERANCES.force
    force = result.state.normal_force.sum((1, 2))
    assert_allclose(way.state.normal_force.sum((1, 2)), force, rtol=0.02)
    assert way.record


def test_what_does_not_settle_is_nearly_converged_and_says_so(monkeypatch):
    """Where steps run out near an equilibrium that is a result, and it warns; else it is none."""
    result = tilted(0.3)
    monkeypatch.setattr(path, "_NEAR", 0.0)  # Newton's method without drag would get there
    monkeypatch.setattr(path, "_HELD", 5)
    way = disturbed(result)
    way.settle()
    now = balance(result.problem, way.state)
    assert TOLERANCES.force < now.force_error < 0.02
    assert residuals(now)["status"] == "nearly converged"
    result.maps.attrs.update(residuals(now))
    warning = f"WARNING: nearly converged: .* {100 * now.force_error:.2g} % of the contact forces"
    assert re.search(warning, summarise(result))
    assert any(text.startswith("nearly converged: ") for text in warnings_about(result))
    monkeypatch.setattr(path, "_HELD", 1)
    with pytest.raises(path.LoadNotReached, match="does not come to rest"):
        disturbed(result).settle()


@pytest.mark.parametrize(
    ("shape", "said"), [("whole", "nothing holds the layer sideways"), ("rim", "stagnates")]
)
def test_what_moves_as_a_whole_until_steps_fail_is_said_to_slide(monkeypatch, shape, said):
    result = tilted(0.3)
    moves = np.zeros_like(result.state.u)
    moves[0, ..., slice(None) if shape == "whole" else 0] = 0.01
    steps = iter(range(path._SLIDING + 2))

    def reach(way, trial, wanted, drag=None):
        if drag is None or next(steps, None) is None:
            raise NotConverged("Newton's method stagnates")
        return balance(result.problem, replace(trial, u=trial.u + moves)), 9

    monkeypatch.setattr(path.Path, "_reach", reach)
    with pytest.raises(path.LoadNotReached, match=said):
        disturbed(result).settle()


@pytest.mark.parametrize(
    ("slope", "left"), [(-3.0, 0.0), (-1.0, 0.0), (0.4, 0.0), (0.9, 0.95 * 0.8**3)]
)
def test_the_bound_of_friction_arrives_where_it_would_swing_or_creep(slope, left):
    """Contact forces that answer to their bound by a slope.

    By half of each change, -3 swings for ever and 0.9 leaves 0.95 a step; by twice of it 0.8.
    """
    bound = path.Bound([np.zeros(2)], 0.5)
    for _ in range(4):
        bound.follow([1.0 + slope * (bound.forces[0] - 1.0)])
    assert_allclose(1.0 - bound.forces[0], left, atol=1e-12)


def test_what_leaves_an_unstable_equilibrium_is_let_go():
    """A change that grows from step to step is followed as far as may be."""
    bound = path.Bound([np.ones(3)], 0.5)
    for change in (1.0, 1.2):
        bound.follow([bound.forces[0] + change])
    assert_allclose(bound.forces[0], 1.0 + 0.5 * 1.0 + 2.0 * 1.2)
    bound.follow([bound.forces[0] + 1.4], most=1.0)
    assert bound.part == 1.0


def test_glue_that_is_pulled_bounds_no_friction():
    """Else bound and forces would never agree, and no load would be reached in this way."""
    bound = path.Bound([np.array([1.0, 0.0])])
    pulled = [np.array([1.0, -2.0])]
    assert bound.apart(pulled) == 0.0
    bound.follow(pulled)
    assert_allclose(bound.forces, [[1.0, 0.0]])


@pytest.mark.slow
def test_a_thin_layer_that_sticks_arrives():
    """A layer 18 thicknesses wide, pressed by 45 % at friction 0.95 and 0.56, between rollers."""
    case = replace(robustness.random_case(34), estimates=False, element_size=(0.143, 0.147, 0.103))
    outcome = robustness.attempt(case, limit=1800)
    assert outcome.kind == "converged", outcome.text
    assert outcome.newton < 160


@pytest.mark.parametrize(
    ("window", "sample", "factor"), [(1e9, 1e9, 12.0), (1e9, 0.0, 3.0), (0.0, 1e9, 3.0)]
)
def test_pressure_in_a_film_is_that_of_the_lubrication_equation(window, sample, factor):
    """-h^2 / (12 mu) p'' = 1 between two faces that stick, a quarter of that p at one."""
    n, width, h = 120, 6.0, 0.5
    x = np.linspace(0, width, n + 1)
    y = np.linspace(0, 40 * width, 5)  # so long that nothing leaves through its ends
    film = Lubrication(np.linspace(0, h, 3), y, x, True, MU)
    shape = 4, n
    stiffness = np.empty((2, 2, *shape))
    stiffness[0], stiffness[1] = window, sample
    film.prepare(stiffness, np.ones((2, *shape)), 1e12)
    area = np.diff(y)[:, None] * np.diff(x)
    pressure = film.solve(np.stack([0.5 * h * area] * 2))  # a unit of strain in each element
    centres = 0.5 * (x[1:] + x[:-1])
    expected = factor * MU / h**2 * centres * (width - centres) / 2
    inner = slice(4, -4)  # what interpolates the cells is level in their outer halves
    assert_allclose(pressure[1, inner], expected[inner], atol=0.02 * expected.max())


def test_no_friction_leaves_lubrication_nothing_to_say():
    """A film that slides on both faces gives way as its length allows: far less than the layer."""
    x = np.linspace(0, 5, 41)
    film = Lubrication(np.linspace(0, 0.5, 3), x, x, True, MU)
    film.prepare(np.zeros((2, 2, 40, 40)), np.ones((2, 40, 40)), 1e12)
    area = np.diff(x)[:, None] * np.diff(x)
    pressure = film.solve(np.stack([0.25 * area] * 2))
    assert np.abs(pressure).max() < 0.2 * MU
