"""What readers other than those of maps make of labels, units, missing values and orientation."""

import h5py
import numpy as np
import pytest
import tifffile
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import map_files
import volume_samples as samples
from optical_palpation.errors import InputError
from optical_palpation.experiment import read_scene
from optical_palpation.experiment.scene import ReliefFile, StiffnessFile
from optical_palpation.friction import read_profile
from optical_palpation.friction.volumes import read_pair
from optical_palpation.material import read_uniaxial_test
from optical_palpation.palpation import read_sample_motion
from optical_palpation.thickness import (
    Corrections,
    clean_thickness,
    find_layer,
    match_initial_thickness,
    read_height_map,
    read_thickness_map,
    thickness_map,
)
from optical_palpation.thickness.corrections import Anchor, Exclusion
from optical_palpation.volume import open_volume
from optical_palpation.volume.units import length_unit, split_unit

MAP = 0.4 + 0.1 * np.random.default_rng(5).random((4, 5))
X, Y = np.linspace(0, 0.8, 5), np.linspace(0, 0.6, 4)


# --- maps in memory -----------------------------------------------------------------------------


def test_masked_pixels_of_an_array_are_missing():
    hole = np.zeros(MAP.shape, bool)
    hole[1, 2] = True
    found = thickness_map(np.ma.array(np.where(hole, 0.0, MAP), mask=hole), x=X, y=Y)
    np.testing.assert_array_equal(found, np.where(hole, np.nan, MAP))


def test_labelled_array_is_turned_and_converted():
    labelled = xr.DataArray(
        1e3 * MAP.T,
        {"x": ("x", 1e3 * X, {"units": "um"}), "y": ("y", Y)},
        ("x", "y"),
        attrs={"units": "um"},
    )
    found = thickness_map(labelled)
    np.testing.assert_allclose(found, MAP)
    np.testing.assert_allclose(found.x, X)
    square = xr.DataArray(MAP[:, :4].T, dims=("x", "y"))
    np.testing.assert_array_equal(thickness_map(square, field_of_view=(1, 1)), MAP[:, :4])


@pytest.mark.parametrize("use", [clean_thickness, lambda m: match_initial_thickness(0.6, m)])
def test_map_in_another_unit_is_refused_where_it_is_used(use):
    good = thickness_map(MAP, x=X, y=Y)
    in_um = (1e3 * good).assign_attrs(units="um")
    with pytest.raises(InputError, match=r"is in um; give mm: thickness_map\(map\)"):
        use(in_um)
    in_um = in_um.assign_coords(x=("x", 1e3 * X, {"units": "um"}))
    with pytest.raises(InputError, match="x is in um"):
        use(good.assign_coords(x=in_um["x"]))
    xr.testing.assert_allclose(thickness_map(in_um), good)  # as the error says


def test_arrays_whose_labels_would_be_lost():
    import pandas as pd

    with pytest.raises(InputError, match="DataFrame carries labels"):
        thickness_map(pd.DataFrame(MAP), x=X, y=Y)


@pytest.mark.parametrize(
    "frame", [{"pixel_spacing": (10.0, 10.0)}, {"field_of_view": (1000.0, 990.0)}]
)
def test_lateral_lengths_in_micrometres_are_named(frame):
    loaded = thickness_map(np.full((30, 40), 0.4), **frame)
    with pytest.raises(InputError, match="in um"):
        match_initial_thickness(0.5, loaded)


def test_units_of_length():
    for text in ("um", "µm", "μm", "microns", "Micrometre", "[um]", "\\u00B5m"):
        assert length_unit(text) == "um", text
    assert length_unit("kPa") is None
    for name, unit in (("x_um", "um"), ("depth (mm)", "mm"), ("L1 [µm]", "um"), ("L1.nm", "nm")):
        assert split_unit(name)[1] == unit, name
    for name in ("maximum", "L_m", "thickness", "um", "number"):
        assert split_unit(name) == (name, None)


# --- volumes ------------------------------------------------------------------------------------


def netcdf_volume(path, values, attrs=None, dims=("z", "y", "x"), **coords):
    steps = dict(zip("zyx", (3.5, 20.0, 10.0), strict=True))
    given = {
        a: (a, steps[a] * np.arange(n), {"units": "um"})
        for a, n in zip(dims, values.shape, strict=True)
        if a in steps
    }
    xr.Dataset({"oct": (dims, values, attrs or {})}, given | coords).to_netcdf(
        path, engine="h5netcdf"
    )
    return path


def test_packed_volume_is_unpacked_and_its_gaps_are_missing(tmp_path):
    data = samples.volume()
    packed = data.astype("i2")
    packed[2, 3, 4] = -5
    attrs = {"scale_factor": 0.5, "add_offset": 10.0, "valid_min": np.int16(0)}
    path = netcdf_volume(tmp_path / "a.nc", packed, attrs)
    with open_volume(path, scale="linear") as volume:
        found = np.stack(list(volume), axis=1)
    expected = 0.5 * data + 10.0
    expected[2, 3, 4] = np.nan
    np.testing.assert_allclose(found, expected)


@pytest.mark.parametrize("order", ["zyx", "xyz", "yxz"])
def test_volume_is_turned_by_the_names_of_its_axes(tmp_path, order):
    data = samples.volume()
    stored = data.transpose(*("zyx".index(a) for a in order))
    path = netcdf_volume(tmp_path / "a.nc", stored, dims=tuple(order))
    with h5py.File(tmp_path / "labels.h5", "w") as file:
        file["oct"] = stored
        for axis, name in enumerate(order):
            file["oct"].dims[axis].label = name
    for name, facts in ((path, {}), (tmp_path / "labels.h5", {"spacing": samples.SPACING})):
        with open_volume(name, scale="linear", **facts) as volume:
            assert volume.metadata.spacing == pytest.approx(tuple(samples.SPACING.values()))
            np.testing.assert_array_equal(np.stack(list(volume), axis=1), data)


def test_b_scans_that_were_never_written_are_missing(tmp_path):
    data = samples.volume()
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("oct", (5, 7, 6), "u2", chunks=(1, 7, 6))
        for y in (0, 1, 3):
            dataset[y] = data[:, y]
    with open_volume(tmp_path / "a.h5", axes="yzx", **samples.GIVEN) as volume:
        for y in range(5):
            expected = data[:, y] if y in (0, 1, 3) else np.full((7, 6), np.nan)
            np.testing.assert_array_equal(volume.bscan(y), expected)


def test_volume_of_netcdf_3(tmp_path):
    data = samples.volume()
    coords = {
        a: (a, samples.SPACING[a] * np.arange(n), {"units": "mm"})
        for a, n in zip("zyx", data.shape, strict=True)
    }
    xr.Dataset({"oct": (("z", "y", "x"), data)}, coords).to_netcdf(
        tmp_path / "a.nc", engine="scipy"
    )
    with open_volume(tmp_path / "a.nc", scale="dB") as volume:
        assert volume.metadata.format == "netCDF-3"
        np.testing.assert_array_equal(np.stack(list(volume), axis=1), data)


@pytest.mark.parametrize(
    ("spacing", "message"),
    [
        ({"z": 3.5, "y": 20.0, "x": 10.0}, "100 samples 3.5 mm apart along z make 350 mm"),
        ({"z": 0.0035, "y": 20.0, "x": 0.01}, "along y make 8000 mm"),
        ({"z": 0.0035, "y": 0.02, "x": 10.0}, "times that along z"),
        ({"z": 3.5e-6, "y": 2e-5, "x": 1e-5}, "another unit"),
    ],
)
def test_spacing_in_another_unit_is_refused(tmp_path, spacing, message):
    np.save(tmp_path / "a.npy", np.ones((100, 400, 6), np.uint8))
    with pytest.raises(InputError, match=message):
        open_volume(tmp_path / "a.npy", axes="zyx", spacing=spacing, scale="linear")


def test_nifti_whose_header_turns_the_axes_asks_for_them(tmp_path):
    import nibabel

    data = samples.volume()
    turned = np.array([[0, 0, 10.0, 0], [0, 20.0, 0, 0], [3.5, 0, 0, 0], [0, 0, 0, 1]])
    for affine, why in (
        (turned, "swaps x and z"),
        (np.diag([10.0, 20.0, -3.5, 1.0]), "turns z around"),
    ):
        image = nibabel.Nifti1Image(data, affine)
        image.header.set_xyzt_units("micron")
        nibabel.save(image, tmp_path / "a.nii")
        with pytest.raises(InputError, match=f"does not say: axes .*; its header {why}"):
            open_volume(tmp_path / "a.nii", scale="linear")
    mirrored = nibabel.Nifti1Image(data.transpose(2, 1, 0), np.diag([-10.0, -20.0, 3.5, 1.0]))
    mirrored.header.set_xyzt_units("micron")
    nibabel.save(mirrored, tmp_path / "a.nii")
    with open_volume(tmp_path / "a.nii", scale="linear") as volume:
        np.testing.assert_array_equal(volume.bscan(1), data[:, 1])


def test_images_with_an_orientation_or_a_gap(tmp_path):
    images, facts = samples.WRITERS["folder"](tmp_path, samples.volume())
    (images / "scan_10.png").unlink()
    with pytest.raises(InputError, match=r"scan_9\.png is followed by scan_11\.png"):
        open_volume(images, **facts)
    (images / "scan_8.png").unlink()
    (images / "scan_11.png").unlink()  # 9 and 12 are left
    with open_volume(images, **facts) as volume:
        assert len(volume) == 2
    tifffile.imwrite(tmp_path / "a.tif", np.ones((4, 5), "u1"), extratags=[(274, "H", 1, 4)])
    with pytest.raises(InputError, match="orientation tag says 4"):
        open_volume(tmp_path / "a.tif", **samples.GIVEN)
    from PIL import Image

    photo = Image.fromarray(np.ones((4, 5), np.uint8))
    exif = photo.getexif()
    exif[274] = 6
    photo.save(tmp_path / "a.jpg", exif=exif)
    with pytest.raises(InputError, match="orientation tag says 6"):
        open_volume(tmp_path / "a.jpg", **samples.GIVEN)


def dicom(folder, **elements):
    import pydicom

    path, facts = samples.WRITERS["dicom"](folder, samples.volume())
    dataset = pydicom.dcmread(path)
    for name, value in elements.items():
        dataset.add_new(name, "US", value)
    dataset.save_as(path, enforce_file_format=True)
    return path, facts


def test_dicom_scale_and_padding(tmp_path):
    import pydicom

    data = samples.volume()
    scaling = pydicom.Dataset()
    scaling.RescaleSlope, scaling.RescaleIntercept, scaling.RescaleType = 0.5, -3.0, "US"
    path, facts = dicom(tmp_path)
    dataset = pydicom.dcmread(path)
    dataset.SharedFunctionalGroupsSequence[0].PixelValueTransformationSequence = [scaling]
    dataset.save_as(path, enforce_file_format=True)
    with open_volume(path, **facts) as volume:
        np.testing.assert_allclose(volume.bscan(2), 0.5 * data[:, 2] - 3.0)
    padding = int(data[0, 0, 0])
    path, facts = dicom(tmp_path, PixelPaddingValue=padding)
    with open_volume(path, **facts) as volume:
        found = np.stack(list(volume), axis=1)
    np.testing.assert_array_equal(found, np.where(data == padding, np.nan, data))


def test_channels_are_no_b_scans(tmp_path):
    pages = np.ones((2, 40, 30), np.uint16)
    tifffile.imwrite(tmp_path / "a.ome.tif", pages, metadata={"axes": "CYX"})
    tifffile.imwrite(tmp_path / "b.tif", pages, imagej=True, metadata={"axes": "CYX"})
    for name in ("a.ome.tif", "b.tif"):
        with pytest.raises(InputError, match="2 channels"):
            open_volume(tmp_path / name, **samples.GIVEN)


def test_ome_zarr_scales_by_image_and_level(tmp_path):
    import zarr

    path, facts = samples.WRITERS["ome_zarr"](tmp_path, samples.volume())
    group = zarr.open_group(str(path), mode="r+")
    images = group.attrs["multiscales"]
    images[0]["coordinateTransformations"] = [
        {"type": "scale", "scale": [1, 1, 2, 2, 2]},
        {"type": "translation", "translation": [0, 0, 0, 0, 500]},
    ]
    group.attrs["multiscales"] = images
    with open_volume(path, **facts) as volume:
        doubled = tuple(2 * step for step in samples.SPACING.values())
        assert volume.metadata.spacing == pytest.approx(doubled)
        assert volume.metadata.origin == pytest.approx((0, 0, 0.5))


def test_scale_and_direction_that_a_file_states(tmp_path):
    data = samples.volume()
    path = netcdf_volume(tmp_path / "a.nc", data, {"units": "dB"})
    with open_volume(path) as volume:
        assert volume.metadata.scale == "dB"
    falling = ("y", -20.0 * np.arange(5), {"units": "um"})
    path = netcdf_volume(tmp_path / "b.nc", data, y=falling)
    with pytest.raises(InputError, match="coordinate y falls"):
        open_volume(path, scale="dB")


# --- phases -------------------------------------------------------------------------------------

PHASE = {"axes": "zyx", "spacing": {"z": 0.004, "y": 0.02, "x": 0.02}}


def test_pairs_of_volumes(tmp_path):
    data = samples.volume(dtype="complex64")
    np.save(tmp_path / "a.npy", data)
    before, after, *_ = read_pair(tmp_path / "a.npy", tmp_path / "a.npy", **PHASE)
    np.testing.assert_array_equal(before, after)
    gap = data.copy()
    gap[3, 2, 3] = np.nan
    np.save(tmp_path / "b.npy", gap)
    with pytest.raises(InputError, match=r"b\.npy: 1 samples of the square are missing"):
        read_pair(tmp_path / "a.npy", tmp_path / "b.npy", **PHASE)
    np.save(tmp_path / "real.npy", np.abs(data))
    with pytest.raises(InputError, match=r"real samples.*complex"):
        read_pair(tmp_path / "real.npy", tmp_path / "a.npy", **PHASE)
    stored = {"scan": data, "axes": "zyx", "spacing_mm": [0.004, 0.02, 0.02]}
    for name, origin in (("c", 0.0), ("d", 0.3)):
        np.savez(tmp_path / f"{name}.npz", **stored, origin_mm=[0.0, 0.0, origin])
    with pytest.raises(InputError, match="the same place"):
        read_pair(tmp_path / "c.npz", tmp_path / "d.npz")


# --- tables -------------------------------------------------------------------------------------

STRAIN = -np.linspace(0.01, 0.4, 12)
STRESS = 18.0 * STRAIN


def table(path, header, *columns, separator=",", end="", index=False):
    lines = [header] + [
        separator.join(([str(n)] if index else []) + [f"{v:.9g}" for v in row]) + end
        for n, row in enumerate(zip(*columns, strict=True))
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("header", "columns", "options"),
    [
        ("strain,stress (MPa)", (STRAIN, STRESS / 1e3), {}),
        ("strain,stress [N/mm²]", (STRAIN, STRESS / 1e3), {}),
        ("strain,stress_GPa", (STRAIN, STRESS / 1e6), {}),
        ("strain (mm/mm),stress (kPa)", (STRAIN, STRESS), {}),
        ("strain (engineering),stress (kPa)", (STRAIN, STRESS), {}),
        ("strain,stress\n(%),(Pa)", (100 * STRAIN, 1e3 * STRESS), {}),
        (",strain,stress_kPa", (STRAIN, STRESS), {"index": True}),
        ("strain,stress_kPa", (STRAIN, STRESS), {"end": ","}),
        ("strain,stress_kPa,", (STRAIN, STRESS), {"end": ","}),
        ("# from A, B; C\nstrain\tstress_kPa", (STRAIN, STRESS), {"separator": "\t"}),
        ("strain;stress_kPa;note, b", (STRAIN, STRESS, STRAIN), {"separator": ";"}),
        ('"strain","stress, kPa"', (STRAIN, STRESS), {}),
    ],
)
def test_uniaxial_tables_that_are_understood(tmp_path, header, columns, options):
    found = read_uniaxial_test(table(tmp_path / "t.csv", header, *columns, **options))
    np.testing.assert_allclose(found.strain, STRAIN, rtol=1e-7)
    np.testing.assert_allclose(found.stress, STRESS, rtol=1e-7)


@pytest.mark.parametrize(
    ("header", "columns", "options", "message"),
    [
        ("strain,stress (psi)", (STRAIN, STRESS / 6.9), {}, "is in 'psi'"),
        ("strain,stress_psi", (STRAIN, STRESS / 6.9), {}, "is in 'psi'"),
        ("strain,stress (mPa)", (STRAIN, STRESS * 1e6), {}, "is in 'mPa'"),
        ("strain,stress [dyn/cm2]", (STRAIN, STRESS), {}, "is in 'dyn/cm2'"),
        ("displacement (mil),stress_kPa", (STRAIN, STRESS), {}, "is in 'mil'"),
        ("displacement_mm,force (kgf)", (STRAIN, STRESS), {}, "is in 'kgf'"),
        ("displacement_mm,force_MN", (STRAIN, STRESS), {}, "is in 'MN'"),
        ("strain,stress kPa MPa", (STRAIN, STRESS), {}, "several units"),
        ("strain,stress", (STRAIN, 1e3 * STRESS), {}, "names no unit"),
        ("strain,stress", (STRAIN, 1e-4 * STRESS), {}, "names no unit"),
        ("displacement_mm,force_kN", (STRAIN, 10 * STRESS), {}, "Check its unit, and height"),
        ("tension strain,stress", (-100 * STRAIN, -STRESS), {}, "percent"),
        ("strain,stress_kPa", (STRAIN, STRESS), {"index": True}, "3 cells under a header of 2"),
        ("strain,stress_kPa,note", (STRAIN, STRESS), {}, "2 cells under a header of 3"),
        ("strain,stress_kPa,strain", (STRAIN, STRESS, 2 * STRAIN), {}, "several|2 columns"),
        ("0,1", (STRAIN, STRESS), {}, "no header"),
    ],
)
def test_uniaxial_tables_that_are_refused(tmp_path, header, columns, options, message):
    path = table(tmp_path / "t.csv", header, *columns, **options)
    with pytest.raises(InputError, match=message) as caught:
        read_uniaxial_test(path, height=30.0, area=500.0)
    assert "t.csv" in str(caught.value)


def test_decimal_commas_are_named(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("strain;stress_kPa\n" + "".join(f"-0,{n};-{n},5\n" for n in range(1, 9)))
    with pytest.raises(
        InputError, match=r"column .strain., data row 1 holds .-0,1.*write decimal points"
    ):
        read_uniaxial_test(path)


def test_profile_whose_depth_has_a_unit(tmp_path):
    depth = np.linspace(0.0, 0.4, 9)
    path = table(tmp_path / "p.csv", "depth_um,displacement_nm", 1e3 * depth, depth)
    np.testing.assert_allclose(read_profile(path, thickness=0.4).depth, depth / 0.4)
    for thickness in ("0.4", 0.0, np.nan):
        with pytest.raises(InputError, match="thickness"):
            read_profile(path, thickness=thickness)
    with pytest.raises(InputError, match="the depth is in um"):
        read_profile(path)
    path = table(tmp_path / "p.csv", "depth_mm,displacement_nm", depth, depth)
    with pytest.raises(InputError, match="the depth is in mm"):
        read_profile(path)
    np.testing.assert_allclose(read_profile(path, calibrated=0.5).depth, depth / 0.5)
    np.testing.assert_allclose(read_profile(path, 0.4, calibrated=0.5).depth, depth / 0.4)
    path = table(tmp_path / "p.csv", "depth,displacement_nm,error_um", depth, depth, depth)
    with pytest.raises(InputError, match="give both in one unit"):
        read_profile(path)
    path = table(tmp_path / "p.csv", "depth_px,depth,displacement", depth, depth, depth)
    with pytest.raises(InputError, match="several columns"):
        read_profile(path)


def test_profile_whose_depth_has_no_unit(tmp_path):
    depth = np.linspace(0.0, 0.4, 9)
    path = table(tmp_path / "p.csv", "depth,displacement", depth, depth)
    np.testing.assert_allclose(read_profile(path).depth, depth)
    np.testing.assert_allclose(read_profile(path, thickness=0.5).depth, depth / 0.5)
    with pytest.raises(InputError, match="depth_mm or depth_fraction"):  # in a layer of 0.42 mm
        read_profile(path, calibrated=0.42)
    np.testing.assert_allclose(read_profile(path, calibrated=0.3).depth, depth)
    path = table(tmp_path / "p.csv", "depth_fraction,displacement", depth, depth)
    np.testing.assert_allclose(read_profile(path, thickness=0.5, calibrated=0.5).depth, depth)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("anchor sample 120 80 50", "anchor sample 120 80 50 lies outside the volume"),
        ("exclude window 100 200 10 20", "exclude window 100 200 10 20 lies outside the volume"),
        ("anchor sample 0.1 0.1 9", "z .* to .*mm"),
    ],
)
def test_corrections_beyond_the_volume_are_named(tmp_path, text, message):
    path = tmp_path / "corrections.txt"
    path.write_text(text)
    noise = np.random.default_rng(0).rayleigh(size=(40, 8, 16)).astype(np.float32)
    with pytest.raises(InputError, match=message):
        find_layer(noise, spacing=(0.004, 0.02, 0.02), scale="linear", corrections=path)
    inside = Corrections((Anchor("window", 0.0, 0.14, 0.1),), (Exclusion("sample", 0.3, 9, 0, 1),))
    inside.check_inside((0.0, 0.0, 0.0), (0.004, 0.02, 0.02), (40, 8, 16))


# --- scenes and motion --------------------------------------------------------------------------


def relief(path, values, **attrs):
    data = {"height": (("x", "y"), values.T, attrs)}
    coords = {"x": ("x", 1e3 * X, {"units": "um"}), "y": ("y", Y)}
    xr.Dataset(data, coords).to_netcdf(path, engine="h5netcdf")
    return path


def test_relief_of_a_scene_may_lie_below_its_mean(tmp_path):
    values = 0.02 * np.sin(np.arange(20.0)).reshape(4, 5)
    path = relief(tmp_path / "relief.nc", 1e3 * values, units="um")
    with pytest.raises(InputError, match="zero or negative"):
        read_thickness_map(path)
    np.testing.assert_allclose(read_height_map(path), values)
    grid = np.meshgrid(X, Y)
    found = ReliefFile(kind="file", path=path).height(*grid)
    np.testing.assert_allclose(found, values, atol=1e-9)
    gap = values.copy()
    gap[1, 1] = np.nan
    with pytest.raises(InputError, match=r"relief\.nc.*missing"):
        ReliefFile(kind="file", path=relief(path, gap)).height(*grid)


def test_stiffness_of_a_scene(tmp_path):
    factor = 1.0 + np.arange(20.0).reshape(4, 5)
    x, y = np.meshgrid(X, Y)

    def read(**coords):
        path = tmp_path / "stiffness.nc"
        data = {"stiffness": (("x", "y"), factor.T)}
        xr.Dataset(data, coords).to_netcdf(path, engine="h5netcdf")
        return StiffnessFile(kind="file", path=path).apply(np.ones(x.shape), x, y, 0 * x)

    in_um = ("x", 1e3 * X, {"units": "um"})
    np.testing.assert_array_equal(read(x=in_um, y=("y", Y)), factor)
    np.testing.assert_array_equal(read(x=in_um, y=("y", Y, {"units": "mm"})), factor)
    with pytest.raises(InputError, match=r"stiffness\.nc: has no coordinates y"):
        read(x=in_um)
    with h5py.File(tmp_path / "stiffness.nc", "r+") as file:
        file["stiffness"].attrs["units"] = "kPa"
    with pytest.raises(InputError, match="stiffness is in kPa; it must be a factor"):
        StiffnessFile(kind="file", path=tmp_path / "stiffness.nc").apply(x, x, y, 0 * x)
    np.savez(tmp_path / "s.npz", stiffness=factor, x=X, y=Y)
    found = StiffnessFile(kind="file", path=tmp_path / "s.npz").apply(np.ones(x.shape), x, y, 0 * x)
    np.testing.assert_array_equal(found, factor)


def test_relief_in_memory_must_be_in_mm():
    from optical_palpation.experiment.scene import map_height

    height = xr.DataArray(0.1 * MAP, {"x": X, "y": Y}, ("y", "x"))
    point = np.array([0.3]), np.array([0.2])
    assert map_height(height, *point).shape == (1,)
    for wrong, message in (
        (height.assign_attrs(units="um"), "relief is in um"),
        (height.assign_coords(x=("x", X, {"units": "um"})), "coordinates of the field are in um"),
        (height.drop_vars("x"), "no coordinates along x"),
    ):
        with pytest.raises(InputError, match=message):
            map_height(wrong, *point)


SCENE = """
compression = 0.1
[layer]
size = [2, 2]
[sample]
size = [2, 2]
thickness = 1
[mesh]
element_size = 0.25
"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[layer]\nsize = [2, 2]", "[layer]\nsize = [2000, 2000]", "layer: .*not in mm"),
        ("thickness = 1", "thickness = 1000", "sample: .*not in mm"),
        ("compression = 0.1", "", "compression: Field required"),
        ("compression", "compresion", "compresion: Extra inputs"),
        ("0.25", "nan", "mesh.element_size"),
    ],
)
def test_scene_files(tmp_path, old, new, message):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    assert read_scene(path).layer.size == (2.0, 2.0)
    path.write_text(SCENE.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_scene(path)


def test_motion_by_labels_and_units(tmp_path):
    motion = 0.01 * MAP
    parts = {
        f"sample_displacement_{axis}": (("col", "row"), 1e3 * motion.T, {"unit": "microns"})
        for axis in "xy"
    }
    coords = {"x": ("col", 1e3 * X, {"Units": "um"}), "y": ("row", Y)}
    xr.Dataset(parts, coords).to_netcdf(tmp_path / "m.nc", engine="h5netcdf")
    found = read_sample_motion(tmp_path / "m.nc")
    for axis in "xy":
        np.testing.assert_allclose(found[f"sample_displacement_{axis}"], motion)
    np.testing.assert_allclose(found.x, X)


def test_motion_in_the_unit_of_the_file_and_its_mask(tmp_path):
    motion, hole = 0.01 * MAP, np.eye(*MAP.shape, dtype=bool)
    parts = {f"sample_displacement_{axis}": 1e3 * motion for axis in "xy"}
    np.savez(tmp_path / "m.npz", x_mm=X, y_mm=Y, units="um", filled=hole, **parts)
    found = read_sample_motion(tmp_path / "m.npz")
    for axis in "xy":
        expected = np.where(hole, np.nan, motion)
        np.testing.assert_allclose(found[f"sample_displacement_{axis}"], expected)


@given(
    values=hnp.arrays(
        np.float64,
        hnp.array_shapes(min_dims=2, max_dims=2, min_side=2, max_side=7),
        elements=st.one_of(st.floats(0.25, 0.5), st.integers(1, 9), st.just(np.nan)),
    ),
    index=st.sampled_from([False, True, "coordinates"]),
    header=st.sampled_from([False, True, "names", "coordinates"]),
    separator=st.sampled_from([",", ";", "\t"]),
    end=st.sampled_from(["", "", "separator"]),
)
def test_table_of_pandas_is_right_or_refused(tmp_path, values, index, header, separator, end):
    """Whatever pandas writes beside the values: it is never taken for thickness."""
    import pandas as pd

    rows, columns = values.shape
    frame = pd.DataFrame(values)
    if index == "coordinates":
        frame.index = 0.1 * np.arange(rows) + 0.05
    if header == "coordinates":
        frame.columns = 0.1 * np.arange(columns) + 0.05
    names = list("abcdefg"[:columns]) if header == "names" else bool(header)
    text = frame.to_csv(index=bool(index), header=names, sep=separator)
    if end:
        text = text.replace("\n", f"{separator}\n")
    (tmp_path / "map.csv").write_text(text)
    labelled = index == "coordinates" or header == "coordinates"
    try:
        found = read_thickness_map(tmp_path / "map.csv", field_of_view=(1, 1))
    except InputError:
        plain = not (index or header or end) and rows > 2 and columns > 2
        assert not plain or np.isnan(values).any() or map_files.may_be_labels(values)
        return
    alone = (header, columns) if not index else (index, rows)
    if not (labelled and alone[0] == "coordinates" and alone[1] < 5):  # too few to tell
        np.testing.assert_array_equal(found, values)


# --- any map, any convention --------------------------------------------------------------------


@given(
    values=hnp.arrays(
        np.float64,
        hnp.array_shapes(min_dims=2, max_dims=2, min_side=2, max_side=6),
        elements=st.floats(0.25, 0.5),
    ),
    turned=st.booleans(),
    unit=st.sampled_from(["mm", "um", "nm"]),
    hidden=st.data(),
    engine=st.sampled_from(["h5netcdf", "scipy"]),
)
def test_conventions_do_not_change_a_map(tmp_path, values, turned, unit, hidden, engine):
    """Axes, unit, and the way in which gaps are marked, in any combination."""
    factor = {"mm": 1.0, "um": 1e3, "nm": 1e6}[unit]
    gaps = hidden.draw(hnp.arrays(bool, values.shape))
    if gaps.mean() > 0.5:
        gaps = ~gaps
    way = hidden.draw(st.sampled_from(["NaN", "_FillValue", "valid_max", "filled"]))
    attrs = {"units": unit}
    stored = factor * values
    extra = {}
    if way == "filled":
        extra["filled"] = gaps.astype(float)
    else:
        stored = np.where(gaps, np.nan if way == "NaN" else 7e6, stored)
        attrs |= {"_FillValue": 7e6} if way == "_FillValue" else {}
        attrs |= {"valid_max": 0.6 * factor} if way == "valid_max" else {}
    parts = {"L1": stored, **extra}
    dims = ("x", "y") if turned else ("y", "x")
    xr.Dataset(
        {
            name: (dims, part.T if turned else part, attrs if name == "L1" else {})
            for name, part in parts.items()
        }
    ).to_netcdf(tmp_path / "map.nc", engine=engine)
    found = read_thickness_map(tmp_path / "map.nc", field_of_view=(1, 1))
    np.testing.assert_allclose(found, np.where(gaps, np.nan, values), rtol=1e-12)
