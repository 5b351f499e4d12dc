"""Input that cannot be used gives an InputError that says so, and never anything else."""

import os
import struct
import zipfile
import zlib

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
import xarray as xr
from hypothesis import example, given, settings
from hypothesis import strategies as st

from optical_palpation.errors import InputError
from optical_palpation.thickness import (
    clean_thickness,
    match_initial_thickness,
    read_thickness_map,
    thickness_map,
)
from test_thickness_maps import HDF5, WRITERS, write_matlab_73
from volume_sandbox import Sandbox


@pytest.fixture(scope="module")
def sandbox():
    box = Sandbox()
    yield box
    box.stop()


GOOD = np.linspace(0.4, 0.5, 12).reshape(3, 4)


def read(path, **options):
    return read_thickness_map(path, **({"field_of_view": (5, 5)} | options))


def expect(path, *fragments, **options):
    with pytest.raises(InputError) as caught:
        read(path, **options)
    for fragment in (*fragments, path.name):
        assert fragment in str(caught.value)


def test_no_usable_file(tmp_path):
    expect(tmp_path / "absent.mat", "no such file")
    expect(tmp_path, "directory")
    (tmp_path / "empty.csv").touch()
    expect(tmp_path / "empty.csv", "is empty")
    (tmp_path / "image.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR")
    expect(tmp_path / "image.png", "damaged, truncated or unsupported")
    (tmp_path / "unknown.bin").write_bytes(b"OCT\0\1")
    expect(tmp_path / "unknown.bin", "unknown format", "OCT")
    (tmp_path / "latin.csv").write_bytes("0.4;0.5 µm".encode("latin-1"))
    expect(tmp_path / "latin.csv", "UTF-8")
    os.mkfifo(tmp_path / "pipe")
    expect(tmp_path / "pipe", "neither a file nor a folder")
    with pytest.raises(InputError):
        read("nul\0byte.mat")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable_file(tmp_path):
    path = tmp_path / "secret.npy"
    np.save(path, GOOD)
    path.chmod(0)
    expect(path, "cannot be opened")


@pytest.mark.parametrize("name", [n for n in WRITERS if n.rpartition(".")[2] not in ("csv", "txt")])
def test_truncated_file(tmp_path, name):
    WRITERS[name](tmp_path / name, np.tile(GOOD, (30, 30)))
    whole = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: len(whole) // 2])
    expect(tmp_path / name, "truncated")


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("0.4,0.5\n0.4,0.5x\n", ("line 2, column 2", "'0.5x' is no number")),
        ("# c\n\na,b,c\n1,2,3\n1,--,3\n", ("line 5, column 2", "'--' is no number")),
        ("0.4;0,5\n0.4;0.5\n", ("line 1, column 2", "'0,5' is no number")),
        ("0.4 1_0\n0.4 0.5\n", ("line 1, column 2", "'1_0' is no number")),
        ("0.4,0.5\n0.4\n", ("line 2", "1 columns", "2")),
        ("x_mm,y_mm,L1_mm\n0,0,0.4\n0,1,0.4\n", ("list of points",)),
        ("# only this\n\n", ("no numbers",)),
        ("a,b,c\n", ("no numbers",)),
        ("0.4\n0.5\n0.6\n", ("3 x 1",)),
        ("0.4\n", ("1 x 1",)),
        ("nan,nan\nnan,\n", ("all values are missing",)),
        ("0.4,inf\n0.4,0.4\n", ("1 of 4", "infinite", "row 0, column 1")),
    ],
)
def test_text_that_is_no_map(tmp_path, text, fragments):
    (tmp_path / "map.csv").write_text(text)
    expect(tmp_path / "map.csv", *fragments)


@pytest.mark.parametrize(
    ("values", "fragments"),
    [
        (np.ones((1, 1)), ("1 x 1", "2 pixels")),
        (np.ones((1, 9)), ("1 x 9",)),
        (np.ones((0, 9)), ("0 x 9",)),
        (np.ones(9), ("shape 9",)),
        (np.ones((3, 3, 3)), ("3 x 3 x 3",)),
        (np.float64(0.4), ("single number",)),
        (GOOD.astype(complex), ("complex128",)),
        (np.ones((3, 3), int), ("int64", "pixel counts")),
        (np.ones((3, 3), bool), ("bool",)),
        (np.full((3, 3), np.nan), ("all values are missing",)),
        (np.where(GOOD > 0.49, -np.inf, GOOD), ("infinite", "row 2, column 2")),
        (GOOD - 0.4, ("1 of 12", "zero or negative", "row 0, column 0", "NaN")),
        (-GOOD, ("12 of 12", "zero or negative")),
    ],
)
def test_arrays_that_are_no_thickness_map(tmp_path, values, fragments):
    np.save(tmp_path / "map.npy", values)
    expect(tmp_path / "map.npy", *fragments)
    np.savez(tmp_path / "map.npz", L1=values)
    expect(tmp_path / "map.npz", "variable L1", *fragments)


def test_types_that_only_some_formats_have(tmp_path):
    scipy.io.savemat(tmp_path / "v5.mat", {"L1": GOOD + 1j})
    expect(tmp_path / "v5.mat", "complex128")
    scipy.io.savemat(tmp_path / "v5.mat", {"L1": {"map": GOOD}})
    expect(tmp_path / "v5.mat", "no arrays of numbers")
    write_matlab_73(tmp_path / "v73.mat", L1=GOOD > 0.45)
    expect(tmp_path / "v73.mat", "bool")
    with h5py.File(tmp_path / "v73.mat", "r+") as file:
        del file["L1"]
        pair = np.zeros((3, 4), [("real", "f8"), ("imag", "f8")])
        file.create_dataset("L1", data=pair).attrs["MATLAB_class"] = np.bytes_("double")
    expect(tmp_path / "v73.mat", "complex128")
    tifffile.imwrite(tmp_path / "map.tif", (1000 * GOOD).astype("u2"))
    expect(tmp_path / "map.tif", "uint16")
    tifffile.imwrite(tmp_path / "map.tif", np.ones((5, 3, 4), "f4"), photometric="minisblack")
    expect(tmp_path / "map.tif", "5 x 3 x 4")
    np.save(tmp_path / "map.npy", np.array([[{}]]), allow_pickle=True)
    expect(tmp_path / "map.npy", "type object")


def test_type_codes_that_no_matlab_file_has(tmp_path):
    path = tmp_path / "v5.mat"
    scipy.io.savemat(path, {"L1": GOOD})
    content = path.read_bytes()
    doubles = struct.pack("<2I", 9, GOOD.nbytes)
    assert content.count(doubles) == 1
    for code in (8, 10, 19, 200, 65535):
        path.write_bytes(content.replace(doubles, struct.pack("<2I", code, GOOD.nbytes)))
        expect(path, f"of stored type {code} ", "damaged")


def test_damaged_tiff_is_reported_once(tmp_path, caplog):
    path = tmp_path / "map.tif"
    strips = np.random.default_rng(0).uniform(0.4, 0.5, (300, 200)).astype("f4")
    tifffile.imwrite(path, strips, compression="zlib", rowsperstrip=10)
    whole = path.read_bytes()
    for share in (0.3, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        expect(path)
    assert not caplog.records


def test_hdf5_heap_that_would_be_searched_for_ever(tmp_path):
    path = tmp_path / "map.nc"
    WRITERS["map.nc"](path, GOOD)
    content = path.read_bytes()
    heap = content.index(b"GCOL") + 16
    assert content[heap] == 1
    path.write_bytes(content[:heap] + b"\0" + content[heap + 1 :])
    expect(path, "damaged", "heap", untrusted=True)


def test_size_that_only_a_damaged_header_states(tmp_path):
    path = tmp_path / "map.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("L1", (10**6, 10**6), "f4", chunks=(100, 100))
    expect(path, "far too many")


def test_volume_beside_the_map_is_not_read(tmp_path):
    path = tmp_path / "map.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("volume", (10**4, 10**4, 10**4), "f4", chunks=(10, 10, 10))
        file["L1"] = GOOD
    np.testing.assert_array_equal(read(path), GOOD)
    expect(path, "10000 x 10000 x 10000", variable="volume")


def test_choice_of_variable(tmp_path):
    np.savez(tmp_path / "two.npz", L0=GOOD, L1=GOOD)
    expect(tmp_path / "two.npz", "more than one", "L0 (3 x 4 float64), L1 (3 x 4 float64)")
    expect(tmp_path / "two.npz", "no variable 'L2'", "L0", "L1", variable="L2")
    np.savez(tmp_path / "none.npz", a=GOOD > 0.45, b=np.ones(3))
    expect(tmp_path / "none.npz", "no array", "a (3 x 4 bool), b (3 float64)")
    np.savez(tmp_path / "nothing.npz")
    with pytest.raises(InputError):
        read(tmp_path / "nothing.npz")
    np.save(tmp_path / "map.npy", GOOD)
    expect(tmp_path / "map.npy", "without a name", variable="L1")


def test_contradicting_or_unknown_units(tmp_path):
    xr.Dataset({"L1_um": (("y", "x"), GOOD, {"units": "mm"})}).to_netcdf(tmp_path / "map.nc")
    expect(tmp_path / "map.nc", "contradicting", "name says um", "attribute says mm")
    np.savez(tmp_path / "map.npz", L1_um=GOOD)
    expect(tmp_path / "map.npz", "contradicting", "length_unit says mm", length_unit="mm")
    expect(tmp_path / "map.npz", "'parsec'", length_unit="parsec")
    xr.Dataset({"L1": (("y", "x"), GOOD, {"units": "kPa"})}).to_netcdf(tmp_path / "kpa.nc")
    expect(tmp_path / "kpa.nc", "'kPa'")


def test_lateral_frame_missing_or_contradicting(tmp_path):
    x, y = 2.0 + 1.25 * np.arange(4.0), 2.0 + 1.25 * np.arange(3.0)  # whole steps number pixels
    path = tmp_path / "map.npz"
    np.savez(path, L1=GOOD)
    expect(path, "no coordinates", "field of view", field_of_view=None)
    for wrong in ((5, 0), (5,), (5, np.nan), (-5, 5), "ab", 5):
        with pytest.raises(InputError, match="field of view must be"):
            read(path, field_of_view=wrong)
    np.savez(path, L1=GOOD, x=x, y=y)
    expect(path, "field of view of 5 mm along x contradicts the coordinates")
    expect(path, "pixel spacing of 0.5 mm", field_of_view=None, pixel_spacing=(1.25, 0.5))
    np.savez(path, L1=GOOD, x=y, y=x)
    expect(path, "variable y", "3 rows along y and 4 columns along x", field_of_view=None)
    np.savez(path, L1=GOOD, x=x)
    expect(path, "both x and y", field_of_view=None)
    np.savez(path, L1=GOOD, x=x, y=np.array([0, 2, 1.0]))
    expect(path, "y coordinates must be finite and rise", field_of_view=None)
    np.savez(path, L1=GOOD, x=np.array([0, 1, 2, np.nan]), y=y)
    expect(path, "x coordinates must be finite", field_of_view=None)
    np.savez(path, L1=GOOD, x=x, x_mm=x, y=y)
    expect(path, "several coordinates along x", field_of_view=None)


def test_maps_made_by_hand_need_a_frame():
    bare = xr.DataArray(GOOD, dims=("y", "x"))
    for use in (clean_thickness, lambda map_: match_initial_thickness(0.5, map_)):
        with pytest.raises(InputError, match="Make one of an array with thickness_map"):
            use(bare)
        with pytest.raises(InputError, match="rise or fall"):
            use(bare.assign_coords(x=[0, 1, 1, 2], y=[0, 1, 2]))
        with pytest.raises(InputError, match=r"not ndarray\. Make one of an array with"):
            use(GOOD)
        cleaned = clean_thickness(thickness_map(GOOD, field_of_view=(5, 5)))
        with pytest.raises(InputError, match="not Dataset: take its variable 'thickness'"):
            use(cleaned)
    with pytest.raises(InputError, match="x coordinates are no numbers"):
        thickness_map(GOOD, x=list("abcd"), y=[0, 1, 2])
    with pytest.raises(InputError, match="5 x coordinates for 4 pixels"):
        thickness_map(GOOD, x=np.arange(5), y=[0, 1, 2])


def test_layer_extent_outside_the_map_or_inside_out():
    for wrong in ((0, 6, 0, 5), (-0.1, 5, 0, 5), (0, 5, 0, 5.1)):
        with pytest.raises(InputError, match="reaches beyond the map"):
            thickness_map(GOOD, field_of_view=(5, 5), layer_extent=wrong)
    with pytest.raises(InputError, match="x0 < x1"):
        thickness_map(GOOD, field_of_view=(5, 5), layer_extent=(5, 0, 0, 5))
    with pytest.raises(InputError, match="4 finite numbers"):
        thickness_map(GOOD, field_of_view=(5, 5), layer_extent=(0, 5))


def survives(path, content, untrusted=False):
    """Read the bytes as a map: a valid result or an InputError, nothing else."""
    path.write_bytes(content)
    try:
        result = read(path, untrusted=untrusted)
    except InputError:
        return
    assert result.ndim == 2
    assert np.nanmin(result) > 0


@given(
    head=st.sampled_from(
        [
            b"",
            b"\x93NUMPY\x01\x00",
            b"PK\x03\x04",
            b"CDF\x01",
            b"\x89HDF\r\n\x1a\n",
            b"II*\0",
            b"MM\0*",
            b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM",
            b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n",
        ]
    ),
    tail=st.binary(max_size=300),
)
@settings(max_examples=100)
def test_random_bytes_behind_every_signature(tmp_path, head, tail):
    survives(tmp_path / "random.bin", head + tail)


@given(text=st.text(max_size=60))
@example("1e400 1\n1 1")
@example("0x1 1\n1 1")
@settings(max_examples=200)
def test_random_text(tmp_path, text):
    survives(tmp_path / "random.txt", text.encode(errors="surrogatepass"))


def damaged_file(path, data):
    WRITERS[path.name](path, GOOD)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(0, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    survives(path, bytes(content), untrusted=path.name in HDF5)


@pytest.mark.parametrize("name", sorted(set(WRITERS) - HDF5))
@given(data=st.data())
def test_damaged_files(tmp_path, name, data):
    damaged_file(tmp_path / name, data)


@pytest.mark.parametrize("name", sorted(HDF5))
@given(data=st.data())
@settings(max_examples=10)  # each is tried out in a process of its own
def test_damaged_hdf5_files(tmp_path, name, data):
    damaged_file(tmp_path / name, data)


def bomb_npy(path):
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000, 10000000), }\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(64))


def bomb_npz(path, arrays=1, side=10_000):
    """Zeros, which compress a thousandfold."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for number in range(arrays):
            with archive.open(f"L{number}.npy", "w", force_zip64=True) as member:
                header = {"descr": "<f8", "fortran_order": False, "shape": (side, side)}
                np.lib.format.write_array_header_1_0(member, header)
                for _ in range(8 * side**2 // 10**7):
                    member.write(bytes(10**7))


def bomb_matlab_5(path):
    packer = zlib.compressobj(1)
    scipy.io.savemat(path, {"L1": GOOD})
    plain = path.read_bytes()
    # A matrix like the good one, but of 10000 x 10000 pixels.
    head = plain[128:].replace(struct.pack("<2i", 3, 4), struct.pack("<2i", 10_000, 10_000))
    head = head.replace(struct.pack("<2I", 9, 96), struct.pack("<2I", 9, 800_000_000))
    parts = [packer.compress(head[: -GOOD.nbytes])]
    parts += [packer.compress(bytes(10**7)) for _ in range(80)]
    packed = b"".join([*parts, packer.flush()])
    path.write_bytes(plain[:128] + struct.pack("<2I", 15, len(packed)) + packed)


def bomb_hdf5(path, side=20_000):
    with h5py.File(path, "w") as file:
        file.create_dataset("L1", (side, side), "f8", chunks=(1000, 1000), compression="gzip")
        file["L1"][:1000, :1000] = 0.4


def bomb_chunk(path):
    with h5py.File(path, "w") as file:
        file.create_dataset(
            "L1",
            (9, 9),
            "f8",
            maxshape=(None, None),
            chunks=(6000, 6000),
            compression="gzip",
            compression_opts=1,
        )
        file["L1"][:] = 0.4


def bomb_text(path):
    path.write_text("0.4," * 2**20 + "\n" + "0.4\n")


BOMBS = {
    "header.npy": bomb_npy,
    "zeros.npz": bomb_npz,
    "many.npz": lambda path: bomb_npz(path, arrays=20, side=4000),
    "zeros.mat": bomb_matlab_5,
    "zeros.h5": bomb_hdf5,
    "chunk.h5": bomb_chunk,
    "line.csv": bomb_text,
    "zeros.tif": lambda path: tifffile.imwrite(
        path, np.zeros((9000, 9000), "f8"), compression="zlib"
    ),
}


@pytest.mark.parametrize("name", BOMBS)
def test_sizes_that_no_map_has(tmp_path, sandbox, name):
    """Headers that promise more than memory holds, and bombs that keep the promise."""
    BOMBS[name](tmp_path / name)
    outcome = sandbox.open(tmp_path / name, {"field_of_view": (5, 5)}, "map")
    assert outcome.text.startswith("InputError: "), outcome
    assert name in outcome.text
    assert outcome.seconds < 5
    assert outcome.memory < 500 * 2**20
