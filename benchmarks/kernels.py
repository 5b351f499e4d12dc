"""Time of each kernel of the solver, per element, beside the bytes that it has to move.

    python benchmarks/kernels.py [--elements 40x40x4 100x100x10] [--threads 4]

The layer is compressed to 0.7 of its thickness, with a ripple. Bytes count every array a kernel
reads or writes once; small grids live in the caches and beat the memory's bandwidth.
"""

from __future__ import annotations

import argparse
import time
from collections import deque
from collections.abc import Callable
from functools import partial

import numba as nb
import numpy as np

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics import stencil as st
from optical_palpation.mechanics.body import Body
from optical_palpation.mechanics.elements import GRADIENTS, internal_force
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.multigrid import Hierarchy
from optical_palpation.mechanics.schur import SchurComplement
from performance_probe import copy_bandwidth

C10, C01, THICKNESS = 2.23, 0.703, 0.5
SHEAR = 2 * (C10 + C01)


def seconds(run: Callable[[], object]) -> float:
    """Median of at least five runs, after one that compiles and warms."""
    run()
    times: list[float] = []
    while len(times) < 5 or (sum(times) < 0.3 and len(times) < 100):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def measure(nx: int, ny: int, nz: int) -> list[tuple[str, float, int]]:
    """Return (kernel, seconds, bytes) on one grid."""
    z, y, x = (np.linspace(0, length, n + 1) for length, n in ((THICKNESS, nz), (5, ny), (5, nx)))
    grid = LayerGrid(x, y, z / THICKNESS, np.full((ny + 1, nx + 1), THICKNESS))
    body = Body(grid, MooneyRivlin(C10, C01))
    u = grid.nodes * np.array([0.19, 0.19, -0.3])[:, None, None, None]
    u += 0.01 * grid.nodes[2] * np.sin(4 * grid.nodes[[1, 2, 0]])
    p = np.random.default_rng(0).standard_normal(grid.shape)
    force, volume, reference = np.empty_like(u), np.empty_like(p), np.empty_like(p)
    forces = force, volume, reference, np.empty((nz, ny))
    divergence = np.empty((nz, ny, 24, nx), np.float32)
    gamma = 3 * SHEAR
    rows: list[tuple[str, float, int]] = []

    def row(name: str, run: Callable[[], object], *arrays: np.ndarray) -> None:
        rows.append((name, seconds(run), sum(a.nbytes for a in arrays)))

    row(
        "internal force",
        lambda: internal_force(
            body.nodes, u, p, body.factor, body.law.coefficients, GRADIENTS, *forces
        ),
        body.nodes, u, p, *forces,
    )  # fmt: skip
    hierarchy = Hierarchy((z, y, x))
    fine = hierarchy.levels[0]
    planes = partial(body.tangent_planes, u, p, gamma, divergence)
    row("tangent", lambda: deque(planes(), 0), body.nodes, u, p, divergence)
    free = np.ones(u.shape, bool)
    free[2, [0, -1]] = False
    tangent = [plane.copy() for plane in planes()]

    def store() -> None:
        for k, plane in enumerate(tangent):
            st.constrain(plane, free, k)
            st.store(plane, fine.stencil, k)

    row("constraints, storing", store, *tangent, *fine.stencil)
    row("coarse operators", lambda: hierarchy.update(free), *fine.stencil)
    one = np.ones(1, np.float32)
    row(
        "residual",
        lambda: st.subtract_product(fine.stencil, fine.x, fine.b, fine.r),
        *fine.stencil, fine.x, fine.b, fine.r,
    )  # fmt: skip
    row(
        "step with residual",
        lambda: st.smooth(
            fine.stencil, fine.inverse, one, 0 * one, False, fine.b, fine.r, fine.d, fine.x
        ),
        *fine.stencil, fine.x, fine.b, fine.r, fine.inverse, fine.r, fine.d, fine.x,
    )  # fmt: skip
    st.interior(fine.b, fine.node_shape)[:] = np.where(free, force, 0)
    passes = [*fine.stencil] * 8  # smoothing before and after, and the residual
    row("V-cycle", lambda: hierarchy.cycle(), *passes)
    schur = SchurComplement(p.shape, (z[1], y[1], x[1]), SHEAR, gamma)
    schur.prepare(reference.astype(np.float32), 1e4 * SHEAR)
    change = volume.astype(np.float32)
    row("Schur complement", lambda: schur.solve(change), change, change)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--elements", nargs="+", default=["40x40x4", "60x60x6", "100x100x10"])
    parser.add_argument("--threads", type=int, default=nb.config.NUMBA_NUM_THREADS)
    chosen = parser.parse_args()
    nb.set_num_threads(chosen.threads)
    print(f"{chosen.threads} threads, {copy_bandwidth(chosen.threads) / 1e9:.1f} GB/s")
    for size in chosen.elements:
        shape = tuple(int(n) for n in size.split("x"))
        count = int(np.prod(shape))
        print(f"\n{size}\n{'':18} us/element  bytes/element   GB/s")
        for name, time_, bytes_ in measure(*shape):
            print(
                f"{name:18} {1e6 * time_ / count:10.3f} {bytes_ / count:14.0f} "
                f"{bytes_ / time_ / 1e9:6.1f}"
            )


if __name__ == "__main__":
    main()
