"""Profiles through the centre of the maps, as tables."""

from __future__ import annotations

import json
from pathlib import Path

import xarray as xr

from optical_palpation.analysis.maps import on_layer
from optical_palpation.palpation.result import StressResult
from optical_palpation.present.output import atomic, provenance
from optical_palpation.present.terms import STATE_NUMBERS

_COLUMNS = {
    "x": "x_mm",
    "y": "y_mm",
    "loaded_thickness": "loaded_thickness_mm",
    "algebraic_axial_stress": "algebraic_axial_stress_kPa",
    "axial_stress": "axial_stress_kPa",
    "contact_pressure": "contact_pressure_kPa",
    "traction_x": "traction_x_kPa",
    "traction_y": "traction_y_kPa",
    "traction_z": "traction_z_kPa",
    "contact_state": "contact_state",
    "window_contact_state": "window_contact_state",
    "edge_influence": "edge_influence",
    "axial_stress_error": "axial_stress_error_kPa",
    "axial_stress_mesh_error": "axial_stress_mesh_error_kPa",
    "sample_youngs_modulus": "sample_youngs_modulus_kPa",
    "sample_modulus_error": "sample_modulus_error",
    "thickness_misfit": "thickness_misfit_mm",
}


def centre_profiles(maps: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Return the row of the maps nearest the layer's centre (along x) and the column (along y)."""
    maps = on_layer(maps)
    x, y = maps["x"].values, maps["y"].values
    along_x = maps.sel(y=(y[0] + y[-1]) / 2, method="nearest")
    along_y = maps.sel(x=(x[0] + x[-1]) / 2, method="nearest")
    return along_x, along_y


def write_profiles(result: StressResult, path: str | Path) -> None:
    """Write the two profiles through the centre as CSV.

    Comment lines (``#``) tell software, parameters and units; the column names carry the unit.
    The first column says along which axis the profile runs.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    maps = result.maps
    names = [name for name in _COLUMNS if name in maps.data_vars]
    with atomic(path, "profiles") as temporary, temporary.open("w", newline="") as file:
        for key, value in provenance(maps).items():
            file.write(f"# {key}: {json.dumps(value)}\n")
        file.write(f"# contact states: {STATE_NUMBERS}\n")
        for axis, profile in zip("xy", centre_profiles(maps), strict=True):
            table = profile[names].reset_coords().to_dataframe().reset_index()[["x", "y", *names]]
            table.insert(0, "along", axis)
            table.rename(columns=_COLUMNS).to_csv(
                file, index=False, header=axis == "x", float_format="%.9g", na_rep="nan"
            )
