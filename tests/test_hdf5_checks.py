"""HDF5 files that the HDF5 library would not get through are refused before it tries."""

from contextlib import suppress

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optical_palpation.errors import InputError
from optical_palpation.thickness import read_thickness_map
from optical_palpation.volume.hdf5_checks import check_heaps, check_superblock

HEAD = 16  # of a heap, and of each of its objects


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A map with texts of variable length, which lie in a heap: its path and where the heap is."""
    path = tmp_path_factory.mktemp("heap") / "map.h5"
    with h5py.File(path, "w") as file:
        stored = file.create_dataset("L1", data=np.full((5, 6), 0.4))
        stored.attrs["units"] = "mm"
        stored.attrs["long_name"] = "thickness of the layer"
    return path, path.read_bytes().index(b"GCOL")


def read(path):
    return read_thickness_map(path, field_of_view=(2.0, 1.0))


def damaged(sound, tmp_path, index, size):
    """The file with another size of the object of this number in its heap."""
    path, at = sound
    data = bytearray(path.read_bytes())
    place = at + HEAD
    while int.from_bytes(data[place : place + 2], "little") != index:
        place += HEAD + (int.from_bytes(data[place + 8 : place + HEAD], "little") + 7) // 8 * 8
    data[place + 8 : place + HEAD] = size.to_bytes(8, "little")
    (tmp_path / "map.h5").write_bytes(data)
    return tmp_path / "map.h5"


def test_a_sound_file_is_read(sound):
    assert read(sound[0]).shape == (5, 6)


# free space of no size keeps the library for ever, an object beyond the heap leads it out of it
@pytest.mark.parametrize(("index", "size"), [(0, 0), (1, 2**64 - 16), (2, 10**6)])
def test_a_size_that_cannot_be_is_refused(sound, tmp_path, index, size):
    with pytest.raises(InputError, match=rf"map\.h5: damaged .* states a size of {size} bytes"):
        read(damaged(sound, tmp_path, index, size))


@pytest.mark.parametrize("count", [None, 1, 3])
@pytest.mark.parametrize("before", [0, 512])
@pytest.mark.parametrize("libver", ["earliest", "latest"])
@pytest.mark.parametrize("name", ["comment", "comments", "a_longer_name"])
def test_an_attribute_that_is_longer_than_the_file_is_refused(
    tmp_path, count, before, libver, name
):
    path = tmp_path / "map.h5"
    texts = "thin" if count is None else ["thin"] * count
    with h5py.File(path, "w", userblock_size=before, libver=libver) as file:
        file.create_dataset("L1", data=np.full((5, 6), 0.4)).attrs[name] = texts
    assert read(path).shape == (5, 6)
    data = bytearray(path.read_bytes())
    last = data.rindex((data.index(b"GCOL") - before).to_bytes(8, "little"), 0, data.index(b"GCOL"))
    data[last - 4 : last + 8] = bytes([1, 2, 3, 0xC0]) + bytes(8)  # its address is lost, too
    with pytest.raises(InputError, match=rf"byte {last - 4} states a length of 3221422593"):
        check_heaps(written(path, data))


TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0/."), min_size=1, max_size=40)
ATTRIBUTES = st.dictionaries(
    TEXTS,
    st.one_of(TEXTS, st.lists(TEXTS, min_size=1, max_size=5), st.floats(), st.integers(-9, 9)),
    max_size=12,
)


@given(st.lists(ATTRIBUTES, min_size=1, max_size=8), st.sampled_from(["earliest", "latest"]))
def test_what_the_library_writes_passes(tmp_path_factory, contents, libver):
    path = tmp_path_factory.mktemp("written") / "map.h5"
    with h5py.File(path, "w", libver=libver) as file:
        for number, attributes in enumerate(contents):
            stored = file.create_dataset(f"group/L{number}", data=np.full((5, 6), 0.4))
            stored.attrs.update(attributes)
    check_superblock(path)
    check_heaps(path)


@pytest.mark.parametrize("libver", ["earliest", "latest"])
def test_an_attribute_may_be_empty(tmp_path, libver):
    path = tmp_path / "map.h5"
    with h5py.File(path, "w", libver=libver) as file:
        stored = file.create_dataset("L1", data=np.full((5, 6), 0.4))
        stored.attrs["comment"] = h5py.Empty(h5py.string_dtype())
        stored.attrs["none"] = h5py.Empty("f4")
    assert read(path).shape == (5, 6)


def test_a_type_of_variable_length_is_text_or_list(tmp_path):
    path = tmp_path / "map.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("L1", data=np.full((5, 6), 0.4)).attrs["comment"] = "thin"
    data = bytearray(path.read_bytes())
    kind = data.index(b"\x10\0\0\0", data.index(b"comment")) - 4
    assert data[kind + 1] == 1  # a text
    data[kind + 1] = 0x7F
    with pytest.raises(InputError, match=f"type at byte {kind} is neither text nor list"):
        check_heaps(written(path, data))


def test_items_larger_than_the_file_are_refused(tmp_path):
    path = tmp_path / "map.h5"
    with h5py.File(path, "w") as file:
        stored = file.create_dataset("L1", data=np.full((5, 6), 0.4))
        add_list(stored, "history", np.arange(3, dtype=np.int32))
    data = bytearray(path.read_bytes())
    size = data.index(b"\x10\0\0\0", data.index(b"history")) + 8
    assert data[size : size + 4] == b"\x04\0\0\0"
    data[size + 3] = 0x40
    with pytest.raises(InputError, match=f"byte {size} states a length of 1073741828"):
        check_heaps(written(path, data))


def written(path, data):
    path.write_bytes(data)
    return path


def test_samples_may_look_like_a_list_that_is_too_long(tmp_path):
    samples = bytes([0x19, 1, 0, 0, 16, 0, 0, 0]) + bytes([0xFF]) * 40
    path = tmp_path / "map.h5"
    with h5py.File(path, "w") as file:
        file["L1"] = np.full((5, 6), 0.4)
        file["mask"] = np.frombuffer(samples, np.uint8)[None]
    assert read_thickness_map(path, field_of_view=(2.0, 1.0), variable="L1").shape == (5, 6)


def add_list(stored, name, values):
    one = np.empty(1, object)
    one[0] = values
    stored.attrs.create(name, one, dtype=h5py.vlen_dtype(values.dtype))


def test_lists_of_variable_length_are_not_read(tmp_path):
    path = tmp_path / "map.h5"
    with h5py.File(path, "w") as file:
        stored = file.create_dataset("L1", data=np.full((5, 6), 0.4))
        add_list(stored, "history", np.arange(3, dtype=np.int32))
    assert read(path).shape == (5, 6)
    with h5py.File(path, "a") as file:
        add_list(file["L1"], "spacing_mm", np.array([0.1, 0.1]))
    with pytest.raises(InputError, match="spacing_mm must be a few real numbers"):
        read(path)


@pytest.mark.parametrize("libver", ["earliest", "latest"])
@pytest.mark.parametrize("before", [0, 512])
def test_a_sound_first_block_passes(tmp_path, libver, before):
    path = tmp_path / "map.h5"
    with h5py.File(path, "w", libver=libver, userblock_size=before) as file:
        file["L1"] = np.full((5, 6), 0.4)
    check_superblock(path)
    with path.open("ab") as more:  # as some programs leave it
        more.write(bytes(100))
    check_superblock(path)


# of the block for a driver the library allocates up to 4 GB, if that is what it finds there
@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (13, 0, "addresses of 0 bytes"),
        (40, 10**6, "truncated .* says 1000000"),
        (48, 96, "a driver"),
    ],
)
@pytest.mark.parametrize("before", [0, 512])
def test_a_damaged_first_block_is_refused(tmp_path, at, value, message, before):
    path = tmp_path / "map.h5"
    with h5py.File(path, "w", libver="earliest", userblock_size=before) as file:
        file["L1"] = np.full((5, 6), 0.4)
    data = bytearray(path.read_bytes())
    width = 1 if at == 13 else 8
    data[before + at : before + at + width] = value.to_bytes(width, "little")
    path.write_bytes(data)
    with pytest.raises(InputError, match=rf"map\.h5: .*{message}"):
        read(path)


@pytest.mark.parametrize("before", [0, 512])
def test_a_text_that_is_longer_than_the_file_is_refused(tmp_path, before):
    path = tmp_path / "map.h5"
    with h5py.File(path, "w", userblock_size=before) as file:
        file["L1"] = np.full((5, 6), 0.4)
        file["units"] = "mm"
    assert read(path).shape == (5, 6)
    with h5py.File(path) as file:
        at = file["units"].id.get_offset()
    data = bytearray(path.read_bytes())
    data[at : at + 4] = (2 * 10**9).to_bytes(4, "little")  # which the library would allocate
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"map\.h5: .*states a length of 2000000000"):
        read(path)


@given(st.sampled_from([0, 512, 2048]), st.binary(max_size=100))
def test_any_first_block_passes_or_is_refused(tmp_path_factory, before, rest):
    path = tmp_path_factory.getbasetemp() / "block"
    path.write_bytes(bytes(before) + b"\x89HDF\r\n\x1a\n" + rest)
    with suppress(InputError):
        check_superblock(path)


@given(st.lists(st.integers(0, 2**64 - 1) | st.integers(0, 64), max_size=20))
def test_it_comes_to_an_end_on_any_heap(tmp_path_factory, words):
    path = tmp_path_factory.getbasetemp() / "heap"
    objects = b"".join(word.to_bytes(8, "little") for word in words)
    path.write_bytes(b"GCOL\1\0\0\0" + (HEAD + len(objects)).to_bytes(8, "little") + objects)
    with suppress(InputError):
        check_heaps(path)


def test_samples_may_hold_the_signature_of_a_heap(tmp_path):
    (tmp_path / "samples").write_bytes(b"GCOLGCOL" + bytes(50) + b"GCOL")
    check_heaps(tmp_path / "samples")
