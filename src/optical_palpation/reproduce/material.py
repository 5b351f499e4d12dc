"""The layer's material, and strain from phase: published data of others."""

from __future__ import annotations

import numpy as np
import pandas as pd

from optical_palpation.friction import axial_strain
from optical_palpation.material import (
    UniaxialFit,
    UniaxialTest,
    find_contact,
    fit_uniaxial,
    read_uniaxial_test,
)
from optical_palpation.material.fitting import LawName
from optical_palpation.present.material_figure import write_material_figure
from optical_palpation.reproduce.record import Part, Row, Setting

_LAWS: tuple[LawName, ...] = ("mooney-rivlin", "neo-hookean", "yeoh", "ogden")


def material(setting: Setting) -> Part:
    """Fits to uniaxial tests of silicones."""
    folder = setting.third_party("uniaxial")
    part = Part(
        "Uniaxial compression of silicones, read, freed of toe and wrong zero, and fitted as by "
        "`optical-palpation material`. The paper does not publish its test; its coefficients are "
        "used throughout this page."
    )

    setting.tell(0.0, "published fits")
    oracle = pd.read_csv(folder / "oracle.csv")
    oracle = oracle[
        (oracle["model"] == "Mooney-Rivlin_2term") & (oracle["has_curve_files"] == "yes")
    ]
    worst = 0.0
    for _, row in oracle.iterrows():
        test = read_uniaxial_test(
            folder / f"abd_{row['phantom']}_mean10.csv", measure=row["stress_measure"]
        )
        found = fit_uniaxial(test.between(1e-9), "mooney-rivlin").parameters
        worst = max(worst, *(abs(found[c] - row[f"{c.upper()}_kPa"]) for c in ("c10", "c01")))
    part.rows.append(
        Row(
            "Dawood et al. 2026",
            f"Mooney-Rivlin coefficients of {len(oracle)} curves of EcoFlex to 67 % strain",
            "published values",
            f"largest difference {1e3 * worst:.2g} Pa",
            "same protocol; most of these fits are unstable (Drucker) and flagged as such",
        )
    )

    setting.tell(0.4, "one sample tested three times")
    fits, raw = [], []
    for number in (1, 2, 3):
        test = read_uniaxial_test(folder / f"jones_SmoothOn45_11_S1T{number}.csv")
        raw.append(fit_uniaxial(test).initial_youngs_modulus)
        fits.append(_corrected(test)[0])
    moduli = [fit.initial_youngs_modulus for fit in fits]
    part.rows.append(
        Row(
            "Jones et al., SmoothOn45",
            "initial Young's modulus of one sample tested three times, Mooney-Rivlin, kPa",
            "one value",
            ", ".join(f"{m:.1f}" for m in moduli),
            f"spread {np.ptp(moduli) / np.mean(moduli):.1%} after the contact was found; as "
            f"recorded {', '.join(f'{m:.0f}' for m in raw)}",
        )
    )

    setting.tell(0.7, "a layer material")
    test = read_uniaxial_test(folder / "jones_Layer3_2nd0_S1T1.csv")
    contact = find_contact(test)
    clean = test.from_contact(contact.strain, contact.toe_end)
    fits = [fit_uniaxial(clean, law) for law in _LAWS]
    picture = "material.png"
    write_material_figure(fits, setting.folder / picture, recorded=test, contact=contact)
    part.pictures.append((picture, "Wacker P7676, a layer material, and four laws fitted to it."))
    c10, c01 = (fits[0].intervals[name] for name in ("c10", "c01"))
    part.rows.append(
        Row(
            "Section 3",
            "C10, C01 of the layer and their 95 % intervals, kPa",
            "2.23 ± 0.04, 0.70 ± 0.03 (its own mixture)",
            f"{_pm(c10)}, {_pm(c01)} (P7676, 50 % strain)",
            "other mixture, same kind of silicone: half as stiff. Intervals are those of one test",
        )
    )
    return part


def _corrected(test: UniaxialTest) -> tuple[UniaxialFit, UniaxialTest]:
    contact = find_contact(test)
    clean = test.from_contact(contact.strain, contact.toe_end)
    return fit_uniaxial(clean, "mooney-rivlin"), clean


def _pm(interval: tuple[float, float]) -> str:
    low, high = interval
    return f"{(low + high) / 2:.3f} ± {(high - low) / 2:.3f}"


def phase(setting: Setting) -> Part:
    """Strain of published complex OCT."""
    with np.load(setting.third_party("phase/lpl2024_figure5.npz")) as data:
        before, after = data["before"], data["after"]
        rows = data["layer_rows"]
        optics = {
            "spacing": float(data["dz_um"]) / 1e3,
            "wavelength": float(data["wavelength_um"]) / 1e3,
            "refractive_index": float(data["refractive_index"]),
        }
    part = Part(
        "Simulated complex OCT of three layers before and after a compression, published with the "
        "strains that made it. Displacement profiles of a friction measurement come from the same "
        "phases."
    )
    for layer, stated in ((0, 1.01e-2), (1, 9.1e-4)):
        setting.tell(layer / 2, f"layer {layer + 1}")
        first, last = rows[layer]
        strain, error = axial_strain(before[first:last], after[first:last], **optics)
        part.rows.append(
            Row(
                "Zykov et al. 2024, figure 5",
                f"compressive strain of layer {layer + 1}",
                f"{stated:.3g}",
                f"{-strain:.4g} ± {error:.1g}",
                f"{-strain / stated - 1:+.1%}; differences between neighbouring pixels would be "
                "36 to 47 % too small, for they share the point-spread function",
            )
        )
    return part
