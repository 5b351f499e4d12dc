"""Transfer function: pressure of a wave of the imprint, on a layer that slides or sticks."""

from __future__ import annotations

import numpy as np

from optical_palpation.mechanics.grid import LayerGrid, graded_depths
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.reproduce.record import Part, Setting
from optical_palpation.reproduce.verification.closed_forms import Base, transfer
from optical_palpation.reproduce.verification.layers import (
    MATERIAL,
    MU,
    contact_pressure,
    press,
    row,
)

_WAVELENGTH, _AMPLITUDE, _PRESSED = 1.0, 2e-5, 1e-4


def response(nodes: int, depth: int, base: Base, thickness: float = 0.4) -> float:
    """Amplitude of contact pressure over that of the imprint, kPa / mm.

    ``nodes`` elements per wave, ``depth`` over the thickness. The layer is confined by rollers and
    pressed evenly, so that all of it stays in contact; of a wave up and one down the mean is taken,
    which removes what is quadratic in the amplitude.
    """
    length, k = 1.5 * _WAVELENGTH, 2 * np.pi / _WAVELENGTH
    x = np.linspace(0, length, round(1.5 * nodes) + 1)
    y = np.linspace(0, 0.5, 5)
    pixels = np.linspace(0, length, 193)
    grid = LayerGrid(x, y[::2], graded_depths(depth), np.full((3, x.size), thickness))
    weight = np.ones(x.size)
    weight[[0, -1]] = 0.5
    amplitudes = []
    for amplitude in (_AMPLITUDE, -_AMPLITUDE):
        wave = amplitude * np.cos(k * pixels)
        unloaded = np.full((5, 193), thickness)
        imprint = Imprint(pixels, y, unloaded, unloaded - _PRESSED * thickness + wave)
        solution = press(
            grid,
            imprint,
            glued=(base == "stuck", False),
            rollers=True,
            pressure=MATERIAL.bulk_modulus * _PRESSED,
        )
        pressure = contact_pressure(solution)[1]
        amplitudes.append(2 * (weight * pressure * np.cos(k * x)).sum() / weight.sum() / amplitude)
    # a nodal force is the pressure times the hat function of its node, which weakens a wave
    hat = np.sinc((x[1] - x[0]) / _WAVELENGTH) ** 2
    return -float(np.mean(amplitudes)) / hat


def waves(setting: Setting) -> Part:
    """Transfer function at three thicknesses."""
    sizes = (5, 10) if setting.quick else (10, 20)
    part = Part(
        "An imprint with a small wave of 1 mm, $u = \\hat u \\cos kx$, on a layer pressed evenly: "
        "$\\hat p / \\hat u = 2 \\mu k (\\sinh a \\cosh a + a) / \\sinh^2 a$ with $a = kh$ for a "
        "layer that slides at the window, $2 \\mu k (\\cosh^2 a + a^2) / (\\sinh a \\cosh a - a)$ "
        f"for one that is glued to it. Meshes of {sizes[0]} and {sizes[1]} elements per wave, "
        "and as high as wide."
    )
    cases: tuple[tuple[Base, float], ...] = (("sliding", 0.4), ("stuck", 0.4), ("stuck", 0.2))
    for number, (base, thickness) in enumerate(cases):
        setting.tell(number / len(cases), f"wave, {base}, {thickness:g} mm")
        ours = [response(n, max(2, round(n * thickness)), base, thickness) for n in sizes]
        part.rows.append(
            row(
                "Stokes' equations",
                f"pressure over displacement, {base}, h/wavelength {thickness:g}, kPa/mm",
                transfer(2 * np.pi / _WAVELENGTH, thickness, MU, base),
                ours,
            )
        )
    return part
