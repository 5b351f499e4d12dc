"""A result in a few lines of words."""

from __future__ import annotations

import numpy as np

from optical_palpation.palpation.result import ContactState, StressResult
from optical_palpation.present.profiles import on_layer


def summarise(result: StressResult) -> str:
    """Return forces, stress and contact of a result as readable lines.

    Total forces in mN, mean and peak axial stress in kPa (the peak is the most compressed pixel,
    the 99th percentile of compression beside it tells whether it stands alone), and the shares
    of the map that are in contact.
    """
    maps = on_layer(result.maps)
    stress = maps["axial_stress"].values
    lines = []
    forces = [
        f"{side} {maps.attrs[key]:.1f} mN"
        for side in ("window", "sample")
        if (key := f"{side}_force_mN") in maps.attrs
    ]
    if forces:
        lines.append("total force: " + ", ".join(forces))
    lines.append(
        f"axial stress: mean {np.nanmean(stress):.3f} kPa, 99 % of the map above "
        f"{np.nanpercentile(stress, 1):.3f} kPa, most compressed {np.nanmin(stress):.3f} kPa"
    )
    state = maps["contact_state"].values
    shares = [
        f"{kind.name.lower()} {np.mean(state == kind):.1%}"
        for kind in reversed(ContactState)
        if np.any(state == kind)
    ]
    lines.append("contact with the sample: " + ", ".join(shares))
    if "filled_share" in maps.attrs:
        lines.append(
            f"filled pixels: {maps.attrs['filled_share']:.2%} (missing "
            f"{maps.attrs['missing_share']:.2%}, spikes {maps.attrs['spike_share']:.2%})"
        )
    return "\n".join(lines)
