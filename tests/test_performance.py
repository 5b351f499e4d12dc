"""The benchmark watches the functions it means to, and its page says what was not measured."""

import json

import numpy as np

import performance
import performance_page
from optical_palpation.mechanics import multigrid
from performance_probe import PHASES, Probe

SIZE = (1.0, 1.0, 0.25)


def test_the_probe_sees_every_phase_and_leaves_no_trace():
    loaded = performance.loaded_thickness(5.0)[::25, ::25]
    smooth = multigrid.Level.smooth
    performance.solve(loaded, SIZE, threads=1)  # compiles
    with Probe() as probe:
        result = performance.solve(loaded, SIZE, threads=1)
    assert multigrid.Level.smooth is smooth
    assert set(probe.seconds) | {"direct"} == set(PHASES)  # hard systems are solved exactly
    assert all(seconds > 0 for seconds in probe.seconds.values())
    assert len(probe.krylov_each) >= result.maps.attrs["newton_iterations"]
    nodes = np.prod(result.problem.grid.node_shape)
    # each step smooths at least once, and that reads the stencil several times
    assert probe.bytes_moved > 4 * 100 * nodes * result.maps.attrs["newton_iterations"]
    with Probe() as probe:
        performance.solve(loaded, SIZE, solver="direct", threads=1)
    assert probe.seconds["direct"] > 0


def test_the_larger_map_continues_the_measured_one():
    small, large = performance.loaded_thickness(5.0), performance.loaded_thickness(7.0)
    assert abs(float(large.x[-1]) - 7.0) < 0.01
    n = small.sizes["x"]
    np.testing.assert_array_equal(large[:n, :n], small)
    assert float(large.min()) >= float(small.min())


MACHINE = {
    "processor": "P", "cores": 4, "threads": 4, "memory_bytes": 2**34, "load_before": 0.1,
    "bandwidth": 5e10, "python": "3.11", "map": "coin", "date": "2026-01-01", "version": "0.1.0",
}  # fmt: skip


def found(elements: int, seconds: float) -> dict:
    return {
        "elements": elements, "unknowns": 4 * elements, "seconds": seconds, "newton": 30,
        "watched_seconds": seconds, "newton_finest": 5, "krylov": 99, "krylov_largest": 9,
        "peak_bytes": 1e9, "predicted_bytes": 1.1e9, "shares": {"assembly": 0.25},
        "bytes_moved": 1e11, "force_mN": 400.0, "machine": MACHINE, "krylov_ended": 3,
    }  # fmt: skip


def test_the_page_tells_failures_and_what_was_not_run():
    record = {
        "100,000": found(100_000, 4.0),
        "1,000,000": found(1_000_000, 40.0),
        "240,000": {"failed": "no result within 600 s", "machine": MACHINE},
    }
    page = performance_page.page(performance.CASES, record)
    assert "to the power 1.00" in page
    lines = page.splitlines()
    assert "no result within 600 s" in next(line for line in lines if "7 x 7 mm at" in line)
    assert "not run" in next(line for line in lines if "coin 10 um" in line)
    size, work, _ = (line for line in lines if "coin 50 um" in line)
    assert "| 4.00 |" in size
    assert "| 2.00 |" in work  # the floor
    assert "| 99 | 9 | 3 |" in work
    del record["1,000,000"]
    assert "is not known" in performance_page.page(performance.CASES, record)


def test_the_page_is_that_of_its_record():
    record = json.loads(performance.RECORD.read_text())
    assert performance.PAGE.read_text() == performance_page.page(performance.CASES, record)
