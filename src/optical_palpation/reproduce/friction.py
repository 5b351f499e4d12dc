"""Figure 2a: friction from the profile of displacement, on simulated phase-sensitive OCT."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.experiment.synthetic_oct import Optics, complex_pair
from optical_palpation.friction import (
    FrictionEstimate,
    calibration_curves,
    displacement_profile,
    estimate_friction,
    slab_profile,
)
from optical_palpation.material import MooneyRivlin
from optical_palpation.present.output import atomic
from optical_palpation.reproduce.record import Part, Row, Setting

_PIXEL = 0.004  # axial, mm
_WINDOW = 0.04  # depth of the window's face, mm


def friction(setting: Setting) -> Part:
    """Calibration curves, and coefficients recovered from noisy phases."""
    layer: dict[str, Any] = {
        "layer_size": (5.0, 5.0),
        "initial_thickness": 0.5,
        "loaded_thickness": 0.45,
        "material": MooneyRivlin(2.23, 0.703),
        "region": 4.6,
    }
    coefficients, truths, elements = [0.02, 0.1, 0.2, 0.3, 0.4, 0.44], [0.05, 0.15, 0.25, 0.4], 6
    if setting.quick:
        layer |= {"layer_size": (2.0, 2.0), "region": 1.6}
        coefficients, truths, elements = [0.05, 0.2, 0.35], [0.15], 2
    steps = len(coefficients) + len(truths)
    done = 0

    def tell(what: str) -> None:
        setting.tell(done / steps, what)

    def on_curve(mu: float) -> None:
        nonlocal done
        done += 1
        tell(f"calibration, friction {mu:g} done")

    tell("calibration")
    curves = calibration_curves(coefficients, elements=elements, on_curve=on_curve, **layer)
    estimates = {}
    for mu in truths:
        tell(f"measurement, friction {mu:g}")
        slab = slab_profile(mu, elements=elements + 1, **layer)
        estimates[mu] = estimate_friction(_measured(slab), curves)
        done += 1

    part = Part(
        f"A layer of {layer['layer_size'][0]:g} x {layer['layer_size'][1]:g} x 0.5 mm, pressed to "
        f"0.45 mm and then by 0.5 um more; displacement averaged over {layer['region']:g} mm. "
        "Sample friction 0.1. The measurements are simulated: complex OCT at 10 dB signal to "
        "noise, 32 x 32 A-scans, of layers solved on another grid than the curves."
    )
    picture = "figure-2a.png"
    _draw(curves, estimates, setting.folder / picture)
    part.pictures.append(
        (picture, "Calibration curves and simulated measurements (figure 2a of the paper).")
    )
    four = curves.sel(friction=slice(0.1, 0.4))
    middle = four.sel(depth=0.5, method="nearest").values
    gap = float(np.max(np.diff(four.sel(depth=slice(0.15, 0.75)).values, axis=0)))
    part.rows.append(
        Row(
            "Figure 2a",
            "curves for friction 0.1, 0.2, 0.3, 0.4: separate and in order",
            "in order, each below the other",
            ("in order" if gap < 0 else "NOT in order")
            + f"; at half depth {', '.join(f'{v:.3f}' for v in middle)}",
            f"smallest distance of neighbours {-gap:.3f} from 15 to 75 % depth. Only averaged over "
            "most of the layer are they in order: in its middle the layer sticks however small "
            "the friction",
        )
    )
    found = ", ".join(f"{mu:g} as {e.coefficient:.3f}" for mu, e in estimates.items())
    worst = max(abs(e.coefficient - mu) for mu, e in estimates.items())
    part.rows.append(
        Row(
            "Section 4",
            "coefficient recovered from noisy phases",
            "0.12 to 0.30 told apart; ±0.05 taken as error",
            found,
            f"largest error {worst:.3f}; real layers add those of material, thickness and sample "
            "friction",
        )
    )
    return part


def _measured(slab: xr.Dataset) -> xr.Dataset:
    """Profile that phase-sensitive OCT of the slab would give."""
    thickness = 0.45
    z = _PIXEL * np.arange(140)
    order = np.argsort(slab["depth"].values)
    depth, increment = slab["depth"].values[order], slab["increment"].values[order]
    u = np.interp((z - _WINDOW) / thickness, depth, increment)
    u = np.broadcast_to(u[:, None, None], (z.size, 32, 32)).copy()
    before, after = complex_pair(u, spacing=(_PIXEL, 0.01, 0.01), snr_db=10.0)
    optics = Optics()
    return displacement_profile(
        before,
        after,
        spacing=_PIXEL,
        wavelength=optics.wavelength,
        refractive_index=optics.refractive_index,
        window_depth=_WINDOW,
        sample_depth=_WINDOW + thickness,
    )


def _draw(curves: xr.DataArray, estimates: dict[float, FrictionEstimate], path: Any) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for mu in curves["friction"].values:
        curve = curves.sel(friction=mu)
        axes.plot(curve["depth"], curve - curve["depth"], color="black", lw=1.0)
        at = curve.sel(depth=0.5, method="nearest")
        axes.annotate(
            f"{mu:g}", (0.5, float(at) - 0.5), fontsize=8, ha="center", va="bottom", color="black"
        )
    axes.axhline(0.0, color="0.5", ls="--", lw=1.0, label="no friction at either side")
    for (mu, estimate), colour in zip(
        estimates.items(), ("#0072B2", "#D55E00", "#009E73", "#CC79A7"), strict=False
    ):
        profile = estimate.profile
        axes.plot(
            profile["depth"],
            profile["measured"] - profile["depth"],
            ".",
            ms=3,
            color=colour,
            label=f"friction {mu:g}, found as {estimate.coefficient:.3f}",
        )
    axes.set(
        xlabel="depth in the layer (0: window, 1: sample)",
        ylabel="normalised incremental displacement − depth",
        xlim=(0, 1),
    )
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=9)
    with atomic(path, "picture") as temporary:
        figure.savefig(temporary, dpi=150)
