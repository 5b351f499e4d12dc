"""A rigid paraboloid on a layer: the linear theory between Hertz and the thin-layer limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.reproduce.record import Part, Setting
from optical_palpation.reproduce.verification.closed_forms import (
    Base,
    dimitriadis,
    hertz,
    paraboloid,
)
from optical_palpation.reproduce.verification.layers import MU, error, graded, press, row

Array = NDArray[np.float64]

#: Radius of contact over that of the paraboloid: strains of a few hundredths.
_SLOPE = 0.05


def indentation_force(contact: float, base: Base, across: int, solver: str = "multigrid") -> float:
    """Force of a paraboloid, in mu h^3 / R, pressed in as deep as the linear theory says.

    A quarter of the layer, mirrored by rollers.

    Parameters
    ----------
    contact
        Radius of contact over thickness, a / h.
    base
        Whether the layer slides or sticks at the window.
    across
        Elements over the radius of contact, as high as wide at the sample.
    solver
        As for ``press``.
    """
    h, radius, size = 1.0, contact / _SLOPE, contact / across
    indentation = paraboloid(contact, base)[0] * h**2 / radius
    beyond = 8 * h if base == "sliding" else 4 * h  # what it displaces, it pushes far aside
    x = graded(1.25 * contact, size, 1.25 * contact + beyond, ratio=1.5)
    depth = np.unique(1 - graded(min(0.5, 4 * size), size, 1.0)) if size < 0.2 else None
    depth = np.linspace(0, 1, max(round(h / size), 4) + 1) if depth is None else depth
    grid = LayerGrid(x, x, depth, np.full((x.size, x.size), h))
    pixels = np.linspace(0, x[-1], 161)
    unloaded = np.full((161, 161), h)
    squared = pixels[:, None] ** 2 + pixels**2
    imprint = Imprint(pixels, pixels, unloaded, h - indentation + squared / (2 * radius))
    solution = press(
        grid,
        imprint,
        glued=(base == "stuck", False),
        rollers=True,
        pressure=0.1 * MU * _SLOPE,
        solver=solver,
        accuracy=1e-5,
        first_step=0.25,
    )
    return 4 * float(solution.state.normal_force[1].sum()) / (MU * h**3 / radius)


def indentation(setting: Setting) -> Part:
    """Force of a paraboloid on layers that slide or stick, and how it grows with depth."""
    sizes = (2, 3) if setting.quick else (4, 8)
    part = Part(
        "A rigid paraboloid $z = r^2 / 2R$ on a frictionless face of a layer, $a$ the radius of "
        f"contact, $a / R$ = {_SLOPE:g}. The linear theory is Lebedev and Ufliand's integral "
        "equation (*J. Appl. Math. Mech.* **22**, 442, 1958), which meets Hertz on thick layers "
        "and both limits of thin ones. The series of Dimitriadis et al. (*Biophys. J.* **82**, "
        "2798, 2002) is off from it by what the remarks say; our solution, which knows nothing of "
        "either, is on the side of the integral equation. It ends 8 (sliding) and 4 thicknesses "
        "(stuck) beyond the contact, which the sliding layer feels at a/h 2. Meshes of "
        f"{sizes[0]} and {sizes[1]} elements over $a$."
    )
    cases: list[tuple[Base, float]] = [
        (base, contact) for base in ("stuck", "sliding") for contact in (0.5, 1.0, 2.0)
    ]
    forces: dict[tuple[Base, float], list[float]] = {}
    for number, (base, contact) in enumerate(cases):
        setting.tell(number / len(cases), f"paraboloid, {base}, a/h {contact:g}")
        depth, force = paraboloid(contact, base)
        forces[base, contact] = [indentation_force(contact, base, n) for n in sizes]
        part.rows.append(
            row(
                "Integral equation, linear theory",
                f"force, layer {base} at the window, a/h {contact:g}, mu h³/R",
                force,
                forces[base, contact],
                f"Hertz {error(hertz(depth), force)}, Dimitriadis "
                f"{error(dimitriadis(depth, base), force)}",
            )
        )
    limits: tuple[tuple[Base, int], ...] = (("stuck", 3), ("sliding", 2))
    for base, limit in limits:
        (one, force_one), (two, force_two) = (paraboloid(c, base) for c in (1.0, 2.0))
        steps = [np.log(b / a) for a, b in zip(forces[base, 1.0], forces[base, 2.0], strict=True)]
        part.rows.append(
            row(
                "Integral equation, linear theory",
                f"exponent of force over depth, layer {base} at the window, a/h 1 to 2",
                np.log(force_two / force_one) / np.log(two / one),
                [step / np.log(two / one) for step in steps],
                f"1.5 on a thick layer, {limit} on a thin one",
            )
        )
    return part
