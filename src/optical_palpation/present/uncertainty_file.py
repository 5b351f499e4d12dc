"""Error maps as NetCDF files."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from optical_palpation.present.output import atomic
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
    content = dataset.to_netcdf(engine="h5netcdf", encoding=compressed)
    with atomic(path, "result") as temporary:
        temporary.write_bytes(content)
