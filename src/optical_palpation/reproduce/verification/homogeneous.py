"""Homogeneous compression, and a manufactured solution at finite strain."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

from optical_palpation.errors import ConvergenceError
from optical_palpation.material import InvariantLaw, MooneyRivlin, Yeoh
from optical_palpation.mechanics.body import Body
from optical_palpation.mechanics.direct import sparse_matrix
from optical_palpation.mechanics.grid import LayerGrid, graded_depths
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.reproduce.record import Part, Row, Setting
from optical_palpation.reproduce.verification.closed_forms import uniaxial_compression
from optical_palpation.reproduce.verification.layers import MATERIAL, contact_pressure, press, row

Array = NDArray[np.float64]


def compressed(law: InvariantLaw, uneven: bool, width: float = 1.5) -> Array:
    """Axial stress at the nodes of a layer without friction pressed to half its thickness, kPa.

    ``uneven``: elements of widths from 0.1 to 0.25, growing by half from one to the next in depth.
    """
    x = np.array([0.0, 0.1, 0.3, 0.45, 0.7, 0.85, 1.0]) if uneven else np.linspace(0, 1, 5)
    pixels = np.linspace(-width, 2 * width, 9)
    flat = np.full((9, 9), 0.5)
    grid = LayerGrid(
        x * width,
        0.7 * x * width,
        graded_depths(3, 1.5 if uneven else 1.0),
        np.full((x.size, x.size), 0.5),
    )
    solution = press(
        grid,
        Imprint(pixels, pixels, flat, 0.5 * flat),
        law=law,
        pressure=-uniaxial_compression(law, 0.5),
    )
    return -contact_pressure(solution)


def compression(setting: Setting) -> Part:
    """Uniform stress on even and uneven elements."""
    part = Part(
        "A block without friction between two plates is pressed to half its height. Every mesh "
        "must carry the uniform stress exactly: $\\sigma = \\mathrm{dev}(2 W_1 b + 2 W_2 "
        "(I_1 b - b^2)) / J + K (J - 1)$ with the lateral stretch at which the sides are free of "
        "stress. It is the contact patch test of a layer on a rigid surface."
    )
    laws: tuple[tuple[str, InvariantLaw], ...] = (
        ("Mooney-Rivlin, K/mu 10000", MATERIAL),
        ("Mooney-Rivlin, K/mu 20", MooneyRivlin(MATERIAL.c10, MATERIAL.c01, 20.0)),
        ("Yeoh (2.9, -0.1, 0.1 kPa), K/mu 10000", Yeoh(2.9, -0.1, 0.1)),
    )
    for name, law in laws:
        exact = uniaxial_compression(law, 0.5)
        ours = []
        for uneven in (False, True):
            stress = compressed(law, uneven)
            ours.append(float(stress.flat[np.argmax(np.abs(stress - exact))]))
        part.rows.append(
            row(
                "Closed form",
                f"axial stress at the worst node, {name}, even and uneven elements, kPa",
                exact,
                ours,
                "contact is smoothed over a thousandth of the shear modulus",
                digits=6,
            )
        )
    return part


#: Amplitude of the manufactured displacement, mm, on a unit cube.
_AMPLITUDE = 0.08


def exact_displacement(x: Array) -> Array:
    """The manufactured displacement at points (3, ...), mm: shear, bulge, compression by 20 %."""
    a, half = _AMPLITUDE, 0.5 * np.pi
    return np.stack(
        [
            a * np.sin(half * x[2]) * np.cos(x[1]) + 0.1 * x[0],
            a * np.sin(2 * x[0]) * x[2],
            -0.2 * x[2] + a * np.cos(half * x[0]) * np.sin(x[1]) * x[2],
        ]
    )


def _first_piola(material: MooneyRivlin, gradient: Array) -> Array:
    """First Piola-Kirchhoff stress (..., 3, 3), kPa, from the derivative of the energy."""
    c10, c01, bulk = material.c10, material.c01, material.bulk_modulus
    c = np.swapaxes(gradient, -1, -2) @ gradient
    trace = np.trace(c, axis1=-2, axis2=-1)[..., None, None]
    second = 0.5 * (trace**2 - np.trace(c @ c, axis1=-2, axis2=-1)[..., None, None])
    j = np.linalg.det(gradient)[..., None, None]
    cofactor = j * np.swapaxes(np.linalg.inv(gradient), -1, -2)
    first = 2 * gradient * j ** (-2 / 3) - 2 / 3 * trace * j ** (-5 / 3) * cofactor
    other = 2 * (trace * gradient - gradient @ c) * j ** (-4 / 3)
    other = other - 4 / 3 * second * j ** (-7 / 3) * cofactor
    return c10 * first + c01 * other + bulk * (j - 1) * cofactor


def _gradient(field: Callable[[Array], Array], x: Array) -> Array:
    """Derivatives (..., 3, 3) of a vector field by complex steps, exact to rounding."""
    columns = []
    for axis in range(3):
        step = np.zeros((3,) + (1,) * (x.ndim - 1), complex)
        step[axis] = 1e-30j
        columns.append(np.imag(field(x + step)) / 1e-30)
    return np.moveaxis(np.stack(columns), (1, 0), (-2, -1))


def manufactured_error(elements: int, bulk_to_shear: float) -> tuple[float, float]:
    """Errors of displacement (L2 norm, mm) and stress (of zz at the centres, kPa) on a unit cube.

    The load of the manufactured displacement, the work of its stress on the shape functions, is
    integrated with four Gauss points each way; the outer nodes are prescribed.
    """
    material = MooneyRivlin(MATERIAL.c10, MATERIAL.c01, bulk_to_shear)
    n = np.linspace(0, 1, elements + 1)
    body = Body(LayerGrid(n, n, n, np.ones((elements + 1,) * 2)), material)
    goal = exact_displacement(body.nodes)
    load = np.zeros_like(goal)
    gauss, weight = np.polynomial.legendre.leggauss(4)
    gauss, weight = 0.5 * (gauss + 1), 0.5 * weight
    width = 1 / elements
    corner = np.stack(np.meshgrid(n[:-1], n[:-1], n[:-1], indexing="ij")[::-1])  # x, y, z
    for q in np.ndindex(4, 4, 4):
        at = gauss[list(q)]
        points = corner + width * at[:, None, None, None]
        stress = _first_piola(material, np.eye(3) + _gradient(exact_displacement, points))
        for a in np.ndindex(2, 2, 2):  # of x, y, z
            shape = np.where(a, at, 1 - at)
            slope = (
                np.array([(2 * a[d] - 1) * np.prod(np.delete(shape, d)) for d in range(3)]) / width
            )
            work = np.moveaxis(stress @ slope, -1, 0) * np.prod(weight[list(q)]) * width**3
            index = tuple(slice(s, s + elements) for s in a[::-1])
            load[:, *index] += work
    free = np.zeros(goal.shape, bool)
    free[:, 1:-1, 1:-1, 1:-1] = True
    u = _equilibrium(body, goal, load, free, material.bulk_modulus)
    volume = body.forces(u, np.zeros(body.grid.shape))
    pressure = material.bulk_modulus * (volume.volume / volume.reference_volume - 1)
    centre = corner + 0.5 * width
    gradient = np.eye(3) + _gradient(exact_displacement, centre)
    cauchy = _first_piola(material, gradient) @ np.swapaxes(gradient, -1, -2)
    axial = cauchy[..., 2, 2] / np.linalg.det(gradient)
    stress_error = np.sqrt(np.mean((body.stress(u, pressure)[2] - axial) ** 2))
    return float(np.sqrt(np.mean((u - goal) ** 2))), float(stress_error)


def _equilibrium(body: Body, goal: Array, load: Array, free: Array, bulk: float) -> Array:
    """Newton's method in displacements alone, the pressure K (v / V - 1) of each element."""
    u = goal.copy()
    inner = np.flatnonzero(free.ravel())
    for _ in range(20):
        zero = np.zeros(body.grid.shape)
        at = body.forces(u, zero)
        pressure = bulk * (at.volume / at.reference_volume - 1)
        residual = np.where(free, body.forces(u, pressure).force - load, 0.0)
        divergence = np.empty((*body.grid.shape[:2], 24, body.grid.shape[2]))
        planes = body.tangent_planes(u, pressure, bulk, divergence)
        nodes = body.grid.node_shape[2]
        stencil = np.stack([plane[..., :nodes].astype(float) for plane in planes])
        tangent = sparse_matrix(stencil, np.ones(u.shape, bool)).tocsc()[inner][:, inner]
        step = spsolve(tangent, residual.ravel()[inner])
        u.flat[inner] -= step
        if np.abs(step).max() < 1e-10:
            return u
    raise ConvergenceError("the manufactured solution: no convergence in 20 Newton iterations")


def manufactured(setting: Setting) -> Part:
    """Order of convergence of displacement and stress at finite strain."""
    sizes = (2, 4) if setting.quick else (4, 8, 12)
    part = Part(
        "On a unit cube, $u = (a \\sin(\\pi z / 2) \\cos y + 0.1 x, a z \\sin 2x, -0.2 z + a z "
        "\\cos(\\pi x / 2) \\sin y)$ with $a$ = 0.08: strains up to 40 %. The nodes within must "
        "find it under the loads that its stress does on their shape functions. Displacements at "
        "the nodes and stress at the centres of the elements must converge at order 2."
    )
    for ratio in (20.0, 1e3):
        errors = np.array([manufactured_error(n, ratio) for n in sizes])
        orders = (
            np.log(errors[:-1] / errors[1:]) / np.log(np.divide(sizes[1:], sizes[:-1]))[:, None]
        )
        for column, (what, unit) in enumerate((("displacement", "um"), ("axial stress", "kPa"))):
            factor = 1e3 if unit == "um" else 1.0
            part.rows.append(
                Row(
                    "Manufactured solution",
                    f"RMS error of the {what}, K/mu {ratio:g}, "
                    f"{', '.join(f'{n}³' for n in sizes)} elements, {unit}",
                    "order 2",
                    ", ".join(f"{factor * e:.3g}" for e in errors[:, column]),
                    f"order {', '.join(f'{o:.2f}' for o in orders[:, column])}",
                )
            )
        setting.tell(0.5, "manufactured solution")
    return part
