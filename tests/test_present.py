"""Writers against readers that share nothing with them: h5py, xarray, ElementTree, csv, PIL."""

import base64
import contextlib
import csv
import json
import os
import resource
import signal
import xml.etree.ElementTree as ET

import h5py
import matplotlib.image
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from optical_palpation.errors import InputError, OutputError
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import computational_stress
from optical_palpation.palpation.result import ContactState, StressResult
from optical_palpation.present import (
    centre_profiles,
    read_result,
    summarise,
    write_panel,
    write_profiles,
    write_result,
    write_vtk,
)
from optical_palpation.present.figure import new_figure
from optical_palpation.present.output import atomic, check_writable
from optical_palpation.present.panel import draw_panel
from optical_palpation.present.tables import result_columns
from optical_palpation.present.terms import as_given, percent, plain, rounded
from optical_palpation.thickness import thickness_map

X = np.linspace(0, 5, 11)
Y = np.linspace(-1, 3, 9)
WRITERS = {
    write_result: "out.nc",
    write_panel: "out.png",
    write_vtk: "out.vts",
    write_profiles: "out.csv",
}


def stress_field(y, x):
    return -5.0 - 0.5 * x - 0.25 * y * y


def example(nx=6, ny=5, nz=4):
    """A layer in a sheared, compressed state whose every array differs along every axis."""
    y, x = np.meshgrid(Y, X, indexing="ij")
    stress = stress_field(y, x)
    state = np.where(x < 1, ContactState.OPEN, np.where(x < 4, ContactState.STICK, 1))
    grid = ("y", "x")
    maps = xr.Dataset(
        {
            "axial_stress": (grid, stress),
            "algebraic_axial_stress": (grid, 0.8 * stress),
            "contact_pressure": (grid, -stress),
            "traction_x": (grid, 0.1 * x),
            "traction_y": (grid, 0.1 * y),
            "traction_z": (grid, stress),
            "contact_state": (grid, state),
            "window_contact_state": (grid, np.full(state.shape, ContactState.STICK)),
            "loaded_thickness": (grid, 0.4 + 0.01 * x, {"units": "mm"}),
        },
        coords={"y": Y, "x": X},
        attrs={
            "window_force_mN": 120.25,
            "sample_force_mN": -120.25,
            "element_size_mm": (0.1, 0.2, 0.3),
            "edges": "free",
            "converged": True,
            "load_steps": [{"load": 0.5, "newton": 4}, {"load": 1.0, "newton": 5}],
            "nothing": None,
        },
    )
    z, y, x = np.meshgrid(
        np.linspace(0, 0.5, nz), np.linspace(-1, 3, ny), np.linspace(0, 5, nx), indexing="ij"
    )
    displacement = np.stack([0.1 * z, 0.02 * y, -0.2 * z], axis=-1)
    cells = (nz - 1, ny - 1, nx - 1)
    cauchy = np.arange(np.prod(cells) * 6, dtype=float).reshape(*cells, 6)
    node, cell, vector = ("z", "y", "x"), ("cell_z", "cell_y", "cell_x"), ("component",)
    face = np.arange(ny * nx * 3, dtype=float).reshape(ny, nx, 3)
    layer = xr.Dataset(
        {
            "displacement": (node + vector, displacement),
            "position": (node + vector, np.stack([x, y, z], axis=-1) + displacement),
            "cauchy_stress": ((*cell, "tensor"), cauchy),
            "sample_traction": (("y", "x", *vector), face),
            "window_traction": (("y", "x", *vector), -face),
            "sample_contact_state": (("y", "x"), np.arange(ny * nx).reshape(ny, nx) % 3),
            "window_contact_state": (("y", "x"), np.full((ny, nx), 2)),
        },
        coords={"component": ["x", "y", "z"], "tensor": ["xx", "yy", "zz", "yz", "xz", "xy"]},
    )
    return StressResult(maps, layer)


def algebraic_example():
    maps = example().maps[["algebraic_axial_stress", "loaded_thickness"]]
    return StressResult(maps.assign(axial_stress=maps["algebraic_axial_stress"]).assign_attrs({}))


def test_netcdf_round_trip(tmp_path):
    result = example()
    write_result(result, tmp_path / "out.nc")
    back = read_result(tmp_path / "out.nc")
    xr.testing.assert_equal(back.maps, result.maps)
    xr.testing.assert_allclose(back.layer, result.layer, rtol=1e-7)
    assert back.maps.attrs["window_force_mN"] == 120.25
    assert list(back.maps.attrs["element_size_mm"]) == [0.1, 0.2, 0.3]
    assert json.loads(back.maps.attrs["load_steps"])[1] == {"load": 1.0, "newton": 5}
    write_result(back, tmp_path / "again.nc")
    xr.testing.assert_identical(read_result(tmp_path / "again.nc").maps, back.maps)


def test_contact_flags_are_of_the_type_of_the_map(tmp_path):
    at = np.linspace(0, 2, 21)
    loaded = thickness_map(np.full((21, 21), 0.45), x=at, y=at)
    options = {"window_friction": 0.1, "sample_friction": 0.1, "element_size": 0.5}
    options |= {"mesh_check": False, "edge_check": False, "input_errors": None}
    computational_stress(loaded, 0.5, MooneyRivlin(2.23), **options).save(tmp_path / "out.nc")
    with h5py.File(tmp_path / "out.nc") as file:
        state = file["contact_state"]
        assert state.attrs["flag_values"].dtype == state.dtype
        assert list(state.attrs["flag_values"]) == [int(each) for each in ContactState]


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.5, None, "0.500"),
        (0.4976, None, "0.498"),
        (120.0, None, "120"),
        (1234.0, None, "1230"),
        (0.0, None, "0"),
        (5e-6, None, "5.00e-06"),
        (0.5, 0.1, "0.50 ± 0.10"),
        (412.3, 11.7, "412 ± 12"),
    ],
)
def test_numbers_keep_the_digits_they_are_good_for(value, error, text):
    assert plain(rounded(value, error)) == text
    assert as_given(0.05) == "0.05"
    assert percent(0.5) == "50 %"


def test_netcdf_is_written_beside_a_client_of_dask(tmp_path):
    from distributed import Client

    with Client(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None):
        write_result(example(), tmp_path / "out.nc")
    written = read_result(tmp_path / "out.nc").maps["axial_stress"]
    np.testing.assert_array_equal(written, example().maps["axial_stress"])


def test_netcdf_describes_itself(tmp_path):
    write_result(example(), tmp_path / "out.nc")
    with h5py.File(tmp_path / "out.nc") as file:
        assert file["axial_stress"].attrs["units"] == "kPa"
        assert file["loaded_thickness"].attrs["units"] == "mm"
        assert file["x"].attrs["units"] == "mm"
        state = file["contact_state"]
        assert state.dtype == np.int8
        assert state.attrs["flag_meanings"].split() == ["open", "slip", "stick", "glued"]
        assert list(state.attrs["flag_values"]) == [0, 1, 2, 3]
        assert file["axial_stress"].compression == "gzip"
        assert file.attrs["spacing_x_mm"] == pytest.approx(0.5)
        assert file.attrs["origin_y_mm"] == -1
        assert "tension positive" in file.attrs["stress_sign"]
        assert file.attrs["software_version"]
        assert file["layer/position"].attrs["units"] == "mm"
    tree = xr.open_datatree(tmp_path / "out.nc", engine="h5netcdf")
    assert tree["layer/cauchy_stress"].shape == (3, 4, 5, 6)
    tree.close()


def test_algebraic_result_round_trip(tmp_path):
    write_result(algebraic_example(), tmp_path / "out.nc")
    back = read_result(tmp_path / "out.nc")
    assert back.layer is None
    xr.testing.assert_equal(back.maps, algebraic_example().maps)


@pytest.mark.parametrize("content", [None, b"not a file of this kind", "no result"])
def test_what_is_no_result_is_refused(tmp_path, content):
    path = tmp_path / "in.nc"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content:
        xr.Dataset({"other": 1}).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(InputError, match=r"in\.nc"):
        read_result(path)


def changed(maps, **variables):
    return maps.assign({name: maps[name].pipe(change) for name, change in variables.items()})


def unit(factor, name):
    return lambda values: (values * factor).assign_attrs(units=name)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda m: changed(m, axial_stress=unit(1e3, "Pa")), "axial_stress is in 'Pa'.* in kPa"),
        (lambda m: changed(m, contact_pressure=unit(1, "MPa")), "contact_pressure is in 'MPa'"),
        (lambda m: changed(m, loaded_thickness=unit(1e3, "um")), "loaded_thickness is in 'um'"),
        (lambda m: m.assign_coords(x=m.x.pipe(unit(1e3, "um"))), "x is in 'um'.* in mm"),
        (lambda m: m.isel(y=slice(None, None, -1)), "coordinate y must be numbers in mm that rise"),
        (lambda m: m.assign_coords(x=m.x.where(m.x > 1)), "coordinate x must be numbers"),
        (lambda m: m.assign_coords(x=m.x.astype(str)), "coordinate x must be numbers"),
        (lambda m: m.drop_vars("y"), "no coordinate y"),
        (lambda m: m.transpose("x", "y"), r"has the dimensions \(x, y\), not \(y, x\)"),
        (lambda m: m.expand_dims("time"), r"dimensions \(time, y, x\)"),
        (lambda m: changed(m, axial_stress=lambda v: v.astype(str)), "not real numbers"),
        (lambda m: m.assign_attrs(sample_force_mN="76.6"), "sample_force_mN is '76.6', no number"),
        (lambda m: m.drop_attrs().assign_attrs(force_error_mN=3.0), "no force sample_force_mN"),
        (lambda m: m, None),
        (lambda m: m.isel(x=slice(2, 5), y=[1]), None),
        (lambda m: m.drop_attrs(), None),
        (lambda m: m.where(m.x > 1), None),
        (lambda m: m[["axial_stress"]], None),
        (lambda m: m.assign_coords(x=m.x.assign_attrs(units="millimeter")), None),
    ],
)
def test_maps_that_were_altered(tmp_path, change, says):
    write_result(example(), tmp_path / "out.nc")
    maps = change(xr.load_dataset(tmp_path / "out.nc", engine="h5netcdf"))
    maps.to_netcdf(tmp_path / "in.nc", engine="h5netcdf")
    if says is None:
        xr.testing.assert_equal(read_result(tmp_path / "in.nc").maps, maps)
        return
    with pytest.raises(InputError, match=rf"in\.nc: .*{says}"):
        read_result(tmp_path / "in.nc")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda layer: layer.drop_vars("position"), "layer lacks position"),
        (lambda layer: layer.drop_vars("window_contact_state"), "lacks window_contact_state"),
        (lambda layer: layer.drop_vars("component"), "component should be x, y, z, not without"),
        (lambda layer: layer.isel(tensor=[1, 0, 2, 3, 4, 5]), "tensor should be xx, yy, zz"),
        (lambda layer: layer.isel(cell_x=slice(2)), "6 nodes along x, but 2 elements"),
        (
            lambda layer: layer.transpose("node_x", "node_y", "node_z", ...),
            r"position of the layer should be numbers on \(z, y, x, component\)",
        ),
        (lambda layer: changed(layer, cauchy_stress=unit(1e3, "Pa")), "cauchy_stress is in 'Pa'"),
        (lambda layer: changed(layer, position=unit(1e3, "um")), "position is in 'um'"),
    ],
)
def test_a_layer_that_was_altered(tmp_path, change, says):
    write_result(example(), tmp_path / "in.nc")
    tree = xr.load_datatree(tmp_path / "in.nc", engine="h5netcdf")
    layer = tree["layer"].to_dataset(inherit=False)
    tree["layer"] = xr.DataTree(change(layer))
    tree.to_netcdf(tmp_path / "in.nc", engine="h5netcdf")
    with pytest.raises(InputError, match=rf"in\.nc.*{says}"):
        read_result(tmp_path / "in.nc")


@given(data=st.data())
@settings(max_examples=10)
def test_damaged_result_is_refused(tmp_path, data):
    """Cut anywhere, or with a byte changed: refused, or read as far as the change goes unseen."""
    path = tmp_path / "in.nc"
    write_result(example(), path)
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    path.write_bytes(content[:at])
    with pytest.raises(InputError, match=r"in\.nc"):
        read_result(path)
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    with contextlib.suppress(InputError):
        read_result(path)


def vts_arrays(path):
    """Parse a .vts file from the VTK file format's description alone."""
    grid = ET.parse(path).getroot().find("StructuredGrid")
    sizes = [
        b - a + 1 for a, b in np.reshape([int(n) for n in grid.get("WholeExtent").split()], (3, 2))
    ]
    types = {"Float32": "<f4", "Float64": "<f8", "Int8": "<i1"}
    arrays = {}
    for element in grid.iter("DataArray"):
        if element.get("type") == "String":
            text = bytes(int(n) for n in element.text.split())
            assert text.endswith(b"\0")
            arrays[element.get("Name")] = text[:-1].decode()
            continue
        raw = base64.b64decode(element.text)
        assert int.from_bytes(raw[:8], "little") == len(raw) - 8
        data = np.frombuffer(raw[8:], types[element.get("type")])
        arrays[element.get("Name")] = data.reshape(-1, int(element.get("NumberOfComponents")))
    return sizes, arrays


def test_vtk_holds_the_deformed_layer(tmp_path):
    result = example()
    write_vtk(result, tmp_path / "out.vts")
    (nx, ny, nz), arrays = vts_arrays(tmp_path / "out.vts")
    assert (nx, ny, nz) == (6, 5, 4)
    layer = result.layer
    i, j, k = 4, 2, 3  # x, y, z; VTK numbers points with x fastest
    point = i + nx * (j + ny * k)
    assert arrays["position_mm"].shape == (nx * ny * nz, 3)
    node = {"z": k, "y": j, "x": i}
    np.testing.assert_array_equal(arrays["position_mm"][point], layer["position"].isel(node))
    np.testing.assert_array_equal(
        arrays["displacement_mm"][point], layer["displacement"].isel(node)
    )
    np.testing.assert_array_equal(
        arrays["traction_kPa"][point], layer["sample_traction"].isel(y=j, x=i)
    )
    np.testing.assert_array_equal(
        arrays["traction_kPa"][i + nx * j], layer["window_traction"].isel(y=j, x=i)
    )
    assert np.isnan(arrays["traction_kPa"][nx * ny : 2 * nx * ny]).all()
    assert arrays["contact_state"][point, 0] == layer["sample_contact_state"][j, i]
    assert (arrays["contact_state"][nx * ny : 2 * nx * ny] == -1).all()
    cell = i + (nx - 1) * (j + (ny - 1) * 2)
    s = layer["cauchy_stress"].isel(cell_z=2, cell_y=j, cell_x=i)
    xx, yy, zz, yz, xz, xy = s.values
    np.testing.assert_array_equal(
        arrays["cauchy_stress_kPa"][cell], [xx, xy, xz, xy, yy, yz, xz, yz, zz]
    )
    assert json.loads(arrays["provenance"])["window_force_mN"] == 120.25


def test_vtk_holds_the_stiffness_of_each_element(tmp_path):
    result = example()
    cells = ("cell_z", "cell_y", "cell_x")
    shape = [result.layer.sizes[c] for c in cells]
    factor = np.arange(np.prod(shape), dtype=float).reshape(shape)
    layer = result.layer.assign(stiffness=(cells[::-1], factor.T))
    write_vtk(StressResult(result.maps, layer), tmp_path / "out.vts")
    _, arrays = vts_arrays(tmp_path / "out.vts")
    np.testing.assert_array_equal(arrays["stiffness"][:, 0], factor.ravel())


def test_vtk_needs_a_layer(tmp_path):
    with pytest.raises(InputError, match="computational"):
        write_vtk(algebraic_example(), tmp_path / "out.vts")
    assert not list(tmp_path.iterdir())


def test_profiles_run_through_the_centre(tmp_path):
    write_profiles(example(), tmp_path / "out.csv")
    lines = (tmp_path / "out.csv").read_text().splitlines()
    assert "# window_force_mN: 120.25" in lines
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert len(rows) == X.size + Y.size
    for row in rows:
        x, y = float(row["x_mm"]), float(row["y_mm"])
        assert (y == 1.0) if row["along"] == "x" else (x == 2.5)
        assert float(row["axial_stress_kPa"]) == pytest.approx(stress_field(y, x))
        assert float(row["loaded_thickness_mm"]) == pytest.approx(0.4 + 0.01 * x)
        assert int(row["contact_state"]) == (0 if x < 1 else 2 if x < 4 else 1)


@given(nx=st.integers(1, 9), ny=st.integers(1, 9))
def test_centre_is_at_most_half_a_pixel_away(nx, ny):
    maps = xr.Dataset(
        {"loaded_thickness": (("y", "x"), np.zeros((ny, nx)))},
        coords={"y": np.arange(ny) * 0.1, "x": np.arange(nx) * 0.3},
    )
    along_x, along_y = centre_profiles(maps)
    assert along_x.sizes == {"x": nx}
    assert along_y.sizes == {"y": ny}
    assert abs(float(along_x["y"]) - (ny - 1) * 0.05) <= 0.05 + 1e-12
    assert abs(float(along_y["x"]) - (nx - 1) * 0.15) <= 0.15 + 1e-12


@pytest.mark.parametrize("build", [example, algebraic_example])
@pytest.mark.parametrize("suffix", ["png", "pdf", "svg"])
def test_panel_is_drawn(tmp_path, build, suffix):
    path = tmp_path / f"out.{suffix}"
    write_panel(build(), path)
    if suffix == "png":
        picture = matplotlib.image.imread(path)
        assert picture.shape[0] > 800
        assert picture[..., :3].std() > 0.05
    else:
        assert path.stat().st_size > 10_000


def test_a_result_of_the_computational_method_alone_is_shown(tmp_path):
    """As the truth of a virtual experiment is."""
    result = StressResult(example().maps.drop_vars("algebraic_axial_stress"))
    with new_figure() as figure:
        draw_panel(result.maps, figure)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert "Axial stress, computational (kPa)" in titles
    assert not any("algebraic" in title for title in titles)
    write_panel(result, tmp_path / "out.png")
    assert "computational" in result._repr_html_()
    assert "algebraic" not in summarise(result)


def test_both_methods_share_one_colour_scale():
    with new_figure() as figure:
        draw_panel(example().maps, figure)
    shown = {a.get_title(loc="left"): a for a in figure.axes if a.get_title(loc="left")}
    stress = [a.collections[0] for title, a in shown.items() if "stress" in title]
    assert len(stress) == 2
    assert stress[0].get_clim() == stress[1].get_clim()
    axes = next(a for title, a in shown.items() if "Loaded thickness (mm)" in title)
    assert axes.get_aspect() == 1
    # Pixels are areas around their centres.
    np.testing.assert_allclose([*axes.get_xlim(), *axes.get_ylim()], [-0.25, 5.25, -1.25, 3.25])


def test_only_the_layer_is_shown_of_a_map_that_reaches_beyond_it():
    result = example()
    result.maps["loaded_thickness"].attrs["layer_extent"] = [1.0, 5.0, -1.0, 2.0]
    with new_figure() as figure:
        draw_panel(result.maps, figure)
    axes = next(a for a in figure.axes if "Loaded" in a.get_title(loc="left"))
    np.testing.assert_allclose([*axes.get_xlim(), *axes.get_ylim()], [0.75, 5.25, -1.25, 2.25])
    along_x, along_y = centre_profiles(result.maps)
    assert float(along_y["x"]) == 3.0
    assert float(along_x["y"]) == 0.5
    assert along_x["x"].values[0] == 1.0


def test_summary_tells_forces_stress_and_contact():
    text = summarise(example())
    maps = example().maps
    assert "window 120 mN" in text
    area = np.ptp(maps["x"].values) * np.ptp(maps["y"].values)
    mean = float(maps["axial_stress"].integrate(["y", "x"])) / area
    assert f"mean {mean:.3g} kPa" in text
    assert f"{float(maps['axial_stress'].min()):.3g} kPa" in text
    assert "open 15 %" in text  # from the border to between two points: 0.75 of 5 mm
    assert "in contact 85 %" in repr(example())
    assert result_columns(example())["in_contact_fraction"] == pytest.approx(0.85)
    assert "WARNING" not in text
    result = example()
    result.maps.attrs["volume_change_percent"] = -14.2
    assert "changed by -14.2 %" in summarise(result)


@pytest.mark.parametrize("write", WRITERS, ids=lambda write: write.__name__)
def test_a_full_disk_leaves_the_old_file(tmp_path, write):
    """The kernel refuses to let files grow beyond the limit, as a full disk would."""
    path = tmp_path / WRITERS[write]
    path.write_text("old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (512, before[1]))
    try:
        with pytest.raises(OutputError, match="out"):
            write(example(), path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_an_interrupted_writer_leaves_nothing(tmp_path):
    def interrupted():
        with atomic(tmp_path / "out.csv", "profiles") as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing/out.nc", "no folder"),
        ("folder.nc", "is a folder"),
        ("out.txt", "ends in .nc"),
        ("file.nc/out.nc", "no folder"),
    ],
)
def test_unwritable_places_are_refused(tmp_path, name, message):
    (tmp_path / "folder.nc").mkdir()
    (tmp_path / "file.nc").touch()
    with pytest.raises(OutputError, match=message):
        check_writable(tmp_path / name, "result")


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="no file system that refuses files")
def test_a_place_that_takes_no_files_is_refused():
    with pytest.raises(OutputError, match="cannot be written"):
        check_writable("/proc/self/out.nc", "result")
