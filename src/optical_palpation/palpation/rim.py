"""What the model of the rim does to the total force.

Where a free side rolls onto window or sample, its nodes are caught before they touch, and contact
at the rim is smoothed (``mechanics.contact``): without that, Newton's method does not get past the
moment at which they do. That is a model. Its reach, an element's height on meshes of up to ten
elements through the depth, stays that of ten on finer ones, so that its part of the force does not
vanish with the mesh.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optical_palpation.mechanics.cascade import Solution, make_solver
from optical_palpation.mechanics.contact import rim_reach, side_contact
from optical_palpation.mechanics.iteration import TOLERANCES, NotConverged, relaxed
from optical_palpation.mechanics.newton import equilibrate
from optical_palpation.mechanics.problem import SAMPLE, LayerProblem, LayerState

#: Share of its reach by which the model is shortened for the difference.
_LESS = 0.2
#: Elements beyond which the coarser grid is asked.
_LARGE = 20_000
#: How much further from equilibrium than a result the two states may be.
_RELAXED = 10.0


def rim_effect(solution: Solution) -> float | None:
    """Part of the total force that is due to the model of the rim, to first order, mN.

    The layer is brought into equilibrium twice more at full load, with the model as it is and with
    a reach that is a fifth shorter; of large problems on the next coarser grid, from which the
    difference is carried over in proportion to the reach.

    Returns
    -------
    float or None
        Positive where the model makes the layer stiffer; None where an equilibrium was not found.
    """
    problem, state = solution.problem, solution.state
    caught = side_contact(problem, state).normal_force.any()
    if problem.edges != "free" or not (caught or problem.rim_smoothing > 0):
        return 0.0
    if solution.coarser is not None and problem.grid.n_elements > _LARGE:
        problem, state = solution.coarser
    shorter = replace(problem, rim_model=1.0 - _LESS)
    try:
        forces = [_force(each, state) for each in (problem, shorter)]
    except NotConverged:
        return None
    reach, here = (rim_reach(p.grid).mean() for p in (solution.problem, problem))
    return float((forces[0] - forces[1]) / _LESS * reach / here)


def _force(problem: LayerProblem, state: LayerState) -> float:
    """Total force on the sample in equilibrium near a state, mN.

    Raises
    ------
    NotConverged
    """
    linear = make_solver(problem, "multigrid")
    now, _ = equilibrate(problem, state.copy(), linear, relaxed(TOLERANCES, _RELAXED))
    sides = side_contact(problem, now.state).normal_force[SAMPLE].sum()
    return float(np.sum(now.state.normal_force[SAMPLE]) + sides)
