"""Memory and threads of a run: predicted, compared with what there is, kept to."""

import json
import os
import re
import subprocess
import sys

import numba as nb
import numpy as np
import pytest
import threadpoolctl
import xarray as xr

from optical_palpation.cli import main
from optical_palpation.errors import InsufficientMemoryError
from optical_palpation.experiment import read_scene, run_experiment
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.problem import LayerProblem
from optical_palpation.mechanics.stack.assembly import Blocks, Mesh, assemble, count_elements
from optical_palpation.palpation import computational_stress, memory, threads
from optical_palpation.stiffness import Sample, sample_stress
from optical_palpation.thickness import thickness_map, write_thickness_map

PEAK = """
import json, re, sys

def peak():  # getrusage would count the memory of this process's parent, too
    return 1024 * int(re.search(r"VmHWM:\\s*(\\d+) kB", open("/proc/self/status").read())[1])
"""

LAYER = """
import numpy as np, psutil
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import computational_stress
from optical_palpation.thickness import thickness_map

axis = np.linspace(0.0, 4.0, 41)
loaded = thickness_map(np.full((41, 41), 0.49), x=axis, y=axis)

law = MooneyRivlin(2.23, 0.703, float(sys.argv[2]))

def solve(*size):
    return computational_stress(
        loaded, 0.5, law, window_friction=0.0, sample_friction=0.0,
        element_size=size, edges="roller", solver=sys.argv[1], threads=1,
        edge_check=False, input_errors=None,
    ).problem.grid.shape

solve(0.5, 0.5, 0.25)  # what is loaded or compiled once does not belong to the elements
before = psutil.Process().memory_info().rss
shape = solve(*map(float, sys.argv[3:]))
print(json.dumps([shape, peak() - before]))
"""

STACK = """
import psutil
from optical_palpation.experiment import read_scene, run_experiment
from optical_palpation.experiment.scene import with_element_size

scene = read_scene(sys.argv[1])

def solve(size):
    done = run_experiment(with_element_size(scene, size), threads=1)
    return sum(done.maps.attrs["elements"])

solve(0.5)
before = psutil.Process().memory_info().rss
elements = solve(float(sys.argv[2]))
print(json.dumps([elements, peak() - before]))
"""


def measured(code, *arguments):
    done = subprocess.run(
        [sys.executable, "-c", PEAK + code, *map(str, arguments)],
        env=os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read as Linux tells it")
@pytest.mark.parametrize(
    ("solver", "bulk_to_shear", "size"),
    [
        ("multigrid", 20.0, (0.08, 0.08, 0.1)),
        ("multigrid", 20.0, (0.045, 0.045, 0.05)),
        ("direct", 1e6, (0.1, 0.1, 0.125)),  # so stiff that single precision is not enough
    ],
)
def test_predicted_memory_is_what_a_run_takes(solver, bulk_to_shear, size):
    shape, taken = measured(LAYER, solver, bulk_to_shear, *size)
    # this layer is easy: one whose rim folds takes up to 1.6 times as much
    assert 0.9 < memory.predicted_memory(tuple(shape), solver) / taken < 1.6


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read as Linux tells it")
@pytest.mark.parametrize(("name", "size"), [("nodule", 0.09), ("soft_stiff_columns", 0.125)])
def test_predicted_memory_is_what_a_virtual_experiment_takes(name, size):
    elements, taken = measured(STACK, name, size)
    assert 0.9 < memory.predicted_stack_memory(elements) / taken < 1.4


def test_a_sample_that_cannot_fit_names_elements_that_would(monkeypatch):
    blocks = Blocks(
        extent=(0.0, 4.0, 0.0, 4.0),
        thickness=lambda x, _: np.full(x.shape, 0.5),
        law=MooneyRivlin(2.23, 0.703),
        sample_size=(4.0, 5.0),
        sample_thickness=2.0,
        sample_law=MooneyRivlin(2.23, 0.703),
        relief=lambda x, _: np.zeros(x.shape),
        friction=(0.1, 0.1, 0.3),
        travel=0.3,
    )
    mesh = Mesh(0.05)
    elements = count_elements(blocks, mesh)
    assert elements == assemble(blocks, mesh).n_elements
    needed = memory.predicted_stack_memory(elements)
    monkeypatch.setattr(memory, "available_memory", lambda: 2 * needed)
    memory.check_stack_memory(blocks, mesh)
    monkeypatch.setattr(memory, "available_memory", lambda: needed / 6)
    with pytest.raises(InsufficientMemoryError, match=f"{elements:,} elements need") as caught:
        memory.check_stack_memory(blocks, mesh)
    size = float(re.search(r"element size of (\S+) mm would fit", str(caught.value))[1])
    memory.check_stack_memory(blocks, Mesh(size))
    assert memory.predicted_stack_memory(count_elements(blocks, Mesh(size))) > needed / 12
    monkeypatch.setattr(memory, "available_memory", lambda: 1e6)
    with pytest.raises(InsufficientMemoryError, match="free some memory"):
        memory.check_stack_memory(blocks, mesh)


def test_a_virtual_experiment_and_a_soft_sample_are_refused_before_they_are_meshed(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 1e7)
    scene = read_scene("nodule")
    with pytest.raises(InsufficientMemoryError, match=r"elements need about 0\.\d+ GB"):
        run_experiment(scene)
    axis = np.linspace(0.0, 4.0, 41)
    loaded = thickness_map(np.full((41, 41), 0.49), x=axis, y=axis)
    with pytest.raises(InsufficientMemoryError, match=r"elements need about 0\.\d+ GB"):
        sample_stress(
            loaded,
            0.5,
            MooneyRivlin(2.23, 0.703),
            Sample(2.0, 0.3, 0.3),
            window_friction=0.1,
            sample_friction=0.1,
            element_size=0.125,
        )


def flat(lateral: int, deep: int) -> LayerProblem:
    axis = np.linspace(0.0, 5.0, lateral + 1)
    thickness = np.full((lateral + 1, lateral + 1), 0.5)
    pixels = np.linspace(0.0, 5.0, 11)
    imprint = Imprint(pixels, pixels, np.full((11, 11), 0.5), np.full((11, 11), 0.45))
    grid = LayerGrid(axis, axis, np.linspace(0.0, 1.0, deep + 1), thickness)
    return LayerProblem(grid, imprint, MooneyRivlin(2.23, 0.703), (0.1, 0.1))


@pytest.mark.parametrize("solver", ["auto", "multigrid", "direct"])
def test_a_run_that_cannot_fit_names_elements_that_would(monkeypatch, solver):
    problem = flat(200, 20)
    needed = memory.predicted_memory(problem.grid.shape, solver)
    monkeypatch.setattr(memory, "available_memory", lambda: 2 * needed)
    memory.check_memory(problem, solver)
    monkeypatch.setattr(memory, "available_memory", lambda: needed / 6)
    with pytest.raises(InsufficientMemoryError, match="800,000 elements need") as caught:
        memory.check_memory(problem, solver)
    x, y, z = map(float, re.search(r"elements of (\S+) (\S+) (\S+) mm", str(caught.value)).groups())
    assert x == y > 0.025
    assert z == pytest.approx(x, rel=0.1)
    lateral, deep = round(5 / x), round(0.5 / z)
    memory.check_memory(flat(lateral, deep), solver)
    # and elements much larger than need be are no help
    assert memory.predicted_memory((deep, lateral, lateral), solver) > needed / 12


def test_the_command_ends_at_once_with_status_2(monkeypatch, tmp_path, capsys):
    axis = np.linspace(0.0, 5.0, 51)
    write_thickness_map(thickness_map(np.full((51, 51), 0.45), x=axis, y=axis), tmp_path / "l1.nc")
    monkeypatch.setattr(memory, "available_memory", lambda: 1e8)
    command = f"stress {tmp_path}/l1.nc --initial-thickness 0.5 --c10 2.23 --window-friction 0.1 "
    command += f"--sample-friction 0.05 --element-size 0.01 --output {tmp_path}/out.nc"
    with pytest.raises(SystemExit) as ended:
        main(command.split())
    assert ended.value.code == 2
    assert "would fit" in capsys.readouterr().err
    assert not (tmp_path / "out.nc").exists()


@pytest.mark.parametrize("second", [False, True])
def test_memory_and_threads_of_control_groups_are_kept_to(monkeypatch, tmp_path, second):
    files = (
        {"memory.max": "3000", "memory.current": "2500", "memory.stat": "inactive_file 100"}
        | {"cpu.max": "150000 100000"}
        if second
        else {
            "memory.limit_in_bytes": "3000",
            "memory.usage_in_bytes": "2500",
            "memory.stat": "inactive_file 50\ntotal_inactive_file 100",
            "cpu.cfs_quota_us": "150000\n",
            "cpu.cfs_period_us": "100000\n",
        }
    )
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "unlimited").mkdir()
    (tmp_path / "unlimited" / "memory.max").write_text("max\n")
    (tmp_path / "unlimited" / "cpu.max").write_text("max 100000\n")
    groups = [(True, tmp_path / "unlimited"), (second, tmp_path), (second, tmp_path / "none")]
    for module in (memory, threads):
        monkeypatch.setattr(module, "control_groups", lambda controller: groups)
    assert memory.available_memory() == 600
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    monkeypatch.setattr(nb.config, "NUMBA_NUM_THREADS", 8)
    assert threads.available_threads() == 2


def test_control_groups_of_this_process_are_folders_with_a_limit():
    groups = memory.control_groups("memory")
    assert (groups != []) == os.path.exists("/proc/self/cgroup")
    assert all(str(path).startswith("/sys/fs/cgroup") for _, path in groups)
    assert memory.available_memory() > 1e6


def blas_threads() -> set[int]:
    pools = threadpoolctl.threadpool_info()
    return {pool["num_threads"] for pool in pools if pool["user_api"] == "blas"}


def test_threads_are_those_the_process_may_use_and_libraries_take_one(monkeypatch):
    if hasattr(os, "sched_getaffinity"):
        monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3})
        assert threads.available_threads() == 1
        monkeypatch.undo()
    before = nb.get_num_threads(), blas_threads()
    with threads.limited_threads() as number:
        assert number == nb.get_num_threads()
        assert blas_threads() == {1}
        with threads.limited_threads(1) as inner:
            assert inner == nb.get_num_threads() == 1
        assert number == nb.get_num_threads()
        assert blas_threads() == {1}
    assert (nb.get_num_threads(), blas_threads()) == before
    with threads.limited_threads(10_000) as number:
        assert number == threads.available_threads()
    with pytest.raises(ZeroDivisionError), threads.limited_threads(1):
        raise ZeroDivisionError
    assert (nb.get_num_threads(), blas_threads()) == before


def test_a_computation_uses_the_threads_it_is_given():
    axis = np.linspace(0.0, 1.0, 11)
    loaded = xr.DataArray(
        np.full((11, 11), 0.48), {"y": axis, "x": axis}, ("y", "x"), attrs={"units": "mm"}
    )
    seen = []
    computational_stress(
        loaded,
        0.5,
        MooneyRivlin(2.23),
        window_friction=0.0,
        sample_friction=0.0,
        element_size=0.25,
        threads=1,
        progress=lambda report: seen.append((report.newton, nb.get_num_threads())),
    )
    assert {threads for newton, threads in seen if newton} == {1}
