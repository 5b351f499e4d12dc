"""Every format gives back the same map, the right way round, on the right coordinates."""

import struct

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
import xarray as xr
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.signal import find_peaks

import map_files
from optical_palpation.errors import InputError, OutputError
from optical_palpation.thickness import (
    clean_thickness,
    read_height_map,
    read_thickness_map,
    thickness_map,
    write_thickness_map,
)


def write_matlab_73(path, **variables):
    """Write what MATLAB's ``save -v7.3`` writes: column-major arrays in HDF5 behind a header."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in variables.items():
            kind = {"b": "logical", "f": "single" if values.dtype == "f4" else "double"}
            dataset = file.create_dataset(
                name,
                data=values.T.astype("u1") if values.dtype.kind == "b" else values.T,
            )
            dataset.attrs["MATLAB_class"] = np.bytes_(kind.get(values.dtype.kind, "int32"))
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


WRITERS = {
    "v5.mat": lambda path, map_: scipy.io.savemat(path, {"L1": map_}),
    "v5-compressed.mat": lambda path, map_: scipy.io.savemat(
        path, {"L1": map_}, do_compression=True
    ),
    "v73.mat": lambda path, map_: write_matlab_73(path, L1=map_),
    "map.npy": np.save,
    "fortran.npy": lambda path, map_: np.save(path, np.asfortranarray(map_)),
    "map.npz": lambda path, map_: np.savez(path, L1=map_),
    "compressed.npz": lambda path, map_: np.savez_compressed(path, L1=map_),
    "comma.csv": lambda path, map_: np.savetxt(path, map_, fmt="%.17g", delimiter=","),
    "semicolon.csv": lambda path, map_: np.savetxt(path, map_, fmt="%.17g", delimiter=";"),
    "tab.txt": lambda path, map_: np.savetxt(path, map_, fmt="%.17g", delimiter="\t"),
    "space.txt": lambda path, map_: np.savetxt(
        path, map_, fmt="%.17g", header="from a script", footer="end"
    ),
    "map.tif": tifffile.imwrite,
    "map.nc": lambda path, map_: xr.Dataset({"L1": (("y", "x"), map_)}).to_netcdf(
        path, engine="h5netcdf"
    ),
    "classic.nc": lambda path, map_: xr.Dataset({"L1": (("y", "x"), map_)}).to_netcdf(
        path, engine="scipy"
    ),
    "transposed.nc": lambda path, map_: xr.Dataset({"L1": (("x", "y"), map_.T)}).to_netcdf(
        path, engine="h5netcdf"
    ),
}
HDF5 = {"v73.mat", "map.nc", "transposed.nc"}


def _has_marks(map_):
    """Whether the largest value occurs several times, far above the others: that is refused."""
    largest = np.nanmax(map_)
    return (map_ == largest).sum() > 1 and largest > 10 * np.nanmedian(map_)


# No wider in range than text and single precision carry; NaN marks missing pixels.
MAPS = hnp.arrays(
    st.sampled_from([np.float32, np.float64]),
    hnp.array_shapes(min_dims=2, max_dims=2, min_side=2, max_side=7),
    elements=st.one_of(
        st.floats(2.0**-10, 2.0**6, width=32),
        st.floats(2.0**-10, 2.0**6, width=32),
        st.just(float("nan")),
    ),
).filter(lambda map_: np.isfinite(map_).mean() >= 0.5 and not _has_marks(map_))


@pytest.mark.parametrize("name", WRITERS)
@given(values=MAPS)
def test_values_and_orientation_survive_every_format(tmp_path, name, values):
    # Lines of evenly spaced numbers in text are refused: they may be labels.
    assume(not name.endswith(("csv", "txt")) or not map_files.may_be_labels(values))
    WRITERS[name](tmp_path / name, values)
    rows, columns = values.shape
    result = read_thickness_map(tmp_path / name, field_of_view=(columns - 1, 2 * (rows - 1)))
    assert result.dims == ("y", "x")
    assert result.dtype == np.float64
    np.testing.assert_array_equal(result.values, values.astype(np.float64))
    np.testing.assert_allclose(result.x, np.arange(columns))
    np.testing.assert_allclose(result.y, 2 * np.arange(rows))
    assert result.attrs["missing_share"] == pytest.approx(np.isnan(values).mean())


@given(values=MAPS, data=st.data())
def test_written_map_is_read_back_whole(tmp_path, values, data):
    steps = st.floats(0.03, 1.0)  # positions that jump are refused
    x, y = (
        -1.0 + np.cumsum(data.draw(st.lists(steps, min_size=size, max_size=size)))
        for size in values.shape[::-1]
    )
    extent = [x[0], x[-1], y[0], y[-1]]
    if values.shape[1] > 2:
        extent[1] = x[-2]
    original = thickness_map(values, x=x, y=y, layer_extent=extent)
    write_thickness_map(original, tmp_path / "map.nc")
    result = read_thickness_map(tmp_path / "map.nc")
    xr.testing.assert_equal(result, original)
    assert list(result.attrs["layer_extent"]) == extent
    assert [path.name for path in tmp_path.iterdir()] == ["map.nc"]


def test_cleaned_map_is_written_with_units_and_provenance(tmp_path):
    values = np.full((6, 5), 0.4)
    values[2, 2] = np.nan
    cleaned = clean_thickness(thickness_map(values, pixel_spacing=(0.01, 0.02)))
    write_thickness_map(cleaned, tmp_path / "clean.nc")
    with xr.open_dataset(tmp_path / "clean.nc") as stored:
        assert stored["thickness"].units == stored["x"].units == stored["y"].units == "mm"
        assert stored["filled"].values[2, 2]
        assert stored.attrs["filled_share"] == pytest.approx(1 / 30)
        assert stored.attrs["software"] == "optical-palpation"
        assert stored.attrs["software_version"]
    # What was made up is not read back as if it had been measured.
    again = clean_thickness(read_thickness_map(tmp_path / "clean.nc"))
    xr.testing.assert_equal(again["filled"], cleaned["filled"])
    xr.testing.assert_allclose(again["thickness"], cleaned["thickness"])


def test_of_several_maps_the_one_called_thickness_is_taken(tmp_path):
    values = np.array([[0.4, 0.41, 0.42], [0.43, 0.44, 0.45]])
    np.savez(tmp_path / "maps.npz", depth=2 * values, thickness=values, quality=values / 2)
    result = read_thickness_map(tmp_path / "maps.npz", field_of_view=(1, 1))
    np.testing.assert_array_equal(result, values)


def test_failed_writing_leaves_nothing(tmp_path):
    map_ = thickness_map(np.ones((3, 3)), field_of_view=(1, 1))
    with pytest.raises(OutputError, match="missing"):
        write_thickness_map(map_, tmp_path / "missing" / "map.nc")
    (tmp_path / "folder.nc").mkdir()
    with pytest.raises(OutputError, match=r"folder\.nc"):
        write_thickness_map(map_, tmp_path / "folder.nc")
    assert [path.name for path in tmp_path.iterdir()] == ["folder.nc"]


def test_suffix_does_not_matter(tmp_path):
    values = np.array([[0.4, 0.41, 0.42], [0.43, 0.44, 0.45]])
    for name, write in WRITERS.items():
        write(tmp_path / name, values)
        (tmp_path / name).rename(tmp_path / "export.dat")
        result = read_thickness_map(tmp_path / "export.dat", field_of_view=(1, 1))
        np.testing.assert_array_equal(result, values)


def test_coin_is_the_right_way_round(shared_data, tmp_path):
    path = shared_data / "layers" / "coin_5c_1-thickness.mat"
    coin = read_thickness_map(path, field_of_view=(5, 5))
    with h5py.File(path) as file:
        as_matlab_shows_it = file["in_L0"][()].T
    scipy.io.savemat(tmp_path / "v5.mat", {"in_L0": as_matlab_shows_it})
    xr.testing.assert_equal(coin, read_thickness_map(tmp_path / "v5.mat", field_of_view=(5, 5)))
    assert not np.array_equal(coin.values, coin.values.T)
    assert coin.shape == (502, 502)
    assert (float(coin.x[0]), float(coin.x[-1])) == (0.0, 5.0)
    assert coin.attrs["source_variable"] == "in_L0"
    assert len(coin.attrs["source_sha256"]) == 64


def test_map_with_coordinates_reaches_beyond_the_layer(shared_data):
    path = shared_data / "layers" / "sinusoid_simulated_L1.npz"
    result = read_thickness_map(path, layer_extent=(0, 5, 0, 5))
    stored = np.load(path)
    np.testing.assert_array_equal(result, stored["L1_mm"])
    np.testing.assert_array_equal(result.x, stored["x_mm"])
    assert result.attrs["layer_extent"] == [0, 5, 0, 5]
    # The sample's surface is 0.125 sin(1.8 pi x): peaks along x and none along y. Compressed, the
    # sample has spread by a tenth.
    inner = result.sel(x=slice(0.5, 4.5), y=slice(0.5, 4.5))
    peaks, _ = find_peaks(-inner.sel(y=2.5).values)
    np.testing.assert_allclose(inner.x[peaks], [2.5 / 1.8, 2.5, 6.5 / 1.8], atol=0.14)
    assert len(find_peaks(-inner.sel(x=2.5).values, prominence=0.01)[0]) == 0


def test_csv_takes_comments_header_empty_cells_and_blank_lines(tmp_path):
    (tmp_path / "map.csv").write_text(
        "\ufeff% exported 2020\ncolumn a;column b;column c\n\n0.4; 0.41;NaN # first\n;4.3e-1;NA\r\n"
    )
    result = read_thickness_map(tmp_path / "map.csv", field_of_view=(1, 1))
    np.testing.assert_array_equal(result, [[0.4, 0.41, np.nan], [np.nan, 0.43, np.nan]])


@pytest.mark.parametrize(
    ("name", "attributes", "length_unit"),
    [
        ("L1_um", {}, None),
        ("L1", {"units": "um"}, None),
        ("L1", {"units": "micrometers"}, None),
        ("L1", {"units": "µm"}, "um"),
        ("L1", {}, "um"),
    ],
)
def test_micrometres_from_name_attribute_or_user(tmp_path, name, attributes, length_unit):
    values = np.array([[400.0, 410.0], [420.0, 430.0]])
    xr.Dataset({name: (("y", "x"), values, attributes)}).to_netcdf(
        tmp_path / "map.nc", engine="h5netcdf"
    )
    result = read_thickness_map(tmp_path / "map.nc", length_unit=length_unit, field_of_view=(5, 5))
    np.testing.assert_allclose(result, values / 1000, rtol=1e-15)
    assert result.attrs["units"] == "mm"
    assert result.attrs["source_length_unit"] == "um"


@pytest.mark.parametrize("engine", ["h5netcdf", "scipy"])
def test_packed_netcdf_with_missing_values(tmp_path, engine):
    values = np.array([[400.0, np.nan], [420.0, 430.0]])
    xr.Dataset({"L1": (("y", "x"), values, {"units": "um"})}).to_netcdf(
        tmp_path / "map.nc",
        engine=engine,
        encoding={"L1": {"dtype": "i2", "scale_factor": 0.5, "_FillValue": -1}},
    )
    result = read_thickness_map(tmp_path / "map.nc", field_of_view=(5, 5))
    np.testing.assert_allclose(result, values / 1000)


def test_coordinates_with_units_and_descending_order(tmp_path):
    values = np.arange(1.0, 7.0).reshape(2, 3)
    xr.Dataset(
        {"L1": (("y", "x"), values, {"units": "mm"})},
        {"x": ("x", [0.0, 500.0, 1000.0], {"units": "um"}), "y": ("y", [2.0, 1.0])},
    ).to_netcdf(tmp_path / "map.nc", engine="h5netcdf")
    result = read_thickness_map(tmp_path / "map.nc")
    np.testing.assert_allclose(result.x, [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(result.y, [1.0, 2.0])
    np.testing.assert_array_equal(result, values[::-1])


def test_matlab_coordinates_as_row_and_column_vectors(tmp_path):
    values = np.arange(1.0, 7.0).reshape(2, 3)
    scipy.io.savemat(
        tmp_path / "v5.mat",
        {"L1_mm": values, "x_um": np.array([[0.0, 10.0, 20.0]]), "y_um": np.array([[5.0], [6.0]])},
    )
    write_matlab_73(
        tmp_path / "v73.mat",
        L1_mm=values,
        x_um=np.array([[0.0, 10.0, 20.0]]),
        y_um=np.array([[5.0], [6.0]]),
    )
    for name in ("v5.mat", "v73.mat"):
        result = read_thickness_map(tmp_path / name)
        np.testing.assert_array_equal(result, values)
        np.testing.assert_allclose(result.x, [0.0, 0.01, 0.02])
        np.testing.assert_allclose(result.y, [0.005, 0.006])


def test_whole_numbers_that_matlab_stores_as_integers(tmp_path):
    """A double array of whole micrometres takes two bytes a value in a v5 file."""
    path = tmp_path / "v5.mat"
    scipy.io.savemat(path, {"L1_um": np.array([[400, 410, 420], [430, 440, 450]], np.uint16)})
    flags = struct.pack("<4I", 6, 8, 11, 0)  # 11 is the class uint16, 6 is double
    content = path.read_bytes()
    assert content.count(flags) == 1
    path.write_bytes(content.replace(flags, struct.pack("<4I", 6, 8, 6, 0)))
    result = read_thickness_map(path, field_of_view=(1, 1))
    np.testing.assert_allclose(result, [[0.4, 0.41, 0.42], [0.43, 0.44, 0.45]])


def test_coordinates_as_meshgrids(tmp_path):
    values = np.arange(1.0, 7.0).reshape(2, 3)
    x, y = np.meshgrid([0.0, 10.0, 20.0], [5.0, 6.0])
    scipy.io.savemat(tmp_path / "map.mat", {"L1": values, "X_um": x, "Y_um": y})
    result = read_thickness_map(tmp_path / "map.mat")
    np.testing.assert_allclose(result.x, [0.0, 0.01, 0.02])
    np.testing.assert_allclose(result.y, [0.005, 0.006])
    scipy.io.savemat(tmp_path / "turned.mat", {"L1": values, "X_um": x + y, "Y_um": y})
    with pytest.raises(InputError, match="variable X_um should hold the x coordinates"):
        read_thickness_map(tmp_path / "turned.mat")


def test_variable_is_found_among_others_that_cannot_be_a_map(tmp_path):
    values = np.full((3, 4), 0.4)
    np.savez(
        tmp_path / "map.npz",
        L1=values,
        mask=values > 0,
        counts=np.ones((3, 4), int),
        volume=np.ones((2, 3, 4)),
        note=np.array("pressed"),
        settings=np.array({"pickled": True}, dtype=object),
    )
    result = read_thickness_map(tmp_path / "map.npz", field_of_view=(1, 1))
    assert result.attrs["source_variable"] == "L1"


def test_first_and_last_pixel_lie_on_the_edges_of_the_field_of_view():
    map_ = thickness_map(np.ones((3, 6)), field_of_view=(5.0, 1.0))
    np.testing.assert_allclose(map_.x, [0, 1, 2, 3, 4, 5])
    np.testing.assert_allclose(map_.y, [0, 0.5, 1])
    xr.testing.assert_equal(map_, thickness_map(np.ones((3, 6)), pixel_spacing=(1.0, 0.5)))
    xr.testing.assert_equal(
        map_, thickness_map(np.ones((3, 6)), pixel_spacing=(1, 0.5), field_of_view=(5, 1))
    )
    # A field of view of "pixels as areas" would be a pixel wider.
    with pytest.raises(InputError, match=r"pixel spacing of 0.833333 mm along x contradicts"):
        thickness_map(np.ones((3, 6)), pixel_spacing=(5 / 6, 0.5), field_of_view=(5, 1))


IN_MEMORY = xr.DataArray(
    np.ones((3, 6)), {"y": np.arange(3) * 0.1, "x": np.arange(6) * 0.1}, ("y", "x")
)


@pytest.mark.parametrize(
    ("values", "given", "says"),
    [
        (IN_MEMORY.to_dataset(name="L1"), {}, "is an xarray.Dataset"),
        ([[0.4, 0.5], [0.4]], {}, "is no array of numbers"),
        (IN_MEMORY.assign_attrs(scale_factor=1e-3), {}, "still packed"),
        (IN_MEMORY, {"field_of_view": (5, 5)}, "contradicts the coordinates"),
        (IN_MEMORY.assign_coords(x=np.arange(6), y=np.arange(3)), {}, "no coordinates in mm"),
        (np.ones((3, 6)), {"field_of_view": "55"}, "2 finite numbers"),
        (IN_MEMORY.assign_coords(x=[0, 0.1, 0.2, 50, 50.1, 50.2]), {}, "jump from 0.2 to 50 mm"),
        (
            IN_MEMORY.assign_coords(y=("y", [0.0, 0.17, 0.34], {"units": "um"})),
            {},
            "coordinate y is in um, and x states no unit",
        ),
        (IN_MEMORY.rename(x="line", y="other"), {"field_of_view": (1, 1)}, r"not \(y, x\)"),
    ],
)
def test_what_is_no_map_in_memory_is_refused(values, given, says):
    with pytest.raises(InputError, match=says):
        thickness_map(values, **given)


def test_dimensions_in_memory_are_named_as_in_files():
    turned = thickness_map(
        IN_MEMORY.drop_vars(["x", "y"]).T.rename(x="nx", y="ny"), field_of_view=(5, 1)
    )
    assert turned.shape == (3, 6)
    turned = thickness_map(IN_MEMORY.T.rename(x="A-line", y="frame"))
    xr.testing.assert_equal(turned, thickness_map(IN_MEMORY))


@pytest.mark.parametrize("mark", [-32768.0, -9999.0, 1e20, -999.25])
def test_marks_of_missing_pixels_are_no_heights(tmp_path, mark):
    values = np.random.default_rng(1).normal(size=(4, 5))
    values[1, 2] = mark
    np.savez(tmp_path / "relief.npz", h_um=values, x_mm=np.arange(5) / 9, y_mm=np.arange(4) / 9)
    with pytest.raises(InputError, match="mark of missing"):
        read_height_map(tmp_path / "relief.npz", variable="h_um")
