"""Volumes by the conventions of other programs: read rightly, or refused."""

import json
import tracemalloc

import h5py
import numpy as np
import pytest
import tifffile
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from optical_palpation.errors import InputError
from optical_palpation.volume import open_volume
from volume_samples import GIVEN, SPACING, WRITERS, volume

V = volume()
PAGES = V.transpose(1, 0, 2)
LINEAR = {"scale": "linear"}
HOLED = np.where(V[3, 2, 1] == V, np.nan, V)


def read(path, **options):
    with open_volume(path, **options) as found:
        whole = found.to_xarray().values
        np.testing.assert_array_equal(np.stack(list(found), 1), whole)
        return whole


def right(path, values=V, **options):
    np.testing.assert_allclose(read(path, **options), values, rtol=1e-6)


def refused(path, says, **options):
    with pytest.raises(InputError, match=says):
        read(path, **options)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(
    "encoding", [{}, {"_FillValue": 7.5}, {"dtype": "i2", "scale_factor": 0.5, "_FillValue": 32767}]
)
def test_zarr_of_xarray(tmp_path, version, encoding):
    coords = {
        axis: (axis, 1e3 * SPACING[axis] * np.arange(n), {"units": "µm"})
        for axis, n in zip("zyx", V.shape, strict=True)
    }
    xr.Dataset({"oct": (tuple("zyx"), HOLED)}, coords).to_zarr(
        tmp_path / "a.zarr",
        zarr_format=version,
        encoding={"oct": encoding},
        consolidated=False,
    )
    right(tmp_path / "a.zarr", HOLED, **LINEAR)


def test_axes_that_contradict_the_dimensions(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["oct"] = V
        file["oct"].attrs.update(axes="zyx", spacing_mm=list(SPACING.values()))
        for axis, name in enumerate("yzx"):
            file["oct"].dims[axis].label = name
    refused(tmp_path / "a.h5", "axes are said to be zyx", **LINEAR)


def labelled_hdf5(path, attrs, steps=SPACING):
    with h5py.File(path, "w") as file:
        file["oct"] = PAGES
        file["oct"].attrs.update(attrs)
        for number, axis in enumerate("yzx"):
            file[axis] = steps[axis] * np.arange(PAGES.shape[number])
            file[axis].attrs["units"] = "mm"
            file[axis].make_scale(axis)
            file["oct"].dims[number].attach_scale(file[axis])
    return path


@pytest.mark.parametrize("axis", "yzx")
def test_spacing_that_contradicts_the_coordinates(tmp_path, axis):
    stated = {"spacing_mm": [SPACING[a] for a in "yzx"], "scale": "linear"}
    right(labelled_hdf5(tmp_path / "a.h5", stated))
    for factor in (0.9, 1.02, 2, -1):
        steps = SPACING | {axis: factor * SPACING[axis]}
        path = labelled_hdf5(tmp_path / "b.h5", stated, steps)
        refused(path, f"spacing along {axis} is said to be .* coordinate {axis} has steps of")
    near = SPACING | {axis: 1.004 * SPACING[axis]}  # rounded
    right(labelled_hdf5(tmp_path / "c.h5", stated, near))
    physical = SPACING | {"z": SPACING["z"] / 1.4}
    right(labelled_hdf5(tmp_path / "d.h5", stated | {"refractive_index": 1.4}, physical))


@pytest.mark.parametrize("unit", ["dB", "decibel"])
def test_a_scale_that_contradicts_the_unit(tmp_path, unit):
    for scale in ("linear", "amplitude", "intensity"):
        path = labelled_hdf5(tmp_path / "a.h5", {"scale": scale, "units": unit})
        refused(path, f"scale is said to be {scale}, its unit {unit.lower()}")
    right(labelled_hdf5(tmp_path / "a.h5", {"scale": "dB", "units": unit}))


def test_dimensions_go_with_spacing_by_an_attribute(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["oct"] = PAGES
        file["oct"].attrs["spacing_mm"] = [SPACING[axis] for axis in "yzx"]
        for axis, name in enumerate("yzx"):
            file["oct"].dims[axis].label = name
    right(tmp_path / "a.h5", **LINEAR)


def test_octave_stores_columns_first(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["oct/value"] = V.T
        file["oct"].attrs["OCTAVE_NEW_FORMAT"] = np.uint8(1)
    right(tmp_path / "a.h5", variable="oct", axes="zyx", **GIVEN)


@pytest.mark.parametrize(
    ("stored", "meta", "values"),
    [
        ((PAGES + 32768).astype("u2"), {"cf": 0, "c0": -32768.0, "c1": 1.0}, V),
        (PAGES.astype("u1"), {"cf": 0, "c0": -10.0, "c1": 0.5}, 0.5 * V - 10),
        (PAGES.astype("u1"), {"cf": 20}, V),
    ],
)
def test_calibrated_values_of_imagej(tmp_path, stored, meta, values):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, stored, imagej=True, metadata={"axes": "ZYX", **meta})
    right(path, values, **GIVEN)


@pytest.mark.parametrize("axes", ["ZYX", "YZX", "XZY"])
def test_axes_as_tifffile_names_them(tmp_path, axes):
    order = ["ZYX".index(axis) for axis in axes]
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, V.transpose(order), photometric="minisblack", metadata={"axes": axes})
    right(path, **GIVEN)


def test_an_orientation_of_a_later_page(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for n, page in enumerate(PAGES):
            tag = [(274, "H", 1, 3 if n == 2 else 1)]
            file.write(page, extratags=tag, contiguous=False, metadata=None)
    refused(tmp_path / "a.tif", "orientation tag says 3", **GIVEN)


def test_ome_volumes_in_a_series_and_parts_of_one(tmp_path):
    series = tmp_path / "a.ome.tif"
    two = np.stack([V, V + 1])
    tifffile.imwrite(series, two, photometric="minisblack", metadata={"axes": "TZYX"})
    refused(series, "7 planes along Z and 2 times, the file holds 14 pages", **GIVEN)
    with tifffile.TiffFile(series) as file:
        described = file.ome_metadata
    part = tmp_path / "part.tif"
    tifffile.imwrite(part, V[:4], photometric="minisblack", description=described, metadata=None)
    refused(part, "the file holds 4 pages", **GIVEN)


def ome(path, values, planes="", unit="mm"):
    sizes = "".join(f' PhysicalSize{a.upper()}="{SPACING[a]}"' for a in SPACING)
    sizes += "".join(f' PhysicalSize{a.upper()}Unit="{unit}"' for a in SPACING)
    shape = "".join(f' Size{a}="{n}"' for a, n in zip("ZYX", values.shape, strict=True))
    described = (
        f'<OME><Image ID="Image:0"><Pixels ID="P" DimensionOrder="XYCZT" Type="float" SizeC="1" '
        f'SizeT="1"{shape}{sizes}>{planes}</Pixels></Image></OME>'
    )
    tifffile.imwrite(
        path, values, photometric="minisblack", description=described.encode(), metadata=None
    )
    return path


def test_ome_planes_in_another_order(tmp_path):
    planes = [f'<TiffData IFD="{n}" FirstZ="{n}"/>' for n in range(7)]
    right(ome(tmp_path / "a.tif", V, "".join(planes)), **LINEAR)
    right(ome(tmp_path / "a.tif", V, "<TiffData/>"), **LINEAR)
    turned = [f'<TiffData IFD="{n}" FirstZ="{6 - n}" PlaneCount="1"/>' for n in range(7)]
    refused(ome(tmp_path / "a.tif", V, "".join(turned)), "in another order", **LINEAR)
    damaged = '<TiffData IFD="one" FirstZ="0"/>'
    refused(ome(tmp_path / "a.tif", V, damaged), "no number", **LINEAR)


def test_ome_pixels_without_a_size(tmp_path):
    path = ome(tmp_path / "a.tif", V, unit="pixel")
    refused(path, r"spacing \(mm along z, y, x\)", **LINEAR)
    right(path, **GIVEN)


def test_channels_of_imagej_that_are_slices(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, PAGES, imagej=True)
    refused(path, 'metadata={"axes": "ZYX"}', **GIVEN)


def test_distance_of_bscans_in_time(tmp_path):
    path = tmp_path / "a.tif"
    meta = {"unit": "mm", "spacing": 0.5}
    resolution = (1 / SPACING["x"], 1 / SPACING["z"])
    tifffile.imwrite(
        path, PAGES, imagej=True, resolution=resolution, metadata=meta | {"axes": "TYX"}
    )
    refused(path, r"spacing \(mm along y\)", **LINEAR)
    right(path, **LINEAR, spacing={"y": 0.02})


def imagej(path, said, values=PAGES, one_page=False, **options):
    """A stack whose description tells of other planes than it holds; its first page may be all."""
    described = "ImageJ=1.53t\n" + said
    options |= {"metadata": None, "photometric": "minisblack", "description": described}
    if not one_page:
        tifffile.imwrite(path, values, **options)
        return path
    tifffile.imwrite(path, values[0], **options)
    with path.open("ab") as file:
        file.write(values[1:].tobytes())
    return path


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("said", ["", "images=5\nslices=5\n", "images=5\nframes=5\n", "images=1\n"])
def test_stacks_that_are_described_rightly(tmp_path, said, compression):
    right(imagej(tmp_path / "a.tif", said, compression=compression), **GIVEN)


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize(
    "said",
    [
        *(f"images={n}\n{name}={n}\n" for n in (3, 4, 6, 9) for name in ("slices", "frames")),
        *("images=5\nslices=3\n", "images=3\nslices=5\n", "slices=3\n", "images=6\n"),
    ],
)
def test_stacks_of_other_planes_than_described(tmp_path, said, compression):
    path = imagej(tmp_path / "a.tif", said, compression=compression)
    refused(path, r"tells of [3469] planes, the file holds 5", **GIVEN)


def test_a_stack_of_one_page_directory(tmp_path):
    path = imagej(tmp_path / "a.tif", "images=5\nslices=5\n", one_page=True)
    right(path, **GIVEN)
    path.write_bytes(path.read_bytes()[:-1])
    refused(path, "tells of 5 planes, the file holds 4", **GIVEN)
    packed = {"compression": "zlib", "values": PAGES[:1]}
    path = imagej(tmp_path / "b.tif", "images=5\nslices=5\n", one_page=True, **packed)
    refused(path, "tells of 5 planes, the file holds 1", **GIVEN)


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize(
    ("values", "axes"),
    [(V[None], "TZYX"), (V[:, None], "ZCYX"), (PAGES[..., None], None), (V[None, :, None], None)],
)
def test_axes_of_length_one(tmp_path, values, axes, compression):
    path = tmp_path / "a.tif"
    options = {"photometric": "minisblack", "compression": compression}
    tifffile.imwrite(path, values, metadata={"axes": axes} if axes else {}, **options)
    right(path, V if axes else values.squeeze().transpose(1, 0, 2), **GIVEN)


def test_volumetric_tiles(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.ones((32, 32, 32), "f4"), tile=(16, 16, 16))
    refused(path, "volumetric tiles", **GIVEN)


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["y_-1.png", "y_0.png", "y_1.png"], "not named alike"),
        (["y_0.5.png", "y_0.75.png", "y_1.0.png"], "decimals in names"),
        (["y_0.75.png", "y_1.png", "y_1.25.png"], "not named alike"),
        (["b1.png", "b2.png", "mean.png"], "not named alike"),
        (["b1.png", "b1.bmp", "b2.png"], "not named alike"),
        (["b1.png", "b2.gif", "b3.png"], "this format is not read"),
        (["b1.png", "b2.png", "b3.png"], None),
        (["a.png", "b.png", "c.png"], None),
        (["2024-01-01_1.png", "2024-01-01_2.png", "2024-01-02_3.png"], None),
        (["2024-01-31_1.png", "2024-02-01_2.png", "2024-02-02_3.png"], None),
        (["2024-01-01_1.png", "2024-01-01_2.png", "2024-01-02_10.png"], "clear order.*_10.png"),
        (["01-02-2024_2.png", "02-02-2024_3.png", "31-01-2024_1.png"], "several numbers"),
        (["b1_105959.png", "b2_110000.png", "b3_110007.png"], None),
        (["b1_10-59-59.png", "b2_11-00-00.png", "b3_11-00-07.png"], None),
        (["b1_101500.png", "b2_101501.png", "b4_101503.png"], "a B-scan is missing"),
        (["a1_b8.png", "a1_b9.png", "a2_b8.png", "a2_b9.png"], None),
        (["a1_b8.png", "a1_b9.png", "a2_b8.png"], "several numbers"),
        (["a1_b2.png", "a2_b3.png", "a3_b1.png"], "several numbers"),
        (["y_-1.png", "y_-2.png", "y_-3.png"], "a sign or a dash"),
        (["scan-1.png", "scan-2.png", "scan-3.png"], None),
        (["b01.png", "b1.png", "b2.png"], "followed by"),
        (["one.png", "three.png", "two.png"], "do not give an order: one.png, three.png"),
        (["a.png", "b.png", "d.png"], "do not give an order"),
    ],
)
def test_names_of_images(tmp_path, names, says):
    for name, page in zip(names, PAGES, strict=False):
        Image.fromarray(page.astype("u1")).save(tmp_path / name)
    if says:
        refused(tmp_path, says, **GIVEN)
    else:
        right(tmp_path, V[:, : len(names)], **GIVEN)


@pytest.mark.parametrize(
    ("mode", "ending", "says"),
    [
        ("1", "png", "one bit per pixel"),
        ("1", "bmp", "one bit per pixel"),
        ("P", "png", "a palette"),
        ("LA", "png", "grey with transparency"),
        ("RGB", "png", "colour image"),
    ],
)
def test_images_that_are_not_grey(tmp_path, mode, ending, says):
    path = tmp_path / f"a.{ending}"
    Image.fromarray(PAGES[0].astype("u1")).convert(mode).save(path)
    refused(path, f"{says}.*save it in grey", **GIVEN)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("dicom", "but DICOM files: give one file with all B-scans"),
        ("npy", "but NumPy files: give"),
    ],
)
def test_folders_of_other_files(tmp_path, name, says):
    path, options = WRITERS[name](tmp_path, V)
    path.with_name("notes.txt").write_text("of us")
    refused(tmp_path, f"holds no images .*, {says}", **options)


def test_a_volume_within_a_structure_of_matlab(tmp_path):
    import scipy.io

    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"scan": {"vol": V}, "n": 3.0})
    for options in ({}, {"variable": "scan"}, {"variable": "scan.vol"}):
        refused(path, r"Not read: scan \(a structure.*as a variable of its own", **GIVEN, **options)


@pytest.mark.parametrize("axes", [None, ["z", "y", "x"]])
@pytest.mark.parametrize("version", ["0.1", "0.3", None])
def test_ome_zarr_that_is_too_old(tmp_path, axes, version):
    import zarr

    group = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2)
    group.create_array("0", data=V)
    image = {"datasets": [{"path": "0"}]}
    image |= {"axes": axes} if axes else {}
    image |= {"version": version} if version else {}
    group.attrs["multiscales"] = [image]
    said = version or "before 0.4"
    refused(tmp_path / "a.zarr", f"OME-Zarr metadata, version {said}, are too old", **GIVEN)


def end_of_first_variable(content):
    return 128 + 8 + int.from_bytes(content[132:136], "little") - 1


@pytest.mark.parametrize(
    ("name", "place", "says"),
    [
        ("npz_stored", lambda content: len(content) // 2, "Bad CRC-32"),
        ("thorlabs_slash", lambda content: len(content) // 2, "Bad CRC-32"),
        ("mat5", end_of_first_variable, "damaged"),
        ("nifti_gz", lambda content: len(content) - 8, "CRC check failed"),
    ],
)
def test_a_bit_that_has_changed(tmp_path, name, place, says):
    path, options = WRITERS[name](tmp_path, volume((71, 51, 61)))
    content = bytearray(path.read_bytes())
    content[place(content)] ^= 1
    path.write_bytes(content)
    refused(path, says, **options)


def test_a_packed_nifti_file_by_any_name(tmp_path):
    path, options = WRITERS["nifti_gz"](tmp_path, V)
    right(path.rename(tmp_path / "9.nii"), **options)


def test_a_nifti_file_of_two_voxel_sizes(tmp_path):
    path, options = WRITERS["nifti"](tmp_path, V)
    right(path, **options)
    content = bytearray(path.read_bytes())
    content[80:92] = np.ones(3, "<f4").tobytes()  # pixdim
    path.write_bytes(content)
    refused(path, "header says voxels of", **options)


@pytest.mark.parametrize("dtype", ["u1", "i2", "i4", "f4", "f8"])
@pytest.mark.parametrize("ending", ["nii", "nii.gz"])
@given(slope=st.floats(1e-3, 1e3), inter=st.floats(-1e3, 1e3))
@settings(max_examples=5)
def test_scaled_values_of_nifti(tmp_path, ending, dtype, slope, inter):
    import nibabel

    stored = V.transpose(2, 1, 0).astype(dtype)
    image = nibabel.Nifti1Image(stored, np.diag([0.01, 0.02, 0.0035, 1.0]))
    image.header.set_xyzt_units("mm")
    image.header.set_slope_inter(slope, inter)
    nibabel.save(image, tmp_path / f"a.{ending}")
    header = nibabel.load(tmp_path / f"a.{ending}").dataobj  # as it is stored, in single precision
    expected = V.astype("f8") * header.slope + header.inter
    values = read(tmp_path / f"a.{ending}", **LINEAR)
    np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-6 * (200 * slope + abs(inter)))


def test_a_scaled_nifti_file_takes_the_memory_of_what_is_stored(tmp_path):
    import nibabel

    stored = np.random.default_rng(1).integers(0, 200, (64, 128, 256), "u1")
    image = nibabel.Nifti1Image(stored, np.eye(4))
    image.header.set_slope_inter(0.5, 1.0)
    nibabel.save(image, tmp_path / "a.nii.gz")
    tracemalloc.start()
    with open_volume(tmp_path / "a.nii.gz", **GIVEN, axes="xyz") as found:
        np.testing.assert_array_equal(found.bscan(3), stored[:, 3].T * np.float32(0.5) + 1)
        peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * stored.nbytes


@pytest.mark.parametrize("extra", [(), (1,), (1, 1)])
@pytest.mark.parametrize("single", [None, 0, 1, 2])
@pytest.mark.parametrize("ending", ["nii", "nii.gz"])
def test_nifti_leaves_out_what_follows_the_third_axis(tmp_path, single, extra, ending):
    import nibabel

    values = V if single is None else V.take([0], single)
    stored = values.transpose(2, 1, 0).reshape((*values.shape[::-1], *extra))
    image = nibabel.Nifti1Image(stored, np.diag([0.01, 0.02, 0.0035, 1.0]))
    image.header.set_xyzt_units("mm")
    nibabel.save(image, tmp_path / f"a.{ending}")
    right(tmp_path / f"a.{ending}", values, **LINEAR)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("names", ["zyxt", "tyzx", "ytzx", "tczyx", "yzxc", "cyzxt"])
@pytest.mark.parametrize("single", [False, True])
def test_zarr_leaves_out_axes_that_are_not_spatial(tmp_path, names, single, version):
    import zarr

    values = V[:, :1] if single else V
    sizes = dict(zip("zyx", values.shape, strict=True))
    order = ["zyx".index(name) for name in names if name in "zyx"]
    stored = values.transpose(order).reshape([sizes.get(name, 1) for name in names])
    group = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=version)
    group.create_array("0", data=stored)
    axes = [
        {"name": name, "type": "space" if name in "zyx" else "other"}
        | ({"unit": "millimeter"} if name in "zyx" else {})
        for name in names
    ]
    scale = {"type": "scale", "scale": [SPACING.get(name, 1.0) for name in names]}
    image = {"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": [scale]}]}
    group.attrs.update(
        {"multiscales": [image]} if version == 2 else {"ome": {"multiscales": [image]}}
    )
    right(tmp_path / "a.zarr", values, **LINEAR)
    named = xr.DataArray(stored, dims=tuple(names), name="oct").to_dataset()
    named.to_zarr(tmp_path / "b.zarr", zarr_format=version, consolidated=False)
    right(tmp_path / "b.zarr", values, **GIVEN)


def test_zarr_with_two_axes_of_one_and_no_names(tmp_path):
    import zarr

    zarr.create_array(str(tmp_path / "a.zarr"), data=V[None, :, 0, :, None])
    refused(tmp_path / "a.zarr", r"4 axes \(1, 7, 6, 1\)", axes="zxy", **GIVEN)
    zarr.create_array(str(tmp_path / "b.zarr"), data=V[None, None, :, 0])
    right(tmp_path / "b.zarr", V[:, :1], axes="yzx", **GIVEN)


def dicom(folder, change):
    import pydicom

    path, _ = WRITERS["dicom"](folder, V)
    image = pydicom.dcmread(path)
    change(image, pydicom.Dataset)
    image.save_as(path, enforce_file_format=True)
    return path


def check_frames(folder, sequence, name, values, says):
    """A file whose frames are placed by one element: refused, or right where nothing is said."""

    def change(image, dataset):
        image.PerFrameFunctionalGroupsSequence = []
        for value in values:
            item, frame = dataset(), dataset()
            setattr(item, name, value)
            setattr(frame, f"{sequence}Sequence", [item])
            image.PerFrameFunctionalGroupsSequence.append(frame)

    path = dicom(folder, change)
    if says:
        refused(path, says, **LINEAR)
    else:
        right(path, **LINEAR)


def test_dicom_of_floating_point_numbers(tmp_path):
    def change(image, _):
        del image.PixelData, image.BitsStored, image.HighBit, image.PixelRepresentation
        image.BitsAllocated = 32
        image.FloatPixelData = (PAGES + 0.25).astype("<f4").tobytes()

    right(dicom(tmp_path, change), V + 0.25, **LINEAR)


@given(frames=st.integers(1, 12), held=st.integers(1, 12), padding=st.integers(0, 1))
def test_dicom_of_more_or_fewer_frames_than_said(tmp_path, frames, held, padding):
    def change(image, _):
        image.NumberOfFrames = frames
        image.BitsAllocated = image.BitsStored = 8
        image.HighBit = 7
        image.PixelData = stored[:, :held].transpose(1, 0, 2).tobytes() + bytes(2 * padding)

    stored = volume((7, 12, 6), "u1")
    path = dicom(tmp_path, change)
    if frames == held:
        right(path, stored[:, :held], **LINEAR, spacing=SPACING)
    else:
        says = f"NumberOfFrames is {frames}, but PixelData holds {held} frames|do not fit in"
        refused(path, says, **LINEAR, spacing=SPACING)


def test_dicom_whose_samples_are_shifted(tmp_path):
    def change(image, _):
        image.BitsStored, image.HighBit = 12, 15
        image.PixelData = (PAGES.astype("<u2") << 4).tobytes()

    refused(dicom(tmp_path, change), "highest of 12 bits is bit 15, not 11", **LINEAR)


@pytest.mark.parametrize(
    ("at", "says"),
    [
        ([0, 1, 2, 3, 4], None),
        ([0, 2, 1, 3, 4], "order of their positions"),
        ([0, 1, 2, 4, 5], "evenly spaced"),
        ([0, 2, 4, 6, 8], "0.04 mm apart, SpacingBetweenSlices says 0.02"),
    ],
)
def test_dicom_frames_by_their_positions(tmp_path, at, says):
    places = [[0, SPACING["y"] * number, 0] for number in at]
    check_frames(tmp_path, "PlanePosition", "ImagePositionPatient", places, says)


COUNTED = [1, 2, 3, 4, 5]
STACKS = [[1, 1], [1, 2], [1, 3], [2, 1], [2, 2]]
ROUNDED = [0, 1, 3, 4, 5]  # 0, 1.3, 2.6, 3.9, 5.2


@pytest.mark.parametrize(
    ("sequence", "name", "values", "says"),
    [
        ("FrameContent", "InStackPositionNumber", COUNTED, None),
        ("FrameContent", "InStackPositionNumber", COUNTED[::-1], "not stored in the order"),
        ("FrameContent", "InStackPositionNumber", [1, 2, 4, 5, 6], "not evenly"),
        ("FrameContent", "InStackPositionNumber", [1, 2, 3, 4], "not stored in the order"),
        ("FrameContent", "DimensionIndexValues", [[1, n] for n in COUNTED], None),
        ("FrameContent", "DimensionIndexValues", [[1, n] for n in COUNTED[::-1]], "in the order"),
        (
            "FrameContent",
            "DimensionIndexValues",
            STACKS,
            "evenly",
        ),
        ("FrameContent", "DimensionIndexValues", [[1], [1], [1], [1], [1]], None),
        ("OphthalmicFrameLocation", "ReferenceCoordinates", [[n, 0, n, 9] for n in ROUNDED], None),
        (
            "OphthalmicFrameLocation",
            "ReferenceCoordinates",
            [[10.0 * n, 0, 10.0 * n, 99] for n in (0, 2, 1, 3, 4)],
            "by ReferenceCoordinates its 5 frames are not stored in the order",
        ),
    ],
)
def test_dicom_frames_by_their_numbers(tmp_path, sequence, name, values, says):
    check_frames(tmp_path, sequence, name, values, says)


def test_raw_samples_with_two_sidecars(tmp_path):
    path, _ = WRITERS["raw_json"](tmp_path, V)
    right(path)
    text = (tmp_path / "scan.bin.json").read_text()
    (tmp_path / "scan.bin.json").write_text("\ufeff" + text)
    right(path)
    entries = json.loads(text)
    (tmp_path / "scan.bin.toml").write_text(f"dtype = '{entries['dtype']}'\n")
    refused(path, "has two sidecars")


MAGICS = [b"BM", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\0", b"\x89HDF\r\n\x1a\n", b"CDF\x01"]
MAGICS += [b"\x93NUMPY\x01\0", b"PK\x03\x04", b"\x1f\x8b\x08", b"MATLAB 5.0", b"abc"]


@pytest.mark.parametrize("magic", MAGICS)
def test_raw_samples_that_look_like_another_format(tmp_path, magic):
    values = V.astype("u1")
    values.reshape(-1)[: len(magic)] = np.frombuffer(magic, "u1")
    path, _ = WRITERS["raw_json"](tmp_path, values)
    right(path, values)


NOTES = [
    "{",
    " " * 2**17,
    '{"dtype": "u1"}',
    '{"shape": [1], "a": 2}',
    '{"dtype": [1], "shape": 2}',
]


@pytest.mark.parametrize("notes", NOTES)
def test_notes_beside_a_file_of_another_format(tmp_path, notes):
    path, options = WRITERS["hdf5"](tmp_path, V)
    path.with_name(path.name + ".json").write_text(notes)
    right(path, **options)
    entries = {"dtype": "float32", "shape": V.shape[::-1]}  # of the array, not of the file
    path.with_name(path.name + ".json").write_text(json.dumps(entries))
    right(path, **options)


@pytest.mark.parametrize(
    "limits",
    [
        {"valid_min": np.int8(0)},
        {"valid_range": np.array([0, -1], "i1")},
        {"valid_max": np.int8(-1), "_FillValue": np.int8(-1)},
        {"valid_max": np.float32(255)},
    ],
)
@pytest.mark.parametrize("engine", ["scipy", "h5netcdf"])
def test_limits_of_bytes_without_a_sign(tmp_path, limits, engine):
    values = np.random.default_rng(1).integers(0, 255, V.shape).astype("u1")
    stored = xr.Variable(tuple("zyx"), values.view("i1"), {"_Unsigned": "true"} | limits)
    xr.Dataset({"oct": stored}).to_netcdf(tmp_path / "a.nc", engine=engine)
    right(tmp_path / "a.nc", values, **GIVEN)


@pytest.mark.parametrize("version", [2, 3])
def test_a_saturated_byte_of_zarr_is_no_fill_value(tmp_path, version):
    import zarr

    values = np.full(V.shape, 255, "u1")
    values[2, 1] = 7
    array = zarr.create_array(
        str(tmp_path / "a.zarr"), shape=V.shape, dtype="u1", fill_value=255, zarr_format=version
    )
    array[:] = values
    right(tmp_path / "a.zarr", values, axes="zyx", **GIVEN)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("fill", [0, 255])
@pytest.mark.parametrize("dtype", ["u1", "i2", "f4", "c8"])
@given(data=st.data())
@settings(max_examples=5)
def test_chunks_of_zarr_that_are_not_there(tmp_path, version, fill, dtype, data):
    import zarr

    values = (V * (1 + 0.5j)).astype(dtype) if dtype == "c8" else V.astype(dtype)
    layout = {"chunks": (3, 2, 4), "shards": None}
    if version == 3 and data.draw(st.booleans()):
        layout = {"chunks": (3, 1, 2), "shards": (3, 2, 4)}
    store = tmp_path / "a.zarr"
    array = zarr.create_array(
        str(store),
        shape=V.shape,
        dtype=dtype,
        fill_value=fill,
        zarr_format=version,
        overwrite=True,
        config={"write_empty_chunks": True},
        **layout,
    )
    array[:] = values
    expected = values.astype(np.result_type(dtype, "f4"))
    places = st.tuples(st.integers(0, 2), st.integers(0, 2), st.integers(0, 1))
    for place in data.draw(st.sets(places, max_size=17)):
        (store / array.metadata.encode_chunk_key(place)).unlink()
        within = tuple(slice(n * i, n * (i + 1)) for n, i in zip((3, 2, 4), place, strict=True))
        expected[within] = np.nan
    right(store, expected, axes="zyx", **GIVEN)


def test_no_chunk_of_a_zarr_array_is_there(tmp_path):
    import zarr

    zarr.create_array(str(tmp_path / "a.zarr"), shape=V.shape, dtype="f4")
    refused(tmp_path / "a.zarr", "no samples stored", axes="zyx", **GIVEN)
