"""Random maps converge or fail as documented: a sample of benchmarks/robustness.py."""

from dataclasses import replace

import pytest

import robustness

#: Seconds of processor time that only a solver that hangs takes, however slow the machine.
LIMIT = 1800


@pytest.mark.slow
def test_random_maps_converge_or_fail_as_documented():
    """Of these maps one may fail as documented, no more, and none in another way."""
    outcomes = [robustness.attempt(robustness.random_case(n), limit=LIMIT) for n in (0, 4, 6, 9)]
    for outcome in outcomes:
        assert outcome.allowed, f"{outcome.kind}: {outcome.text}"
    assert sum(outcome.kind == "converged" for outcome in outcomes) >= 3


@pytest.mark.parametrize("number", [7, 13, 55, 95])
def test_layers_with_nowhere_to_go_and_great_compression_converge(number):
    case = replace(robustness.random_case(number), estimates=False)
    outcome = robustness.attempt(case, limit=LIMIT)
    assert outcome.kind == "converged", outcome.text
    assert outcome.newton < 60


def test_the_random_maps_are_what_they_claim_to_be():
    cases = [robustness.random_case(n) for n in range(200)]
    assert {c.relief for c in cases} == set(robustness.RELIEFS)
    assert {c.edges for c in cases} == {"free", "padded", "roller"}
    ratios = [c.bulk_to_shear for c in cases]
    assert 20 <= min(ratios) < 30
    assert 5e4 < max(ratios) <= 1e5
    for case in cases:
        loaded, unloaded = case.maps()
        pressed = float((1 - loaded / unloaded).max())
        assert pressed == pytest.approx(case.compression)
        if case.holes:
            assert bool((loaded > unloaded).any())
    again, _ = replace(cases[7]).maps()
    assert again.equals(cases[7].maps()[0])


def test_faults_of_a_result_are_found():
    result = robustness.random_case(0).solve()
    assert robustness.faults(result) == []
    result.layer["position"][-1, :, :, 2] += 0.01
    result.maps.attrs["force_balance"] = 0.1
    result.maps["contact_pressure"][0, 0] = -1.0
    found = " ".join(robustness.faults(result))
    for text in ("pulls", "forces differ", "enters"):
        assert text in found
