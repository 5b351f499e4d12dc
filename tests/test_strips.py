"""Against NGSolve, the free side resolved: references that ``benchmarks/references.py`` makes."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from optical_palpation.errors import InputError
from optical_palpation.reproduce.verification.strips import (
    FORMULAS,
    TITLES,
    read_reference,
    solve_strip,
    strip_force,
    strip_pressure,
)

REFERENCES = Path(__file__).parent / "data" / "references"


@pytest.fixture(params=TITLES)
def reference(request):
    return request.param, read_reference(REFERENCES / f"{request.param}.json")


def test_the_references_are_much_better_than_what_they_are_to_tell(reference):
    _, reference = reference
    assert reference.error < 0.005
    changes = reference.about["relative_change_of_force_on_the_first_mesh_with"]
    assert abs(changes["a_quarter_of_the_contact_stiffness"]) < 0.007
    assert reference.about["loaded_thickness_mm"] in FORMULAS
    assert reference.about["made_by"].startswith("python benchmarks/references.py")


#: By how much our force may differ on elements of 125 and 62.5 um, and our pressure: fractions.
TOLERANCES = {
    "slab": (0.025, 0.018, 0.02),
    "ridges": (0.025, 0.008, 0.03),
    "stuck": (0.045, 0.02, 0.0),
}


@pytest.mark.parametrize("name", TITLES)
def test_our_force_and_pressure_at_two_meshes(name):
    reference = read_reference(REFERENCES / f"{name}.json")
    solutions = [solve_strip(reference, size) for size in (0.125, 0.0625)]
    forces = [strip_force(solution) for solution in solutions]
    coarse, fine, pressure = TOLERANCES[name]
    assert_allclose(forces[0], reference.force, rtol=coarse)
    assert_allclose(forces[1], reference.force, rtol=fine)
    if reference.bounds.size:
        ours = strip_pressure(solutions[1], reference.bounds)
        difference = np.linalg.norm(ours - reference.pressure)
        assert difference < pressure * np.linalg.norm(reference.pressure)


def test_the_slab_comes_nearer_with_every_mesh():
    """Its corner is pushed together; where the face could fold over, the force had no order."""
    reference = read_reference(REFERENCES / "slab.json")
    errors = [
        strip_force(solve_strip(reference, size)) / reference.force - 1
        for size in (0.125, 0.0625, 0.03125)
    ]
    assert errors == sorted(errors, reverse=True)
    assert 0 < errors[-1] < 0.01


def test_pressure_is_the_force_in_bins():
    reference = read_reference(REFERENCES / "slab.json")
    solution = solve_strip(reference, 0.25)
    width = float((solution.problem.grid.x + solution.state.u[0, -1, 0])[-1])
    bounds = np.linspace(0, width, 8)[1:]
    force = (strip_pressure(solution, bounds) * bounds[0]).sum()
    sides = strip_force(solution) - force
    assert -1e-9 * force < sides < 0.05 * force  # what the free side carries lies in no bin


def test_a_reference_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="--references"):
        read_reference(tmp_path / "slab.json")
