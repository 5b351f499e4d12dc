"""Section 7: lateral resolution on a small square under uniform pressure."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.analysis import edge_response
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import Progress, computational_stress
from optical_palpation.present.output import atomic
from optical_palpation.reproduce.record import Part, Row, Setting
from optical_palpation.thickness import thickness_map

Array = NDArray[np.float64]
_SQUARE, _THICKNESS, _PRESSURE = 0.5, 0.5, 0.2  # mm, mm, kPa


def resolution(setting: Setting) -> Part:
    """Edge response of both methods."""
    material = MooneyRivlin(2.23, 0.703)
    size, field = (0.05, 1.0) if setting.quick else (0.01, 0.8)
    x = np.arange(0.0, field + 1e-9, 0.005)
    dip = _indentation(x - field / 2, _THICKNESS, material.shear_modulus)
    loaded = thickness_map(_THICKNESS - dip, x=x, y=x, where="square")
    solved = {}
    for number, (name, smoothing) in enumerate((("none", 0.0), ("default", None))):
        if setting.quick and number:
            break

        def report(now: Progress, number: int = number) -> None:
            setting.tell((number + now.load) / 2, f"{now.stage}, load {now.load:.0%}")

        solved[name] = computational_stress(
            loaded,
            _THICKNESS,
            material,
            window_friction=0.02,
            sample_friction=0.001,
            element_size=(size, size, _THICKNESS / 8),
            edges="padded",
            imprint_smoothing=smoothing,
            threads=setting.threads,
            progress=report,
        ).maps
    profiles = {name: _profile(maps["axial_stress"], field) for name, maps in solved.items()}
    algebraic = _profile(solved["none"]["algebraic_axial_stress"], field)
    rises = {name: edge_response(p, _levels(p)) for name, p in profiles.items()}
    plain = edge_response(algebraic, _levels(algebraic))

    elements = f"{1e3 * size:.0f} um"
    part = Part(
        f"A pressure of {_PRESSURE} kPa on a square of {_SQUARE} mm of a layer {_THICKNESS} mm "
        "thick. The loaded thickness is the closed form of the linear theory for an incompressible "
        "layer that slides on the window, so that it owes nothing to our solver, and has no noise. "
        f"Stress from it with elements of {elements} and 8 through the depth, layer continued past "
        "the field."
    )
    picture = "section-7.png"
    _draw(solved["none"], profiles, algebraic, field, setting.folder / picture)
    part.pictures.append(
        (picture, "A square under uniform pressure: stress by both methods (compare figure 5d).")
    )
    others = []
    for thickness in (0.3, 0.4, 0.5):
        for sticks in (False, True):
            wide = np.arange(-1.0, 1.0 + 1e-9, 0.005)
            row = _indentation(wide, thickness, 1.0, sticks)[wide.size // 2]
            line = xr.DataArray(row[wide <= 0], dims="x", coords={"x": wide[wide <= 0]})
            width = edge_response(line.sel(x=slice(-0.75, 0)), (0.0, float(line[-1]))).rise
            others.append((thickness, sticks, width))
    listing = "; ".join(
        f"{1e3 * thickness:.0f} um {'sticking' if sticks else 'sliding'}: {1e3 * width:.0f} um"
        for thickness, sticks, width in others
    )
    part.rows.append(
        Row(
            "Section 7, figure 5d",
            "10-90 % edge response, algebraic",
            "180 um",
            f"{1e3 * plain.rise:.0f} um",
            "it is a property of the layer, which bends over the edge, and not of the pixels. By "
            f"the closed form, {listing}. The paper does not tell thickness and friction",
        )
    )
    part.rows.append(
        Row(
            "Section 7, figure 5d",
            f"10-90 % edge response, computational, {elements} elements",
            "15 um (10 um elements)",
            f"{1e3 * rises['none'].rise:.0f} um"
            + (
                f"; {1e3 * rises['default'].rise:.0f} um with the default smoothing of the imprint"
                if "default" in rises
                else ""
            ),
            "a step of pressure on elements of size h is 1.3 to 1.6 h wide, because the contact "
            "pressure is linear between nodes",
        )
    )
    level = float(profiles["none"].sel(x=slice(-0.15, 0.0)).mean())
    part.rows.append(
        Row(
            "Section 7",
            "stress on the square, kPa",
            f"{-_PRESSURE} (applied)",
            f"{level:.4f}; algebraic {float(algebraic[-1]):.4f} at the centre",
            f"computational {-level / _PRESSURE - 1:+.1%}; the algebraic method spreads the load "
            "over the bent layer",
        )
    )
    return part


def _indentation(x: Array, thickness: float, shear_modulus: float, sticks: bool = False) -> Array:
    """Indentation on ``x`` by ``x`` of an incompressible layer under pressure on a square.

    Linear theory per wavenumber k, pressed face free of shear, the other sliding or sticking:
    w = p g(kH) / (2 mu k).
    """
    spacing, count = 0.005, 2048
    wavenumber = 2 * np.pi * np.fft.fftfreq(count, spacing)
    k = np.hypot(*np.meshgrid(wavenumber, wavenumber))
    k[0, 0] = 1.0  # the mean of an infinite layer does not move
    kh = np.minimum(k * thickness, 300.0)
    if sticks:
        transfer = (np.sinh(2 * kh) - 2 * kh) / (np.cosh(2 * kh) + 1 + 2 * kh**2)
    else:
        transfer = 2 * np.sinh(kh) ** 2 / (np.sinh(2 * kh) + 2 * kh)
    edge = _SQUARE * np.sinc(wavenumber * _SQUARE / (2 * np.pi))
    spectrum = _PRESSURE * np.outer(edge, edge) * transfer / (2 * shear_modulus * k)
    spectrum[0, 0] = 0.0
    whole = np.fft.fftshift(np.fft.ifft2(spectrum).real) / spacing**2
    at = np.round(x / spacing).astype(int) + count // 2
    return np.asarray(whole[np.ix_(at, at)])


def _profile(stress: xr.DataArray, field: float) -> xr.DataArray:
    """Stress along x from outside to the middle of the square, x = 0 at its middle."""
    line = stress.interp(y=field / 2)
    line = line.assign_coords(x=line["x"] - field / 2)
    return line.sel(x=slice(None, 1e-9))


def _levels(profile: xr.DataArray) -> tuple[float, float]:
    """Stress outside, none, and on the middle of the square."""
    return 0.0, float(profile.sel(x=slice(-0.05, None)).mean())


def _draw(
    maps: xr.Dataset,
    profiles: dict[str, xr.DataArray],
    algebraic: xr.DataArray,
    field: float,
    path: Any,
) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3)
    for axes, name, title in (
        (left, "algebraic_axial_stress", "algebraic"),
        (middle, "axial_stress", "computational"),
    ):
        image = axes.pcolormesh(
            1e3 * (maps["x"] - field / 2),
            1e3 * (maps["y"] - field / 2),
            maps[name],
            cmap="viridis_r",
            vmin=-1.1 * _PRESSURE,
            vmax=0.0,
            shading="nearest",
            rasterized=True,
        )
        axes.set(title=f"{title} (kPa)", xlabel="x (um)", ylabel="y (um)", aspect="equal")
        figure.colorbar(image, ax=axes, shrink=0.85)
    half = 1e3 * _SQUARE / 2
    right.plot([-1e3 * field / 2, -half, -half, 0], [0, 0, -_PRESSURE, -_PRESSURE], color="0.6")
    right.plot(1e3 * algebraic["x"], algebraic, color="#D55E00", label="algebraic")
    for name, style in zip(profiles, ("-", "--"), strict=False):
        line = profiles[name]
        label = f"computational, smoothing {name}"
        right.plot(1e3 * line["x"], line, style, color="#0072B2", marker=".", ms=3, label=label)
    right.set(xlabel="x (um)", ylabel="axial stress (kPa)", xlim=(-1e3 * field / 2, 0))
    right.grid(alpha=0.3)
    right.legend(frameon=False, fontsize=8)
    with atomic(path, "picture") as temporary:
        figure.savefig(temporary, dpi=150)
