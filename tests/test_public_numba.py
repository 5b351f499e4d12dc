"""Kernels without the private parts of numba."""

import os
import subprocess
import sys

import numpy as np
import pytest

SOLVE = """
import numpy as np, xarray as xr
import optical_palpation as op
from optical_palpation import parallel
axis = np.linspace(0, 1.5, 16)
bump = np.exp(-((axis - 0.75) ** 2 + (axis[:, None] - 0.75) ** 2) / 0.2)
loaded = xr.DataArray(0.45 - 0.03 * bump, {"y": axis, "x": axis}, ("y", "x"), attrs={"units": "mm"})
result = op.computational_stress(
    loaded, 0.5, op.MooneyRivlin(2.23, 0.703), window_friction=0.15, sample_friction=0.05,
    element_size=0.25, mesh_check=False, edge_check=False, input_errors=None,
)
print(hasattr(parallel.in_parallel, "py_func"), result.maps.attrs["window_force_mN"])
"""


def solved(**environment):
    done = subprocess.run(
        [sys.executable, "-c", SOLVE], env=os.environ | environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    public, force = done.stdout.split()
    return public == "True", float(force)


@pytest.mark.slow
def test_solution_without_numbas_private_parts_is_the_same(tmp_path):
    quickly = {"NUMBA_OPT": "0"}  # compiled in half of the time
    without = solved(OPTICAL_PALPATION_NUMBA="public", NUMBA_CACHE_DIR=str(tmp_path), **quickly)
    assert without[0]
    assert list(tmp_path.glob("public-*"))
    private, force = solved()
    assert not private
    np.testing.assert_allclose(without[1], force, rtol=1e-5)
