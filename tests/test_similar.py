"""A layer that is guided by a similar one has the stress that it has alone."""

from __future__ import annotations

import json

import numpy as np
import pytest

from optical_palpation.errors import InputError
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import Similar, computational_stress
from optical_palpation.thickness import thickness_map

AXIS = np.linspace(0.0, 3.0, 61)
X, Y = np.meshgrid(AXIS, AXIS)
BUMP = np.exp(-((X - 1.3) ** 2 + (Y - 1.6) ** 2) / 0.4)
THICKNESS = 0.5


def solved(similar=None, pressed=BUMP, c10=2.2, window=0.2, sample=0.1, size=0.25, depth=0.4):
    loaded = thickness_map(THICKNESS * (1 - depth * pressed), x=AXIS, y=AXIS)
    return computational_stress(
        loaded,
        THICKNESS,
        MooneyRivlin(c10, 0.7),
        window_friction=window,
        sample_friction=sample,
        element_size=size,
        threads=1,
        mesh_check=False,
        edge_check=False,
        input_errors=None,
        similar=similar,
    )


def off(result, other):
    """Difference of two axial stresses, as a share of their root mean square."""
    at, there = (it.maps["axial_stress"].values for it in (result, other))
    return np.sqrt(np.nanmean((at - there) ** 2) / np.nanmean(there**2))


def newton(result):
    return result.maps.attrs["newton_iterations"]


@pytest.mark.parametrize("size", [0.25, 0.125])  # followed on one grid, and carried to another
def test_a_guided_layer_has_its_own_stress_in_fewer_iterations(size):
    similar = Similar()
    first = solved(similar, size=size)
    assert off(first, solved(size=size)) == 0.0
    assert "guided_by_similar_layer" not in first.maps.attrs
    spent = alone = 0
    for change in {"c10": 3.3}, {"window": 0.25}, {"sample": 0.13}, {"depth": 0.42}:
        guided, from_scratch = solved(similar, size=size, **change), solved(size=size, **change)
        assert guided.maps.attrs["guided_by_similar_layer"] == 1
        assert guided.maps.attrs["status"] == "converged"
        # far less than what the change itself does
        assert 0.0 < off(guided, from_scratch) < min(0.005, 0.1 * off(first, from_scratch))
        spent, alone = spent + newton(guided), alone + newton(from_scratch)
    assert spent < 0.9 * alone


def test_a_guide_that_leads_astray_is_dropped():
    similar = Similar()
    solved(similar, depth=0.4)
    elsewhere = np.exp(-((X - 2.2) ** 2 + (Y - 0.6) ** 2) / 0.1)
    other = {"pressed": elsewhere, "depth": 0.55, "c10": 40.0, "window": 0.0}
    assert off(solved(similar, **other), solved(**other)) < 0.005


def test_other_elements_are_solved_as_without_it():
    similar = Similar()
    solved(similar)
    coarser = solved(similar, size=0.3)
    assert off(coarser, solved(size=0.3)) == 0.0
    assert "guided_by_similar_layer" not in coarser.maps.attrs


def test_what_a_guide_meets_at_once_takes_no_iteration():
    similar = Similar()
    solved(similar)
    again = solved(similar)
    *on_the_way, last = json.loads(again.maps.attrs["convergence"])
    assert [load["newton"] for load in on_the_way] == [0] * len(on_the_way)
    assert last["newton"] > 0
    assert 0.0 < again.maps.attrs["force_residual"] < again.maps.attrs["force_tolerance"] == 1e-4
    assert off(again, solved()) < 1e-4


def test_a_row_of_changes_does_not_drift():
    similar = Similar()
    for window in np.linspace(0.05, 0.4, 8):
        last = solved(similar, window=float(window))
    assert off(last, solved(window=0.4)) < 0.005


def test_what_is_no_similar_layer_is_refused():
    with pytest.raises(InputError, match=r"similar: palpation\.Similar or None, not dict"):
        solved({})
