"""Section 7: lateral resolution on a small square under uniform pressure."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.analysis import edge_response
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import Progress, algebraic_stress, computational_stress
from optical_palpation.present.output import atomic
from optical_palpation.reproduce.record import Part, Row, Setting
from optical_palpation.thickness import thickness_map

Array = NDArray[np.float64]
_SQUARE, _THICKNESS, _PRESSURE = 0.5, 0.5, 0.2  # mm, mm, kPa
#: The square is turned by this, so that its edges cross the elements at all places (slanted edge).
_ANGLE = np.arctan(0.1)


def resolution(setting: Setting) -> Part:
    """Edge response of both methods."""
    material = MooneyRivlin(2.23, 0.703)
    size, field = (0.0625, 1.5) if setting.quick else (0.01, 0.8)
    loaded = _loaded(field, material.shear_modulus)
    solved = {}
    for number, (name, smoothing) in enumerate(
        (("without smoothing", 0.0), ("with default smoothing", None))
    ):
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
            mesh_check=False,  # the stress alone
            edge_check=False,
            input_errors=None,
            threads=setting.threads,
            progress=report,
        ).maps
    sharp = solved["without smoothing"]
    rises = {name: _rises(maps["axial_stress"], field) for name, maps in solved.items()}
    # The algebraic method needs no solution and a wider field, for its edges reach further.
    plain = _rises(
        algebraic_stress(_loaded(1.5, material.shear_modulus), _THICKNESS, material), 1.5
    )

    elements = f"{1e3 * size:.0f} um"
    part = Part(
        f"A pressure of {_PRESSURE} kPa on a square of {_SQUARE} mm of a layer {_THICKNESS} mm "
        "thick, slightly turned, so that its edges cross the elements at all places. The loaded "
        "thickness is the closed form of the linear theory for an incompressible layer that slides "
        "on the window, so that it owes nothing to our solver, and has no noise. Stress from it "
        f"with elements of {elements} and 8 through the depth, layer continued past the field."
    )
    picture = "section-7.png"
    _draw(solved, field, setting.folder / picture)
    part.pictures.append(
        (picture, "A square under uniform pressure: stress by both methods (compare figure 5d).")
    )
    others = []
    for thickness in (0.3, 0.4, 0.5):
        for sticks in (False, True):
            wide = np.arange(-1.0, 1.0 + 1e-9, 0.005)
            row = _indentation(wide, thickness, 1.0, sticks, angle=0.0)[wide.size // 2]
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
            f"{1e3 * plain.mean():.0f} um",
            "it is a property of the layer, which bends over the edge, and not of the pixels. By "
            f"the closed form, {listing}. The paper does not tell thickness and friction",
        )
    )
    part.rows.append(
        Row(
            "Section 7, figure 5d",
            f"10-90 % edge response, computational, {elements} elements",
            "15 um (10 um elements)",
            "; ".join(
                f"{1e3 * rise.mean():.0f} um ({1e3 * rise.min():.0f} to {1e3 * rise.max():.0f} "
                f"from row to row) {name}"
                for name, rise in rises.items()
            ),
            "sharpest where the edge runs midway between nodes, because the contact pressure is "
            "linear between them; smoothing the imprint keeps noise away and costs sharpness",
        )
    )
    centre = {"x": slice(field / 2 - 0.15, field / 2 + 0.15)}
    centre["y"] = centre["x"]
    level = float(sharp["axial_stress"].sel(centre).mean())
    algebraic = float(sharp["algebraic_axial_stress"].sel(centre).min())
    part.rows.append(
        Row(
            "Section 7",
            "stress on the square, kPa",
            f"{-_PRESSURE} (applied)",
            f"{level:.4f}; algebraic at most {algebraic:.4f}",
            f"computational {-level / _PRESSURE - 1:+.1%}; the algebraic method spreads the load "
            "over the bent layer",
        )
    )
    return part


def _loaded(field: float, shear_modulus: float) -> xr.DataArray:
    """Loaded thickness on a square field about the pressed one, 5 um pixels."""
    x = np.arange(0.0, field + 1e-9, 0.005)
    dip = _indentation(x - field / 2, _THICKNESS, shear_modulus)
    return thickness_map(_THICKNESS - dip, x=x, y=x, where="square")


def _indentation(
    x: Array,
    thickness: float,
    shear_modulus: float,
    sticks: bool = False,
    angle: float = _ANGLE,
) -> Array:
    """Indentation on ``x`` by ``x`` of an incompressible layer under pressure on a square.

    Linear theory per wavenumber k, pressed face free of shear, the other sliding or sticking:
    w = p g(kH) / (2 mu k).
    """
    spacing, count = 0.005, 2048
    wavenumber = 2 * np.pi * np.fft.fftfreq(count, spacing)
    kx, ky = np.meshgrid(wavenumber, wavenumber)
    k = np.hypot(kx, ky)
    k[0, 0] = 1.0  # the mean of an infinite layer does not move
    kh = np.minimum(k * thickness, 300.0)
    if sticks:
        transfer = (np.sinh(2 * kh) - 2 * kh) / (np.cosh(2 * kh) + 1 + 2 * kh**2)
    else:
        transfer = 2 * np.sinh(kh) ** 2 / (np.sinh(2 * kh) + 2 * kh)
    along = kx * np.cos(angle) + ky * np.sin(angle)
    across = ky * np.cos(angle) - kx * np.sin(angle)
    square = np.sinc(along * _SQUARE / (2 * np.pi)) * np.sinc(across * _SQUARE / (2 * np.pi))
    spectrum = _PRESSURE * _SQUARE**2 * square * transfer / (2 * shear_modulus * k)
    spectrum[0, 0] = 0.0
    whole = np.fft.fftshift(np.fft.ifft2(spectrum).real) / spacing**2
    at = np.round(x / spacing).astype(int) + count // 2
    return np.asarray(whole[np.ix_(at, at)])


def _rises(stress: xr.DataArray, field: float) -> Array:
    """10-90 % responses, mm, of the left edge in the rows around the middle of the square."""
    rows = stress.sel(
        x=slice(None, field / 2), y=slice(field / 2 - 0.15, field / 2 + 0.15)
    ).transpose("y", "x")
    levels = 0.0, float(rows.sel(x=slice(field / 2 - 0.05, None)).mean())
    return np.array([edge_response(row, levels).rise for row in rows]) * np.cos(_ANGLE)


def _draw(solved: dict[str, xr.Dataset], field: float, path: Any) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    maps = next(iter(solved.values()))
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
    right.plot([-200, 0, 0, 200], [0, 0, -_PRESSURE, -_PRESSURE], color="0.6", label="applied")
    markers = {"algebraic": ("#D55E00", maps["algebraic_axial_stress"])}
    for smoothing, colour in zip(solved, ("#0072B2", "#009E73"), strict=False):
        label = f"computational, {smoothing}"
        markers[label] = (colour, solved[smoothing]["axial_stress"])
    for label, (colour, stress) in markers.items():
        rows = stress.sel(y=slice(field / 2 - 0.15, field / 2 + 0.15))
        x, y = rows["x"] - field / 2, rows["y"] - field / 2
        inwards = x * np.cos(_ANGLE) + y * np.sin(_ANGLE) + _SQUARE / 2
        right.plot(
            1e3 * inwards.values.ravel(),
            rows.transpose(*inwards.dims).values.ravel(),
            ".",
            ms=1.5,
            color=colour,
            label=label,
        )
    right.set(xlabel="distance inwards from the edge (um)", ylabel="axial stress (kPa)")
    right.set(xlim=(-150, 150))
    right.grid(alpha=0.3)
    right.legend(frameon=False, fontsize=8, markerscale=5, loc="lower left")
    with atomic(path, "picture") as temporary:
        figure.savefig(temporary, dpi=150)
