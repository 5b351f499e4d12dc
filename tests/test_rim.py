"""The part of the force that is due to the model of the rim is told, and near the truth."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.cascade import Solution, solve
from optical_palpation.mechanics.grid import LayerGrid, edge_width, graded_depths, node_positions
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.problem import LayerProblem
from optical_palpation.mechanics.side_contact import side_contact
from optical_palpation.palpation.meshing import expected_forces
from optical_palpation.palpation.sensitivity import changes, sensitivities

LAW = MooneyRivlin(2.23, 0.703)


def slab(compression: float, edges="free") -> LayerProblem:
    depth, pixels = graded_depths(4), np.linspace(-1, 3, 9)
    x = node_positions(1.5, 0.125, edge=edge_width(depth, 0.5))
    flat = np.full((9, 9), 0.5)
    return LayerProblem(
        LayerGrid(x, x, depth, np.full((x.size, x.size), 0.5)),
        Imprint(pixels, pixels, flat, (1 - compression) * flat),
        replace(LAW, bulk_to_shear=100.0) if edges == "roller" else LAW,
        (0.3, 0.05),
        edges=edges,
        slip_length=1e-3,
    )


def solved(problem: LayerProblem):
    return solve(problem, lambda level: expected_forces(level, problem.law))


def rim_effect(problem: LayerProblem) -> float:
    neighbours = changes(problem)
    guess = partial(expected_forces, material=problem.law)
    solution = solve(problem, guess, neighbours=neighbours)

    def quantities(problem, state):
        return force(Solution(problem, state)), np.zeros((1, 1))

    found = sensitivities(solution, neighbours, quantities, guess, np.zeros(1), np.zeros(1))
    return found.attrs["force_rim_model_mN"]


def force(solution) -> float:
    sides = side_contact(solution.problem, solution.state).normal_force[1].sum()
    return float(solution.state.normal_force[1].sum() + sides)


def test_its_part_of_the_force_is_what_a_shorter_reach_takes_away():
    problem = slab(0.3)
    solution = solved(problem)
    shorter = solved(replace(problem, side_reach=0.8))
    expected = (force(solution) - force(shorter)) / 0.2
    assert expected > 0.01 * force(solution)
    assert rim_effect(problem) == pytest.approx(expected, rel=0.5)


@pytest.mark.parametrize(("compression", "edges"), [(0.05, "free"), (0.02, "roller")])
def test_where_no_side_is_near_it_is_nothing(compression, edges):
    assert rim_effect(slab(compression, edges)) == 0.0
