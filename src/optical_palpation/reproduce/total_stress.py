"""Figure 2b: total stress of a flat layer at six conditions of friction and load."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import brentq

from optical_palpation.errors import ConvergenceError
from optical_palpation.friction import slab_profile
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import computational_stress
from optical_palpation.present.output import atomic
from optical_palpation.reproduce.record import Part, Row, Setting
from optical_palpation.thickness import thickness_map

_MATERIAL = MooneyRivlin(2.23, 0.703)
_SIZE, _THICKNESS = 5.0, 0.4769376  # mm; the layer of the published input
_SAMPLE_FRICTION = 0.1
_CONDITIONS = (  # lubrication, load in mN, friction found by the paper
    ("low", 500.0, 0.12),
    ("medium", 500.0, 0.15),
    ("high", 500.0, 0.30),
    ("low", 1500.0, 0.20),
    ("medium", 1500.0, 0.24),
    ("high", 1500.0, 0.30),
)


def total_stress(setting: Setting) -> Part:
    """Mean stress by both methods against load over area, with error bars for friction."""
    conditions = _CONDITIONS[:1] if setting.quick else _CONDITIONS
    element, elements = (0.5, 2) if setting.quick else (0.125, 5)
    part = Part(
        f"A flat layer of {_SIZE:g} x {_SIZE:g} x {_THICKNESS:.3g} mm pressed with the paper's "
        "loads. The thickness at which it bears the load at the paper's friction (0.1 at the "
        "sample) stands for the measured one; it comes from a solution on another, graded grid. "
        "From this thickness alone: both methods, and the computational one with both "
        "coefficients 0.05 smaller and larger, as the paper's error bars. The bars are wider than "
        "the paper's, because stress in an incompressible layer ten times as wide as thick grows "
        "almost exponentially with friction; the published code's default, K/mu of 20, damps that. "
        "The same growth turns the friction laws of the two solutions, smoothed over slips of 0.3 "
        "and 1 um, into differences of several per cent. The paper does not tell the layer's size."
    )
    results: list[dict[str, Any]] = []
    for number, (name, load, mu) in enumerate(conditions):

        def tell(share: float, what: str, number: int = number, name: str = name) -> None:
            setting.tell((number + share) / len(conditions), f"{name} friction: {what}")

        tell(0.0, f"thickness under {load / 1e3:g} N")
        try:
            thickness = _thickness_under(load, mu, elements)
        except ConvergenceError as failure:
            results.append({"name": name, "load": load, "mu": mu, "failure": str(failure)})
            continue
        area = _SIZE**2 * _THICKNESS / thickness  # incompressible
        strain = thickness / _THICKNESS - 1
        values = {}
        for step, change in enumerate((0.0, 0.05, -0.05)):
            tell((1 + step) / 4, f"computational, friction {mu + change:g}")
            values[change] = _force(thickness, mu, change, element, setting) / area
        results.append(
            {
                "name": name,
                "load": load,
                "mu": mu,
                "strain": -strain,
                "expected": load / area,
                "algebraic": -float(_MATERIAL.uniaxial_stress(strain, "true")),
                "computational": values[0.0],
                "high": values[0.05],
                "low": values[-0.05],
            }
        )
    good = [r for r in results if "failure" not in r]
    picture = "figure-2b.png"
    _draw(good, setting.folder / picture)
    part.pictures.append((picture, "Total stress at the paper's loads (figure 2b)."))
    for r in results:
        where = f"Figure 2b, {r['load'] / 1e3:g} N, {r['name']} friction ({r['mu']:g})"
        if "failure" in r:
            part.rows.append(Row(where, "total stress, kPa", "", "not reached", r["failure"]))
            continue
        expected = r["expected"]
        bound = "15 %" if r["load"] > 1000 else "5 %"
        claim = f"{expected:.1f} (load over area); computational within {bound}"
        if (r["name"], r["load"]) == ("high", 1500.0):
            claim = f"{expected:.1f} (load over area); computational off, compressed beyond 50 %"
        part.rows.append(
            Row(
                where,
                "total stress, kPa",
                claim,
                f"{_computed(r)}; algebraic {r['algebraic']:.1f}",
                f"computational {_percent(r['computational'] / expected - 1)}, algebraic "
                f"{_percent(r['algebraic'] / expected - 1)}; compressed by {r['strain']:.0%} "
                f"(paper: {'10 to 20' if r['load'] < 1000 else 'up to more than 50'} %)",
            )
        )
    return part


def _computed(result: dict[str, Any]) -> str:
    middle, high, low = (result[key] for key in ("computational", "high", "low"))
    if np.isnan(middle):
        return "full load not reached"
    ends = f"{low:.1f}" if np.isfinite(low) else "not reached"
    ends += " to " + (f"{high:.1f}" if np.isfinite(high) else "not reached")
    return f"{middle:.1f} ({ends} for friction ±0.05)"


def _percent(share: float) -> str:
    return f"{share:+.1%}" if np.isfinite(share) else "—"


def _thickness_under(load: float, mu: float, elements: int) -> float:
    """Loaded thickness at which the layer bears the load, mm."""

    def excess(compression: float) -> float:
        slab = slab_profile(
            mu,
            layer_size=(_SIZE, _SIZE),
            initial_thickness=_THICKNESS,
            loaded_thickness=_THICKNESS * (1 - compression),
            material=_MATERIAL,
            region=0.0,
            sample_friction=_SAMPLE_FRICTION,
            elements=elements,
        )
        return float(np.log(slab.attrs["force_mN"] / load))

    low, high = (0.1, 0.35) if load < 1000 else (0.25, 0.42)
    return _THICKNESS * (1 - float(brentq(excess, low, high, xtol=2e-3)))


def _force(thickness: float, mu: float, change: float, element: float, setting: Setting) -> float:
    """Force on the layer, mN, both coefficients changed; NaN if the load is not reached."""
    x = np.linspace(0.0, _SIZE, 41)
    loaded = thickness_map(np.full((41, 41), thickness), x=x, y=x, where="flat layer")
    try:
        result = computational_stress(
            loaded,
            _THICKNESS,
            _MATERIAL,
            window_friction=mu + change,
            sample_friction=_SAMPLE_FRICTION + change,
            element_size=(element, element, _THICKNESS / 4),
            mesh_check=False,  # the force alone
            edge_check=False,
            input_errors=None,
            threads=setting.threads,
        )
    except ConvergenceError:
        return float("nan")
    return float(result.maps.attrs["window_force_mN"])


def _draw(results: list[dict[str, Any]], path: Any) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    at = np.arange(len(results))

    def column(name: str) -> np.ndarray:
        return np.array([r[name] for r in results])

    middle = column("computational")
    axes.bar(at - 0.27, column("expected"), 0.25, color="0.7", label="expected (load over area)")
    axes.bar(at, column("algebraic"), 0.25, color="#D55E00", label="algebraic")
    axes.bar(
        at + 0.27,
        middle,
        0.25,
        color="#0072B2",
        yerr=np.nan_to_num([middle - column("low"), column("high") - middle]),
        capsize=3,
        label="computational, friction ±0.05",
    )
    labels = [f"{r['load'] / 1e3:g} N\n{r['name']} ({r['mu']:g})" for r in results]
    axes.set_xticks(at, labels)
    axes.set(ylabel="total stress (kPa)")
    axes.grid(axis="y", alpha=0.3)
    axes.legend(frameon=False)
    with atomic(path, "picture") as temporary:
        figure.savefig(temporary, dpi=150)
