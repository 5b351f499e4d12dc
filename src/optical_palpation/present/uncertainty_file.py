"""Error maps as NetCDF files and in words."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from optical_palpation.analysis.maps import area_mean
from optical_palpation.files import netcdf
from optical_palpation.present.output import atomic
from optical_palpation.present.summary import INPUTS
from optical_palpation.present.terms import plain, rounded
from optical_palpation.runtime import software_version

_NAMES = {
    "axial_stress": "axial Cauchy stress at the sample, tension positive",
    "axial_stress_error": "error of the axial stress, all inputs together",
    "contribution": "error of the axial stress by input",
    "force_contribution": "error of the total force by input",
    "nonlinearity": "second difference of the force over twice its first, by input",
}


def write_uncertainty(uncertainty: xr.Dataset, path: str | Path) -> None:
    """Write the result of ``propagate_uncertainty`` as a NetCDF-4 file.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    dataset = uncertainty.copy()
    for name, meaning in _NAMES.items():
        dataset[name].attrs = {"long_name": meaning, **dataset[name].attrs}
    dataset.attrs = {
        "Conventions": "CF-1.11",
        "software": "optical-palpation",
        "software_version": software_version(),
        **uncertainty.attrs,
    }
    compressed = {name: {"zlib": True} for name, v in dataset.data_vars.items() if v.ndim > 1}
    content = netcdf(dataset, encoding=compressed)
    with atomic(path, "result") as temporary:
        temporary.write_bytes(content)


def uncertainty_in_words(uncertainty: xr.Dataset) -> str:
    """Return force and mean stress with their errors, and what contributes to these, as lines."""
    force = rounded(uncertainty.attrs["force_mN"], uncertainty.attrs["force_error_mN"])
    lines = [f"total force {force} mN"]
    for name in uncertainty["input"].values:
        here = uncertainty.sel(input=name)
        of_force = rounded(here["force_contribution"], digits=2)
        of_stress = rounded(area_mean(here["contribution"]), digits=2)
        words = INPUTS.get(str(name), str(name).replace("_", " "))
        lines.append(f"  {words}: ±{of_force} mN, ±{of_stress} kPa on average")
    stress, error = (area_mean(uncertainty[n]) for n in ("axial_stress", "axial_stress_error"))
    lines.append(f"axial stress on average {rounded(stress, error)} kPa")
    return plain("\n".join(lines))
