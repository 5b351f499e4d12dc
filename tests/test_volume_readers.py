"""Every format gives the same volume, with the facts that it can state."""

from __future__ import annotations

import builtins
import hashlib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import tifffile
from hypothesis import given
from hypothesis import strategies as st

import volume_samples as samples
from optical_palpation.errors import InputError
from optical_palpation.volume import open_volume


@pytest.mark.parametrize("name", samples.WRITERS)
def test_every_format_gives_the_volume_that_was_written(name: str, tmp_path: Path) -> None:
    data = samples.volume()
    path, given_facts = samples.WRITERS[name](tmp_path, data)
    with open_volume(path, **given_facts) as volume:
        assert volume.shape == data.shape
        assert len(volume) == 5
        assert volume.metadata.spacing == pytest.approx(tuple(samples.SPACING.values()), rel=1e-6)
        assert volume.metadata.origin == (0, 0, 0)
        assert not volume.metadata.is_complex
        for y in (4, 0, 2, 3, 1):
            bscan = volume.bscan(y)
            assert bscan.dtype == np.float32
            assert bscan.flags.c_contiguous
            np.testing.assert_array_equal(bscan, data[:, y])
        np.testing.assert_array_equal(np.stack(list(volume), axis=1), data)
        np.testing.assert_array_equal(volume.to_xarray().values, data)


@pytest.mark.parametrize("name", samples.COMPLEX)
def test_complex_volumes_keep_their_phase(name: str, tmp_path: Path) -> None:
    data = samples.volume(dtype="complex64")
    path, given_facts = samples.WRITERS[name](tmp_path, data)
    with open_volume(path, **given_facts | {"scale": "linear"}) as volume:
        assert volume.metadata.is_complex
        assert volume.bscan(1).dtype == np.complex64
        np.testing.assert_array_equal(np.stack(list(volume), axis=1), data)


@pytest.mark.parametrize(
    ("name", "access"),
    [
        ("thorlabs", "streamed"),
        ("thorlabs_slash", "mapped"),
        ("npy", "mapped"),
        ("npz", "streamed"),
        ("npz_stored", "mapped"),
        ("tiff", "mapped"),
        ("tiff_compressed", "streamed"),
        ("tiff_ome", "loaded"),  # compressed en face pages
        ("folder", "streamed"),
        ("mat5", "loaded"),
        ("mat5_plain", "mapped"),
        ("mat73", "streamed"),
        ("netcdf", "mapped"),
        ("hdf5", "streamed"),
        ("raw", "mapped"),
        ("nifti", "mapped"),
        ("nifti_gz", "loaded"),
        ("dicom", "streamed"),
        ("zarr", "streamed"),
    ],
)
def test_the_way_of_access_is_told(name: str, access: str, tmp_path: Path) -> None:
    path, given_facts = samples.WRITERS[name](tmp_path, samples.volume())
    with open_volume(path, **given_facts) as volume:
        assert volume.metadata.access == access


def test_format_is_found_by_content_not_by_ending(tmp_path: Path) -> None:
    data = samples.volume()
    for name in ("thorlabs", "npy", "npz", "tiff", "mat5_plain", "mat73", "hdf5", "nifti", "dicom"):
        folder = tmp_path / name
        folder.mkdir()
        path, given_facts = samples.WRITERS[name](folder, data)
        disguised = path.rename(folder / "scan.xyz")
        with open_volume(disguised, **given_facts) as volume:
            np.testing.assert_array_equal(volume.bscan(3), data[:, 3])


@pytest.mark.parametrize("name", ["npy", "tiff", "folder", "mat5_plain", "nifti_gz"])
def test_missing_spacing_is_asked_for(name: str, tmp_path: Path) -> None:
    path, given_facts = samples.WRITERS[name](tmp_path, samples.volume())
    facts = {k: v for k, v in given_facts.items() if k != "spacing"}
    with pytest.raises(InputError, match=r"does not say: .*spacing \(mm along z, y, x\)"):
        open_volume(path, **facts)


def test_all_missing_facts_are_named_at_once(tmp_path: Path) -> None:
    path, _ = samples.WRITERS["npy"](tmp_path, samples.volume())
    with pytest.raises(InputError, match=r"axes \(.*spacing \(.*scale \("):
        open_volume(path)
    with pytest.raises(InputError, match=r"spacing \(mm along z\)"):
        open_volume(path, axes="zyx", spacing={"y": 1, "x": 1}, scale="dB")


def test_plain_resolution_tags_are_not_trusted(tmp_path: Path) -> None:
    path = tmp_path / "dpi.tif"
    tifffile.imwrite(
        path,
        np.ones((3, 4, 5), np.uint8),
        photometric="minisblack",
        resolution=(72, 72),
        resolutionunit=2,
    )
    with pytest.raises(InputError, match=r"spacing \("):
        open_volume(path, scale="linear")


def test_refractive_index_turns_optical_into_physical_depth(tmp_path: Path) -> None:
    path = samples.thorlabs(tmp_path / "a.oct", samples.volume())
    with pytest.raises(InputError, match=r"refractive_index \("):
        open_volume(path)
    with open_volume(path, refractive_index=1.4) as volume:
        assert volume.metadata.spacing == pytest.approx((0.0035 / 1.4, 0.02, 0.01))
        assert volume.metadata.refractive_index == 1.4
        assert volume.metadata.scale == "dB"
        assert volume.to_xarray().z.values[-1] == pytest.approx(6 * 0.0035 / 1.4)
    # Depth that the user gives is physical unless an index is given with it.
    with open_volume(path, spacing={"z": 0.002}) as volume:
        assert volume.metadata.spacing.z == 0.002
    for index in (0.9, 0.0, -1.0, float("nan"), 100.0, "glass"):
        with pytest.raises(InputError, match="refractive index"):
            open_volume(path, refractive_index=index)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="variable = 1: must be the name"):
        open_volume(path, variable=1)  # type: ignore[arg-type]


def test_thorlabs_members_that_are_not_supported_are_named(tmp_path: Path) -> None:
    data = samples.volume()
    spectral = (
        '<DataFile Type="Raw" SizeZ="2048" SizeX="600">data\\Spectral0.data</DataFile>'
        '<DataFile Type="Complex" SizeZ="7" SizeX="6">data\\Complex.data</DataFile>'
    )
    path = samples.thorlabs(
        tmp_path / "a.oct", data, xml=samples.header_xml(data.shape, extra=spectral)
    )
    with open_volume(path, refractive_index=1.0) as volume:
        np.testing.assert_array_equal(volume.bscan(0), data[:, 0])
    for variable in ("Complex", "Spectral0.data"):
        with pytest.raises(InputError, match=r"Complex \(Complex\).*Spectral0 \(Raw\)"):
            open_volume(path, refractive_index=1.0, variable=variable)
    only = samples.header_xml(data.shape, extra=spectral).replace("Intensity", "Other")
    path = samples.thorlabs(tmp_path / "b.oct", data, xml=only)
    with pytest.raises(InputError, match=r"no Intensity.*Spectral0 \(Raw\).*not supported"):
        open_volume(path, refractive_index=1.0)


def test_thorlabs_single_bscan(tmp_path: Path) -> None:
    data = samples.volume((7, 1, 6))
    path = samples.thorlabs(tmp_path / "a.oct", data)
    with open_volume(path, refractive_index=1.0) as volume:
        assert volume.shape == (7, 1, 6)
        assert np.isnan(volume.metadata.spacing.y)
        np.testing.assert_array_equal(volume.bscan(0), data[:, 0])
        np.testing.assert_array_equal(volume.to_xarray().values, data)


def test_thorlabs_unscanned_axis_needs_a_spacing(tmp_path: Path) -> None:
    data = samples.volume()
    path = samples.thorlabs(
        tmp_path / "a.oct", data, xml=samples.header_xml(data.shape, reach={"Y": 0})
    )
    with pytest.raises(InputError, match=r"spacing \(mm along y\)"):
        open_volume(path, refractive_index=1.0)


def test_thorlabs_real_member_is_float32(shared_data: Path, tmp_path: Path) -> None:
    """A real Chirp member of 2048 float32, read as a volume of the header's sizes."""
    chirp = (shared_data / "layers" / "thorlabs_Chirp.data").read_bytes()
    data = samples.volume()
    xml = samples.header_xml(data.shape).replace(
        'SizeZ="2048" RangeZ="1"', 'SizeZ="64" SizeX="32" RangeZ="1" RangeX="1"'
    )
    path = samples.thorlabs(tmp_path / "a.oct", data, chirp=chirp, xml=xml)
    with open_volume(path, variable="Chirp", refractive_index=1.0) as volume:
        values = volume.bscan(0).T.ravel()
    assert values.shape == (2048,)
    assert np.all(np.diff(values) > 0)  # a chirp maps pixel to wavenumber: it only rises
    assert 0 <= values[0] < values[-1] <= 2048


def test_arrays_can_be_chosen_by_name(tmp_path: Path) -> None:
    path = tmp_path / "two.npz"
    first, second = samples.volume(), samples.volume((4, 3, 2))
    np.savez(path, first=first, second=second)
    with pytest.raises(InputError, match=r"choose one by variable .*--variable.*: first, second"):
        open_volume(path, axes="zyx", **samples.GIVEN)
    with open_volume(path, axes="zyx", variable="second", **samples.GIVEN) as volume:
        assert volume.shape == (4, 3, 2)
    with pytest.raises(InputError, match="no array 'third'; it holds first, second"):
        open_volume(path, axes="zyx", variable="third", **samples.GIVEN)


def test_phase_data_are_single_complex_bscans(shared_data: Path) -> None:
    path = shared_data / "phase" / "lpl2024_figure5.npz"
    spacing = {"z": 0.002, "x": 0.002}
    with (
        open_volume(path, variable="before", axes="zx", spacing=spacing) as before,
        open_volume(path, variable="after", axes="zx", spacing=spacing) as after,
    ):
        assert before.metadata.is_complex
        assert before.shape == after.shape
        assert np.abs(np.angle(before.bscan(0) * after.bscan(0).conj())).max() > 1


def test_real_bscans_are_read(shared_data: Path) -> None:
    with open_volume(
        shared_data / "bscans" / "phantom_0001_noisy.tif",
        spacing={"z": 0.004, "x": 0.01},
        scale="linear",
    ) as volume:
        assert volume.shape == (1000, 1, 304)
        assert 0 < volume.bscan(0).mean() < 255


def test_matlab_v73_counts_axes_as_matlab_does(shared_data: Path) -> None:
    path = shared_data / "layers" / "coin_5c_1-thickness.mat"
    with open_volume(path, axes="zx", spacing={"z": 0.01, "x": 0.01}, scale="linear") as volume:
        import h5py

        with h5py.File(path) as file:
            np.testing.assert_array_equal(volume.bscan(0), file["in_L0"][()].T)


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint32", "float64", "int64"])
def test_matlab_v5_types(dtype: str, tmp_path: Path) -> None:
    data = samples.volume(dtype=dtype)
    for compressed in (False, True):
        path = tmp_path / f"{compressed}.mat"
        scipy.io.savemat(path, {"vol": data, "other": "text"}, do_compression=compressed)
        with open_volume(path, axes="zyx", **samples.GIVEN) as volume:
            np.testing.assert_array_equal(np.stack(list(volume), axis=1), data)


@given(
    order=st.permutations("zyx"),
    shape=st.tuples(*[st.integers(2, 9)] * 3),
    fortran=st.booleans(),
    compressed=st.booleans(),
)
def test_any_axis_order_is_undone(
    order: list[str], shape: tuple[int, int, int], fortran: bool, compressed: bool, tmp_path: Path
) -> None:
    data = samples.volume(shape)
    stored = data.transpose(*("zyx".index(a) for a in order))
    path = tmp_path / "any.npz"
    save = np.savez_compressed if compressed else np.savez
    save(path, scan=np.asfortranarray(stored) if fortran else stored)
    with open_volume(path, axes="".join(order), **samples.GIVEN) as volume:
        np.testing.assert_array_equal(np.stack(list(volume), axis=1), data)
        lazy = volume.to_xarray()
        np.testing.assert_array_equal(lazy[1:, ::-1, 1].values, data[1:, ::-1, 1])
        np.testing.assert_array_equal(lazy[-1, 0, [1, 0]].values, data[-1, 0, [1, 0]])


def test_xarray_has_coordinates_and_units(tmp_path: Path) -> None:
    path, facts = samples.WRITERS["npy"](tmp_path, samples.volume())
    with open_volume(path, **facts, origin={"x": -1.5}) as volume:
        lazy = volume.to_xarray()
        assert lazy.dims == ("z", "y", "x")
        assert lazy.x.attrs["units"] == "mm"
        assert lazy.x.values == pytest.approx(-1.5 + 0.01 * np.arange(6))
        assert lazy.attrs["scale"] == "linear"


def test_written_netcdf_is_read_back(tmp_path: Path) -> None:
    """Depth is divided by the refractive index once, not again when the result is read."""
    source = samples.thorlabs(tmp_path / "a.oct", samples.volume())
    with open_volume(source, refractive_index=1.4) as volume:
        volume.to_xarray().to_netcdf(tmp_path / "copy.nc", engine="h5netcdf")
        spacing = volume.metadata.spacing
        first = volume.bscan(0)
    with open_volume(tmp_path / "copy.nc") as copy:
        assert copy.metadata.spacing == pytest.approx(spacing)
        assert copy.metadata.scale == "dB"
        np.testing.assert_array_equal(copy.bscan(0), first)


@given(index=st.floats(1.0, 4.0), start=st.floats(-5.0, 5.0))
def test_the_whole_depth_is_divided(index: float, start: float, tmp_path: Path) -> None:
    """What lies at an optical depth is found at this depth over the index."""
    optical = start + 0.0035 * np.arange(7)
    facts = {"axes": "zyx", "spacing_mm": [0.0035, 0.02, 0.01], "origin_mm": [start, 1, 2]}
    np.savez(tmp_path / "a.npz", scan=samples.volume(), scale="linear", **facts)
    with open_volume(tmp_path / "a.npz", refractive_index=index) as volume:
        np.testing.assert_allclose(volume.to_xarray().z, optical / index, atol=1e-12)
        assert volume.metadata.origin[1:] == (1, 2)
    with open_volume(tmp_path / "a.npz", refractive_index=index, origin={"z": 0.5}) as volume:
        assert volume.metadata.origin.z == 0.5


@pytest.mark.parametrize("ending", ["nc", "zarr"])
def test_depth_is_not_divided_twice(ending: str, tmp_path: Path) -> None:
    def copy(source: Path, target: str, **facts: Any) -> Path:
        with open_volume(source, **facts) as volume:
            lazy = volume.to_xarray()
            path = tmp_path / f"{target}.{ending}"
            lazy.to_netcdf(path) if ending == "nc" else lazy.to_zarr(path, consolidated=False)
            return path

    source = samples.thorlabs(tmp_path / "a.oct", samples.volume())
    first = copy(source, "first", refractive_index=1.4)
    for path in (first, copy(first, "of_copy"), copy(first, "undivided", refractive_index=1.0)):
        with pytest.raises(InputError, match=r"divided by the refractive index 1\.4 before"):
            open_volume(path, refractive_index=1.4)
        with open_volume(path, refractive_index=1.0) as volume:
            assert volume.metadata.spacing.z == pytest.approx(0.0035 / 1.4)
        with open_volume(path, refractive_index=1.25, spacing={"z": 0.005}) as volume:
            assert volume.metadata.spacing.z == 0.004  # the depth in the file does not count
    optical = copy(source, "optical", refractive_index=1.0)
    with open_volume(optical, refractive_index=1.4) as volume:
        assert volume.metadata.spacing.z == pytest.approx(0.0035 / 1.4)


def test_hash_is_that_of_the_file(tmp_path: Path) -> None:
    path, facts = samples.WRITERS["npy"](tmp_path, samples.volume())
    with open_volume(path, **facts) as volume:
        assert volume.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    images, facts = samples.WRITERS["folder"](tmp_path, samples.volume())
    with open_volume(images, **facts) as volume:
        first = volume.sha256
    (images / "scan_8.png").rename(images / "scan_08.png")
    with open_volume(images, **facts) as volume:
        assert volume.sha256 != first


def test_closed_volume_and_wrong_index(tmp_path: Path) -> None:
    path, facts = samples.WRITERS["npy"](tmp_path, samples.volume())
    volume = open_volume(path, **facts)
    for y in (-1, 5, 10**12):
        with pytest.raises(InputError, match="there are 5"):
            volume.bscan(y)
    volume.close()
    volume.close()
    with pytest.raises(InputError, match="closed"):
        volume.bscan(0)


def test_bscans_are_copies(tmp_path: Path) -> None:
    path, facts = samples.WRITERS["nifti_gz"](tmp_path, samples.volume())
    with open_volume(path, **facts) as volume:
        volume.bscan(2)[:] = 0
        assert volume.bscan(2).min() > 0


@pytest.mark.parametrize(
    ("name", "library"), [("zarr", "zarr"), ("nifti", "nibabel"), ("dicom", "pydicom")]
)
def test_missing_extra_is_named(
    name: str, library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, facts = samples.WRITERS[name](tmp_path, samples.volume())
    real_import = builtins.__import__

    def refuse(module: str, *args: object, **kwargs: object) -> object:
        if module.split(".")[0] == library:
            raise ImportError(module)
        return real_import(module, *args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(InputError, match=r"pip install 'optical-palpation\[formats\]'"):
        open_volume(path, **facts)


def test_unknown_content_is_shown(tmp_path: Path) -> None:
    path = tmp_path / "scan.oct"
    path.write_bytes(b"OCTDUMMY" * 10)
    with pytest.raises(InputError, match=r"b'OCTDUMMYOCTDUMMY'.*scan\.oct\.toml"):
        open_volume(path)
    with pytest.raises(InputError, match="cannot be opened"):
        open_volume(tmp_path / "absent.oct")
    (tmp_path / "empty").write_bytes(b"")
    with pytest.raises(InputError, match="is empty"):
        open_volume(tmp_path / "empty")


@pytest.mark.parametrize(
    ("fact", "message"),
    [
        ({"axes": "zyy"}, "axes 'zyy'"),
        ({"axes": "yx"}, "axes 'yx'"),
        ({"axes": "zx"}, "axes 'zx' for an array of 3"),
        ({"spacing": {"z": float("nan"), "y": 1, "x": 1}}, "spacing along z is nan"),
        ({"spacing": {"z": 0.0, "y": 1, "x": 1}}, "spacing along z is 0.0"),
        ({"spacing": {"z": 1, "y": -1, "x": 1}}, "spacing along y is -1.0"),
        ({"spacing": {"z": 1, "y": float("inf"), "x": 1}}, "spacing along y is inf"),
        ({"spacing": {"t": 1}}, "must map axes"),
        ({"spacing": (1, 1, 1)}, "must map axes"),
        ({"spacing": {"z": "wide"}}, "must hold numbers"),
        ({"scale": "log"}, "neither 'linear' nor 'dB'"),
        ({"origin": {"z": float("nan")}}, "origin along z"),
    ],
)
def test_impossible_facts(fact: dict[str, object], message: str, tmp_path: Path) -> None:
    path, facts = samples.WRITERS["npy"](tmp_path, samples.volume())
    with pytest.raises(InputError, match=message):
        open_volume(path, **facts | fact)  # type: ignore[arg-type]


def test_thorlabs_archive_with_both_kinds_of_slash_is_ambiguous(tmp_path: Path) -> None:
    path = samples.thorlabs(tmp_path / "a.oct", samples.volume())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("data/Intensity.data", b"")
    with pytest.raises(InputError, match="2 times"):
        open_volume(path, refractive_index=1.0)
