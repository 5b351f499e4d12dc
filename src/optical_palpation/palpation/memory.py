"""Memory that a computation will take, and that there is, before it begins."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from math import ceil, floor, log10, prod
from pathlib import Path

from optical_palpation.errors import InputError, InsufficientMemoryError
from optical_palpation.mechanics.krylov import KEPT, SMALL
from optical_palpation.mechanics.problem import LayerProblem
from optical_palpation.mechanics.stack.assembly import Blocks, Mesh, count_elements
from optical_palpation.mechanics.stencil import padded
from optical_palpation.runtime.environment import address_space_limit

#: Bytes per node at the peak of a run by multigrid: stencils, vectors of the Krylov method, states;
#: and per node of a face.
_MULTIGRID, _FACE = 1250.0, 3000.0
#: Bytes of such a run whatever its size.
_FIXED = 4e6
#: Bytes per element of layer and sample, of runs with a sample, and those whatever the size.
_STACK, _STACK_FIXED = 4900.0, 3e7
#: Bytes per node of the sparse matrix on its way to the direct solver, and per node and node of
#: the depth of its fronts, which grow with the logarithm of the lateral size besides.
_MATRIX, _FACTORS = 14000.0, 750.0
#: Address space that linear algebra libraries take for each thread once they are used.
_WORK = 6.4e7
#: Share of the available memory that a run may be predicted to take.
_USABLE = 0.95
#: How much larger elements may have to be to be proposed.
_COARSEST = 64.0

#: Krylov vectors of which ``_MULTIGRID`` knows, and those that a linear solution is taken to need
#: on a grid neither small nor huge: easy layers need half of them, one whose rim folds all 30.
_KNOWN, _DIRECTIONS = 10, 20


def predicted_memory(shape: tuple[int, int, int], solver: str = "multigrid") -> float:
    """Peak memory of a computation, bytes, beyond what the process holds before it.

    Parameters
    ----------
    shape
        Numbers of elements (nz, ny, nx).
    solver
        ``multigrid``, ``direct`` or ``auto``.

    Notes
    -----
    An estimate with constants that were measured; what it says of thin layers (fewer elements
    through the thickness than along the sides) is within -25 and +60 %: hard layers need more
    vectors than easy ones. The direct solver takes 0.6 of it where single precision is enough.
    """
    nz1, ny1, nx1 = (n + 1 for n in shape)
    nodes = nz1 * ny1 * nx1
    if solver == "direct":
        return nodes * (_MATRIX + _FACTORS * nz1 * min(nx1, ny1).bit_length())
    rows = nz1 * ny1 * padded(nx1)
    unknowns = 4 * nodes
    directions = _DIRECTIONS if SMALL < unknowns <= KEPT else _KNOWN
    vectors = directions - _KNOWN + (directions if unknowns <= KEPT else 0)
    return rows * _MULTIGRID + rows / nz1 * _FACE + 4.0 * vectors * unknowns + _FIXED


def available_memory() -> float:
    """Bytes that this process can still take: of the machine, its control groups and limits."""
    import psutil

    available = float(psutil.virtual_memory().available)
    for second, group in control_groups("memory"):
        limit, usage = (
            ("memory.max", "memory.current")
            if second
            else ("memory.limit_in_bytes", "memory.usage_in_bytes")
        )
        try:
            left = int((group / limit).read_text()) - int((group / usage).read_text())
            # the cache of files counts as used, but gives way
            kept = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
            left += int(kept.get("total_inactive_file", kept.get("inactive_file", 0)))
        except (OSError, ValueError):  # no such group, or "max": no limit
            continue
        available = min(available, float(max(left, 0)))
    space = address_space_limit()
    if space is not None:
        work = _WORK * (os.cpu_count() or 1)
        available = min(available, max(space - psutil.Process().memory_info().vms - work, 0.0))
    return available


def check_memory(problem: LayerProblem, solver: str = "multigrid") -> None:
    """Refuse a problem that cannot fit in memory, before anything large is made of it.

    Raises
    ------
    InsufficientMemoryError
        With the memory needed, the memory there is, and the element size that would fit.
    """
    check_grid_memory(problem.grid.shape, problem.grid.spacing[::-1], solver)


def check_grid_memory(
    shape: tuple[int, int, int], spacing: tuple[float, float, float], solver: str = "multigrid"
) -> None:
    """Refuse (nz, ny, nx) elements of (x, y, z) mm that cannot fit in memory.

    Raises
    ------
    InsufficientMemoryError
        As ``check_memory``.
    """

    def needed(factor: float) -> float:
        nz, ny, nx = (max(1, round(n / factor)) for n in shape)
        return predicted_memory((nz, ny, nx), solver)

    def advice(factor: float) -> str:
        sizes = " ".join(f"{_rounded_up(factor * size):.2g}" for size in spacing)
        direct = ", and the multigrid solver needs far less" if solver == "direct" else ""
        return f"elements of {sizes} mm (x y z) would fit{direct}"

    _check(prod(shape), needed, advice)


def predicted_stack_memory(elements: int) -> float:
    """Peak memory of a computation with a sample, bytes, of the elements of layer and sample."""
    return _STACK * elements + _STACK_FIXED


def check_stack_memory(blocks: Blocks, mesh: Mesh) -> None:
    """Refuse a layer on a sample that cannot fit in memory, before it is meshed.

    Raises
    ------
    InsufficientMemoryError
        As ``check_memory``.
    InputError
        If the elements are too large.
    """

    def elements(factor: float) -> int:
        return count_elements(blocks, replace(mesh, size=factor * mesh.size))

    def advice(factor: float) -> str:
        return f"an element size of {_rounded_up(factor * mesh.size):.2g} mm would fit"

    _check(elements(1), lambda factor: predicted_stack_memory(elements(factor)), advice)


def _check(elements: int, needed: Callable[[float], float], advice: Callable[[float], str]) -> None:
    """Compare the memory ``needed`` by elements a factor as large with what there is."""
    most = needed(1.0)
    available = available_memory()
    usable = _USABLE * available
    if most <= usable:
        return
    factor, what = 1.0, "free some memory"
    with suppress(InputError):  # elements that large are none
        while factor < _COARSEST:
            factor *= 1.05
            if needed(factor) <= usable:
                what = advice(factor)
                break
    raise InsufficientMemoryError(
        f"{elements:,} elements need about {_gigabytes(most)} of memory and "
        f"{_gigabytes(available)} are available: {what}"
    )


def _rounded_up(size: float) -> float:
    """Round up to two digits."""
    digit = 10.0 ** (floor(log10(size)) - 1)
    return ceil(size / digit) * digit


def _gigabytes(count: float) -> str:
    return f"{count / 1e9:.2g} GB" if count < 1e10 else f"{count / 1e9:.0f} GB"


def control_groups(controller: str) -> list[tuple[bool, Path]]:
    """Folders (whether of version 2, path) of the control groups of this process (Linux)."""
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return []
    found = []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        root = Path("/sys/fs/cgroup") / (controller if controllers else "")
        group = root / path.lstrip("/")
        # a limit holds for all groups below; inside a container only the root may be visible
        found += [(not controllers, f) for f in (group, *group.parents) if f.is_relative_to(root)]
    return found
