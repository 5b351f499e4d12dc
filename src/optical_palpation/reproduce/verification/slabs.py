"""Flat slabs pressed between plates: bonded blocks, one face against two, the hill of friction."""

from __future__ import annotations

from typing import Literal

import numpy as np

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.grid import LayerGrid, node_positions
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.reproduce.record import Part, Setting
from optical_palpation.reproduce.verification.closed_forms import (
    block_modulus,
    mean_radius,
)
from optical_palpation.reproduce.verification.layers import (
    MATERIAL,
    MU,
    contact_pressure,
    press,
    row,
)

Faces = Literal["one stuck", "stuck"]

#: Mean pressure on a bonded block in shear moduli: far above what contact is smoothed over, and
#: strains of a hundredth.
_PRESSURE = 0.2


def slab(
    width: float,
    strain: float,
    friction: tuple[float, float],
    across: int,
    deep: int,
    *,
    glued: tuple[bool, bool] = (False, False),
    ratio: float = 1e4,
    slip_length: float = 1e-3,
    accuracy: float = 1e-6,
) -> float:
    """Force, mN, on a square slab of thickness 1 mm with free sides.

    Parameters
    ----------
    width
        Its side, mm.
    strain
        By how much it is compressed.
    friction
        At window and imprint.
    across, deep
        Elements over the side, those at the rim narrower, and over the thickness.
    glued
        Whether window and imprint hold the slab.
    ratio
        K / mu.
    slip_length, accuracy
        As for ``press``.
    """
    x = node_positions(width, width / across, edge=0.1)
    pixels = np.linspace(0, width, 9)
    unloaded = np.ones((9, 9))
    solution = press(
        LayerGrid(x, x, np.linspace(0, 1, deep + 1), np.ones((x.size, x.size))),
        Imprint(pixels, pixels, unloaded, unloaded - strain),
        law=MooneyRivlin(MATERIAL.c10, MATERIAL.c01, ratio),
        friction=friction,
        glued=glued,
        slip_length=slip_length,
        pressure=3 * MU * strain,
        solver="multigrid",
        accuracy=accuracy,
        curved_sides=all(glued),
        first_step=0.25,
    )
    return float(solution.state.normal_force[1].sum())


def apparent_modulus(shape: float, faces: Faces, across: int, deep: int) -> float:
    """Apparent modulus, kPa, of a square block of shape factor ``shape``, small strain."""
    width = 4 * shape
    flow = shape if faces == "stuck" else shape / 2
    strain = _PRESSURE * MU / block_modulus(flow, MU)
    glued = (True, faces == "stuck")
    force = slab(width, strain, (0.0, 0.0), across, deep, glued=glued, ratio=1e6)
    return force / width**2 / strain


def hill(friction: float, width: float, across: int, deep: int, strain: float = 0.05) -> float:
    """Rise of the force with friction over what virtual work says, 1 for little friction.

    ``friction`` is that of each face. Of two solutions, with this and with twice this friction,
    what is quadratic in it is removed.
    """
    none, one, two = (
        slab(width, strain, (f, f), across, deep, slip_length=1e-4, accuracy=1e-7)
        for f in (1e-6, friction, 2 * friction)
    )
    slope = (4 * (one / none - 1) - (two / none - 1)) / 2
    # the lever and the thickness of the loaded slab
    lever = 0.5 * mean_radius(width / np.sqrt(1 - strain)) / (1 - strain)
    return slope / (2 * friction * lever)


def slope_of_pressure(friction: tuple[float, float], deep: int, strain: float = 0.02) -> float:
    """Slope of ln p across a slab in plane strain that slips on both faces, over von Karman's.

    Half of a slab that is ten times as wide as thick, from one thickness off the middle, where it
    sticks, to as much off the free side. ``deep``: elements over the thickness.
    """
    half = 5.0
    x = np.linspace(0.0, half, round(half * deep) + 1)
    y = x[:2]
    pixels = np.linspace(-half, 2 * half, 9)
    unloaded = np.ones((9, 9))
    solution = press(
        LayerGrid(x, y, np.linspace(0, 1, deep + 1), np.ones((2, x.size))),
        Imprint(pixels, pixels, unloaded, unloaded - strain),
        friction=friction,
        mirrors=(True, True, True, False),
        slip_length=1e-5,
        pressure=4 * MU * strain,
        first_step=0.25,
    )
    pressure = contact_pressure(solution)[0]
    there = (x >= 1.0) & (x <= half - 1.0)
    moved = (x + solution.state.u[0, -1, 0])[there]
    slope = np.polyfit(moved, np.log(pressure[there]), 1)[0]
    return float(-slope * (1 - strain) / sum(friction))


def slabs(setting: Setting) -> Part:
    """Gent and Lindley, four to one, and the hill of friction."""
    part = Part(
        "A square slab of 1 mm between plates, sides free, little strained. Stuck to both it has "
        "the apparent modulus $E (1 + 2.249 S^2)$ for $S \\gg 1$ (Gent and Lindley, *Proc. Inst. "
        "Mech. Eng.* **173**, 111, 1959; for a disc 2 instead of 2.249), where $S$ is loaded over "
        "free area. A frictionless face is a plane of symmetry of a slab of twice the thickness: "
        "$S / 2$ instead of $S$, so that a thin slab carries a quarter. With little friction $f$ "
        "at each face a slab spreads evenly, $u_r = \\varepsilon r / 2$, and virtual work gives "
        "$F / F_0 = 1 + 2 f \\bar r / 2 h$ to first order, $\\bar r$ the mean distance from the "
        "middle, 0.3826 of the side: the mean of the hill of pressure. $K / \\mu$ = 10⁶ for the "
        "bonded blocks. In plane strain the pressure of a slab that slips on both faces falls "
        "towards the free side as $\\ln p = -(f_1 + f_2) x / h$ (von Karman's strip, in the theory "
        "of rolling)."
    )
    grids = ((12, 4), (20, 6)) if not setting.quick else ((8, 2), (10, 3))
    shapes = (1.25, 2.5, 5.0) if not setting.quick else (2.5,)
    both: dict[float, list[float]] = {}
    for number, shape in enumerate(shapes):
        setting.tell(number / 6, f"bonded block, S = {shape:g}")
        both[shape] = [apparent_modulus(shape, "stuck", *grid) for grid in grids]
        part.rows.append(
            row(
                "Gent and Lindley 1959",
                f"apparent modulus of a bonded square block over E, S = {shape:g}",
                block_modulus(shape, MU) / (3 * MU),
                [value / (3 * MU) for value in both[shape]],
                "the formula is that of S >> 1" if shape < 5 else "",
            )
        )
    for number, shape in enumerate(shapes[-2:]):
        setting.tell((3 + number) / 6, f"one face against two, S = {shape:g}")
        one = [apparent_modulus(shape, "one stuck", *grid) for grid in grids]
        part.rows.append(
            row(
                "Flow between plates",
                f"force stuck on both faces over that stuck on one, S = {shape:g}",
                block_modulus(shape, MU) / block_modulus(shape / 2, MU),
                [a / b for a, b in zip(both[shape], one, strict=True)],
                "4 as S grows",
            )
        )
    setting.tell(5 / 6, "hill of friction")
    part.rows.append(
        row(
            "Virtual work",
            "hill of friction: rise of the force of a slab of 10 x 10 mm that slips on both faces, "
            "over that of first order",
            1.0,
            [hill(0.01, 10.0, *grid) for grid in grids],
        )
    )
    deeps = (2, 4) if setting.quick else (4, 8)
    part.rows.append(
        row(
            "von Karman 1925",
            "slope of ln p across a strip with friction 0.1 and 0.05, over (f_1 + f_2) / h",
            1.0,
            [slope_of_pressure((0.1, 0.05), deep) for deep in deeps],
            "plane strain, 2 % compressed",
        )
    )
    return part
