"""The rungs of the verification page, on meshes small enough for every run of the tests."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from optical_palpation.material import MooneyRivlin, Yeoh
from optical_palpation.reproduce import PAGES, reproduce
from optical_palpation.reproduce.verification.closed_forms import (
    block_modulus,
    dimitriadis,
    hertz,
    mean_radius,
    paraboloid,
    thin_paraboloid,
    transfer,
    uniaxial_compression,
)
from optical_palpation.reproduce.verification.homogeneous import compressed, manufactured_error
from optical_palpation.reproduce.verification.indentation import indentation_force
from optical_palpation.reproduce.verification.layers import MATERIAL, MU
from optical_palpation.reproduce.verification.slabs import (
    apparent_modulus,
    hill,
    slope_of_pressure,
)
from optical_palpation.reproduce.verification.tangential import sideways
from optical_palpation.reproduce.verification.waves import response

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("ratio", [20.0, 1e4])
@pytest.mark.parametrize("width", [0.6, 3.0])
@pytest.mark.parametrize("law", ["mooney-rivlin", "yeoh"])
def test_homogeneous_compression_to_half_is_exact_on_uneven_elements(ratio, width, law):
    law = (
        MooneyRivlin(2.23, 0.703, ratio) if law == "mooney-rivlin" else Yeoh(2.9, -0.1, 0.1, ratio)
    )
    stress = compressed(law, uneven=True, width=width)
    assert_allclose(stress, uniaxial_compression(law, 0.5), rtol=1e-6)


def test_uniaxial_compression_agrees_with_the_incompressible_law():
    # another route to the same number: the law's own closed form at J = 1
    material = MooneyRivlin(2.23, 0.703, 1e8)
    expected = float(material.uniaxial_stress(-0.4, "true"))
    assert_allclose(uniaxial_compression(material, 0.6), expected, rtol=1e-6)


@pytest.mark.parametrize("ratio", [20.0, 1e3])
def test_manufactured_solution_at_second_order(ratio):
    coarse, fine = np.array([manufactured_error(n, ratio) for n in (4, 8)])
    assert (np.log2(coarse / fine) > 1.8).all()


@pytest.mark.parametrize("base", ["sliding", "stuck"])
def test_transfer_function_at_second_order(base):
    exact = transfer(2 * np.pi, 0.4, MU, base)
    errors = [abs(response(n, d, base) / exact - 1) for n, d in ((6, 3), (12, 6))]
    assert errors[1] < 0.025
    assert np.log2(errors[0] / errors[1]) > 1.7


def test_transfer_functions_have_the_limits_of_thick_and_thin_layers():
    for base in ("sliding", "stuck"):
        assert_allclose(transfer(10.0, 2.0, 1.0, base), 20.0, rtol=1e-6)  # half-space: 2 mu k
    k, h = 1e-2, 1.0
    assert_allclose(transfer(k, h, 1.0, "sliding"), 4 / h, rtol=1e-3)  # plane stress
    assert_allclose(transfer(k, h, 1.0, "stuck"), 3 / (k**2 * h**3), rtol=1e-3)  # flow


@pytest.mark.slow
def test_integral_equation_of_a_paraboloid_meets_its_limits():
    for base in ("sliding", "stuck"):
        delta, force = paraboloid(0.01, base)
        assert_allclose(force, hertz(delta), rtol=0.015)
        assert_allclose(delta, 0.01**2, rtol=0.01)
    delta, force = paraboloid(10.0, "sliding")
    assert_allclose(force, thin_paraboloid(delta, "sliding"), rtol=1e-3)
    errors = []
    for contact in (5.0, 10.0):
        delta, force = paraboloid(contact, "stuck")
        errors.append(force / thin_paraboloid(delta, "one stuck") - 1)
    assert errors[1] < 0.15
    assert errors[1] < 0.4 * errors[0]
    # the series, where it holds
    delta, force = paraboloid(0.1, "stuck")
    assert_allclose(dimitriadis(delta, "stuck"), force, rtol=2e-3)


def test_thin_layers_stuck_on_both_faces_carry_four_times_as_much():
    assert thin_paraboloid(1.0, "stuck") == 4 * thin_paraboloid(1.0, "one stuck")


@pytest.mark.parametrize("base", ["stuck", "sliding"])
def test_a_paraboloid_on_a_layer_meets_the_linear_theory_better_than_the_series(base):
    indentation, force = paraboloid(1.0, base)
    ours = indentation_force(1.0, base, 4)
    assert_allclose(ours, force, rtol=0.04)
    assert abs(ours / force - 1) < 0.4 * abs(dimitriadis(indentation, base) / force - 1)


def test_bonded_blocks_and_one_face_against_two():
    shape = 5.0
    both, one = (apparent_modulus(shape, faces, 20, 5) for faces in ("stuck", "one stuck"))
    assert_allclose(both, block_modulus(shape, MU), rtol=0.02)
    # a frictionless face is the middle of a slab of twice the thickness
    assert_allclose(both / one, block_modulus(shape, MU) / block_modulus(shape / 2, MU), rtol=0.03)
    # less so, the blunter the block; and never below what it would carry without bonds
    assert 1 < apparent_modulus(1.25, "stuck", 12, 4) / block_modulus(1.25, MU) < 1.1


def test_friction_raises_the_force_of_a_slab_as_virtual_work_says():
    assert_allclose(hill(0.01, 10.0, 10, 2), 1, rtol=0.02)
    # another way to the mean distance from the middle of a square
    points = (np.arange(400) + 0.5) / 400 - 0.5
    assert_allclose(mean_radius(2.0), 2 * np.hypot(*np.meshgrid(points, points)).mean(), rtol=1e-4)


@pytest.mark.parametrize("friction", [(0.1, 0.05), (0.0, 0.12)])
def test_the_pressure_of_a_strip_that_slips_falls_as_von_karman_says(friction):
    assert_allclose(slope_of_pressure(friction, 4), 1, rtol=0.015)


def test_the_stick_zone_of_a_moved_paraboloid_is_that_of_cattaneo_and_mindlin():
    force, radius = sideways(0.6, 4)
    assert 0.7 < force < 0.85
    assert_allclose(radius, (1 - force) ** (1 / 3), rtol=0.08)


def test_apparent_modulus_of_a_square_block():
    young = 3.0
    assert_allclose(block_modulus(10.0, young / 3) / young, 1 + 2.2492 * 100, rtol=1e-4)


def test_page_stands_for_all_its_parts():
    (page,) = (page for page in PAGES if page.name == "verification")
    text = (ROOT / "docs" / "verification.md").read_text(encoding="utf-8")
    for chapter in page.chapters.values():
        assert f"## {chapter.title}" in text
    assert "Not made" not in text
    assert "--quick`" not in text


def test_parts_made_quickly(tmp_path):
    only = ("compression", "not-yet")
    (path,), missing = reproduce(tmp_path, only=only, quick=True)
    assert not missing
    text = path.read_text(encoding="utf-8")
    stress = uniaxial_compression(MATERIAL, 0.5)
    assert f"| {stress:.6g} |" in text
    assert "not computed" in text
