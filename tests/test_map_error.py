"""The error of a map, of inputs and mesh together."""

import numpy as np
import pytest
import xarray as xr

from optical_palpation.analysis import Region, compare_results, region_statistics
from optical_palpation.analysis.maps import map_error
from optical_palpation.palpation import StressResult
from optical_palpation.present.report.content import map_entries
from optical_palpation.present.summary import stress_figures


def maps(**errors):
    axis = np.arange(5) * 0.1
    stress = xr.DataArray(np.full((5, 5), -10.0), {"y": axis, "x": axis}, ("y", "x"))
    thickness = xr.full_like(stress, 0.4)
    names = {"axial_stress": stress, "contact_pressure": -stress, "loaded_thickness": thickness}
    return xr.Dataset(names | {name: xr.full_like(stress, e) for name, e in errors.items()})


def test_inputs_and_mesh_add_in_quadrature():
    both = maps(axial_stress_error=0.3, axial_stress_mesh_error=0.4)
    np.testing.assert_allclose(map_error(both, "axial_stress"), 0.5)
    assert stress_figures(StressResult(both), "computational")[2] == "−10.00 ± 0.50"
    region = Region.rectangle("r", 0.0, 0.4, 0.0, 0.4)
    assert float(region_statistics(both, [region])["mean_error"][0]) == pytest.approx(0.5)
    compared = compare_results({"a": both, "b": both})
    np.testing.assert_allclose(compared["difference_error"], np.sqrt(0.5))


def test_the_page_counts_with_the_error_of_its_tables():
    both = maps(axial_stress_error=0.3, axial_stress_mesh_error=0.4)
    both["axial_stress"][2, 2] = -11.0
    shown = map_entries(StressResult(both), None, None, {}, {}, [])
    key = shown["maps"]["computational"]["error"]
    assert key == shown["profiles"]["stress"]["errors"]["computational"]
    assert key not in ("axial_stress_error", "axial_stress_mesh_error")
    inputs = both.drop_vars("axial_stress_mesh_error")
    alone = map_entries(StressResult(inputs), None, None, {}, {}, [])
    assert alone["maps"]["computational"]["error"] == "axial_stress_error"


def test_what_is_unknown_is_not_made_up():
    assert map_error(maps(), "axial_stress") is None
    assert map_error(maps(axial_stress_mesh_error=0.4), "axial_stress") is None
    unknown = maps(axial_stress_error=0.3, axial_stress_mesh_error=np.nan)
    np.testing.assert_allclose(map_error(unknown, "axial_stress"), 0.3)


def test_bands_contain_the_mesh():
    bands = maps(axial_stress_error=0.3, axial_stress_mesh_error=0.4)
    bands.attrs["error_bands"] = "{}"
    np.testing.assert_allclose(map_error(bands, "axial_stress"), 0.3)
