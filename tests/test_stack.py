"""The linear solver of two bodies in contact, on the systems of small virtual experiments."""

from dataclasses import replace

import numpy as np
import pytest

from optical_palpation.experiment import Scene
from optical_palpation.experiment.assembly import build
from optical_palpation.mechanics import side_contact
from optical_palpation.mechanics.friction import look_ahead
from optical_palpation.mechanics.iteration import TOLERANCES, relaxed
from optical_palpation.mechanics.path import Drag, Path
from optical_palpation.mechanics.stack import contact, linear, newton
from optical_palpation.mechanics.stack.cascade import solve
from optical_palpation.mechanics.stack.newton import balance, make_solver, newton_step
from optical_palpation.mechanics.stack.problem import INTERFACE, LAYER

SCENE = {
    "compression": 0.2,
    "layer": {"size": (1.5, 1.5), "thickness": 0.5},
    "sample": {
        "size": (1.5, 1.5),
        "thickness": 0.8,
        "relief": ({"kind": "sinusoid", "amplitude": 0.04, "wavelength": 1.1, "direction": 30.0},),
        "stiffness": ({"kind": "random", "spread": 0.5, "correlation_length": 0.4},),
    },
    "friction": {"window": 0.3, "sample": 0.3, "plate": 0.2},
    "mesh": {"element_size": 0.25, "layer_elements": 2},
}


def pressed(**sample):
    """An assembly and its state near equilibrium at 40 % of the load, friction in all its range."""
    assembly = build(Scene.model_validate(SCENE | {"sample": SCENE["sample"] | sample}))
    state = solve([assembly], target=0.4).state
    # sliding that is neither none nor all, so that friction depends on it
    # and sides that begin to roll onto both planes
    sides = tuple(replace(side, flattened=1.6) for side in assembly.sides)
    assembly = replace(assembly, slip_length=0.02, sides=sides)
    rng = np.random.default_rng(0)
    u = state.u + 2e-3 * rng.normal(size=state.u.shape)
    u[: assembly.bodies[LAYER].n_nodes, 0] += 0.01
    forces = tuple(force * (1 + 0.1 * rng.normal(size=force.shape)) for force in state.forces)
    return assembly, state.moved(u, state.p, forces)


def residuals(assembly, state, drag=None):
    now = balance(assembly, state, drag=drag)
    violation = np.concatenate([term.violation for term in now.terms])
    volume = np.concatenate([part.volume_residual.ravel() for part in now.bodies])
    return now.residual, violation, volume


class Exact:
    """The solver, to as small a residual as single precision allows."""

    def __init__(self, solver):
        self.solver = solver

    def solve(self, equations, tolerance):
        return self.solver.solve(equations, 3e-6)


@pytest.mark.parametrize(
    ("sample", "viscosity"),
    [({}, None), ({"size": (2.2, 1.5)}, None), ({"size": (1.0, 1.0)}, None), ({}, 300.0)],
    ids=["equal", "larger sample", "smaller sample", "against drag"],
)
def test_step_is_that_of_the_derivative_of_all_residuals(sample, viscosity, monkeypatch):
    """Along a Newton step every residual falls in proportion: friction, follower loads, sliding."""
    monkeypatch.setattr(linear, "_LONGEST", 150)
    monkeypatch.setattr(newton, "_HOLD", 0.0)  # stiffness that is in the tangent alone
    for module in (contact, side_contact):  # friction linearised where it is

        def here(w, residual, elastic, bound):
            return look_ahead(w, np.zeros(w.shape), elastic, bound)

        monkeypatch.setattr(module, "look_ahead", here)
    assembly, state = pressed(**sample)
    drag = None
    if viscosity is not None:
        bound = [1.2 * np.maximum(force, 0.0) for force in state.forces]
        drag = Drag(viscosity, replace(state, u=0.9 * state.u), bound)
    now = balance(assembly, state, drag=drag)
    assert (np.abs(now.terms[INTERFACE].slip) > 0.3).any()
    assert all(side.normal_force.any() for side in now.sides)
    du, dp, dn, _ = newton_step(assembly, now, Exact(make_solver(assembly)))

    def at(fraction):
        return residuals(assembly, state.stepped(fraction, du, dp, dn), drag)

    small = 1e-4
    for here, up, down, limit in zip(
        residuals(assembly, state, drag), at(small), at(-small), (2e-4, 2e-3, 2e-4), strict=True
    ):
        derivative = (up - down) / (2 * small)
        assert np.linalg.norm(derivative + here) < limit * np.linalg.norm(here)


def test_a_disturbed_stack_comes_back_to_rest():
    """Drag leaves the equilibrium where it was: the result does not depend on it."""
    assembly = build(Scene.model_validate(SCENE))
    state = solve([assembly]).state
    rng = np.random.default_rng(0)
    start = replace(state, u=state.u + 2e-3 * rng.normal(size=state.u.shape))
    assert balance(assembly, start).force_error > 1e-2
    loaded = newton.LoadedStack(assembly, make_solver(assembly))
    path = Path(loaded, TOLERANCES, relaxed(TOLERANCES, 30.0), start)
    path.settle()
    now = balance(assembly, path.state)
    assert now.force_error < TOLERANCES.force
    assert now.volume_error < TOLERANCES.volume
    forces = assembly.total_forces(path.state)
    np.testing.assert_allclose(forces, assembly.total_forces(state), rtol=2e-3)


@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0])
def test_few_iterations_whatever_the_stiffness(factor):
    assembly, state = pressed(stiffness=({"kind": "box", "factor": factor},))
    now = balance(assembly, state)
    *_, iterations = newton_step(assembly, now, make_solver(assembly))
    assert iterations <= 12


def test_states_on_the_way_are_in_equilibrium_and_those_of_a_smaller_travel():
    assembly = build(Scene.model_validate(SCENE))
    path = solve([assembly], stops=(0.55, 1.0))
    on_the_way, full = path.stops
    assert (on_the_way.load, full.load) == (0.55, 1.0)
    for state in path.stops:
        assert balance(assembly, state).force_error < TOLERANCES.force
    less = replace(assembly, travel=0.55 * assembly.travel)
    alone = solve([less]).state
    assert on_the_way.forces[LAYER].sum() == pytest.approx(alone.forces[LAYER].sum(), rel=0.01)
    off = np.linalg.norm(on_the_way.u - alone.u)
    assert off < 0.02 * np.linalg.norm(alone.u)


def test_the_path_of_a_similar_stack_shortens_the_way_and_leaves_the_answer():
    """Along the whole path, with friction that slides and a stiffness a tenth higher."""
    scene = Scene.model_validate(SCENE)
    levels = [build(scene, coarsening=1.5), build(scene)]
    changed = [
        replace(level, bodies=(layer, replace(sample, stiffness=1.1 * sample.factor)))
        for level in levels
        for layer, sample in [level.bodies]
    ]
    alone = solve(changed)
    guided = solve(changed, similar=solve(levels).paths)
    forces = [np.concatenate(each.state.forces) for each in (alone, guided)]
    assert np.linalg.norm(forces[1] - forces[0]) < 2e-3 * np.linalg.norm(forces[0])
    iterations = [sum(count for *_, count in each.record) for each in (alone, guided)]
    assert iterations[1] < 0.8 * iterations[0]
    for n, (path, level) in enumerate(zip(guided.paths, levels, strict=True)):
        loads = [load for size, load, _ in guided.record if size == level.n_elements]
        assert [state.load for state in path] == [0.0] * (n == 0) + loads


def test_a_guide_that_ends_before_the_path_does_is_gone_beyond():
    """Meshes are changed at half of the first load that is asked for: there the guide ends."""
    scene = Scene.model_validate(SCENE)
    levels = [build(scene, coarsening=1.5), build(scene)]
    paths = solve(levels, stops=(0.2,)).paths
    count = 0

    def report(*_):
        nonlocal count
        count += 1
        assert count < 300, "it never arrives"

    guided = solve(levels, report, stops=(0.4,), similar=paths)
    assert paths[0][-1].load < guided.paths[0][-1].load
    assert [state.load for state in guided.stops] == [0.4]
    forces = [np.concatenate(each.state.forces) for each in (guided, solve(levels, stops=(0.4,)))]
    assert np.linalg.norm(forces[1] - forces[0]) < 2e-3 * np.linalg.norm(forces[0])


def test_grids_that_do_not_fit_are_refused():
    assembly = build(Scene.model_validate(SCENE))
    layer, sample = assembly.bodies
    other = replace(layer, grid=replace(layer.grid, x=1.01 * layer.grid.x))
    with pytest.raises(ValueError, match="lateral nodes"):
        linear.StackSolver((other, sample), LAYER)
