"""A result in a few lines of words."""

from __future__ import annotations

import numpy as np

from optical_palpation.palpation.result import ContactState, StressResult


def summarise(result: StressResult) -> str:
    """Return forces, stress and contact of a result as readable lines.

    Total forces in mN, mean and peak axial stress in kPa (the peak is the most compressed pixel,
    the 99th percentile of compression beside it tells whether it stands alone), and the shares
    of the map that are in contact.
    """
    maps = result.maps
    stress = maps["axial_stress"].values
    lines = []
    forces = [
        f"{side} {float(maps.attrs[key]):.1f} mN"
        for side in ("window", "sample")
        if (key := f"{side}_force_mN") in maps.attrs
    ]
    if forces:
        lines.append("total force: " + ", ".join(forces))
    strongest, percentile = np.nanmin(stress), np.nanpercentile(stress, 1)
    lines.append(
        f"axial stress: mean {np.nanmean(stress):.3f} kPa, 99 % of the map above "
        f"{percentile:.3f} kPa, most compressed {strongest:.3f} kPa"
    )
    state = maps["contact_state"].values
    shares = ", ".join(
        f"{kind.name.lower()} {np.mean(state == kind):.1%}"
        for kind in reversed(ContactState)
        if np.any(state == kind)
    )
    lines.append(f"contact with the sample: {shares}")
    return "\n".join(lines)
