"""Damaged and hostile files: each a clear InputError, in under 5 s and 500 MB."""

from __future__ import annotations

import os
import pickle
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import imagecodecs
import numpy as np
import pytest
import scipy.io
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import volume_samples as samples
from optical_palpation.volume.lzw import is_valid
from volume_sandbox import Sandbox

BOMB = 2 * 2**30
OCT = {"refractive_index": 1.0}
NPY = samples.GIVEN | {"axes": "zyx"}
Case = Callable[[Path], tuple[Path, dict[str, Any], str]]


@pytest.fixture(scope="module")
def sandbox() -> Iterator[Sandbox]:
    box = Sandbox()
    yield box
    box.stop()


def _deflated(size: int, byte: bytes = b"\0", head: bytes = b"", wbits: int = -15) -> bytes:
    """A deflate stream of ``head`` and so many equal bytes, without the work of packing them."""
    packer = zlib.compressobj(9, zlib.DEFLATED, wbits)
    start = packer.compress(head) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(byte * 2**20) + packer.flush(zlib.Z_FULL_FLUSH)
    return start + block * (size // 2**20) + packer.flush()


def _zip(path: Path, members: list[tuple[str, bytes, int | None]]) -> Path:
    """Write members; where a size is given the content is a deflate stream claiming that size."""
    body, directory = b"", b""
    for name, content, size in members:
        method = 0 if size is None else 8
        crc = zlib.crc32(content)
        fields = (
            20,
            0,
            method,
            0,
            33,
            crc,
            len(content),
            len(content) if size is None else size,
            len(name),
            0,
        )
        directory += (
            struct.pack("<4s2B5H3I5H2I", b"PK\x01\x02", 20, 3, *fields, 0, 0, 0, 0, len(body))
            + name.encode()
        )
        body += struct.pack("<4s5H3I2H", b"PK\x03\x04", *fields) + name.encode() + content
    end = struct.pack(
        "<4s4H2IH", b"PK\x05\x06", 0, 0, len(members), len(members), len(directory), len(body), 0
    )
    path.write_bytes(body + directory + end)
    return path


def _oct(xml: str | bytes, data: np.ndarray | None = None, message: str = "") -> Case:
    def make(folder: Path) -> tuple[Path, dict[str, Any], str]:
        array = samples.volume() if data is None else data
        return samples.thorlabs(folder / "a.oct", array, xml=xml), OCT, message

    return make


SHAPE = (7, 5, 6)


def truncated_zip(folder: Path) -> tuple[Path, dict[str, Any], str]:
    path = samples.thorlabs(folder / "a.oct", samples.volume())
    path.write_bytes(path.read_bytes()[:-40])
    return path, OCT, "truncated"


def zip_without_its_middle(folder: Path) -> tuple[Path, dict[str, Any], str]:
    path = samples.thorlabs(folder / "a.oct", samples.volume((70, 50, 60)))
    content = path.read_bytes()
    path.write_bytes(content[:9000] + content[20000:])
    return path, OCT, r"a\.oct"


def zip_bomb_of_declared_size(folder: Path) -> tuple[Path, dict[str, Any], str]:
    shape = (1024, 512, 1024)
    xml = samples.header_xml(shape)
    members = [("Header.xml", xml.encode(), None), ("data\\Intensity.data", _deflated(BOMB), BOMB)]
    return _zip(folder / "a.oct", members), OCT, "zip bomb"


def zip_bomb_of_undeclared_size(folder: Path) -> tuple[Path, dict[str, Any], str]:
    xml = samples.header_xml(SHAPE)
    members = [("Header.xml", xml.encode(), None), ("data/Intensity.data", _deflated(BOMB), 840)]
    return _zip(folder / "a.oct", members), OCT, "damaged"


def header_bomb(folder: Path) -> tuple[Path, dict[str, Any], str]:
    members = [("Header.xml", _deflated(BOMB, b" "), BOMB), ("data/Intensity.data", b"", None)]
    return _zip(folder / "a.oct", members), OCT, "zip bomb"


def header_bomb_of_undeclared_size(folder: Path) -> tuple[Path, dict[str, Any], str]:
    members = [
        ("Header.xml", _deflated(50 * 2**20, b" "), 50 * 2**20),
        ("data/Intensity.data", b"", None),
    ]
    return _zip(folder / "a.oct", members), OCT, "larger than"


def zip_of_a_million_members(folder: Path) -> tuple[Path, dict[str, Any], str]:
    entry = (
        struct.pack(
            "<4s2B4H3I5H2I", b"PK\x01\x02", 20, 3, 20, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0
        )
        + b"a"
    )
    directory = entry * 1_000_000
    end = struct.pack("<4s4H2IH", b"PK\x05\x06", 0, 0, 65535, 65535, len(directory), 4, 0)
    path = folder / "a.oct"
    path.write_bytes(b"PK\x03\x04" + directory + end)
    return path, OCT, "zip directory"


def archive_member(name: str) -> Case:
    def make(folder: Path) -> tuple[Path, dict[str, Any], str]:
        path = samples.thorlabs(folder / "a.oct", samples.volume())
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(name, b"outside")
        return path, OCT, "points out of the archive"

    return make


def entity_bomb(encoding: str) -> Case:
    lines = ['<?xml version="1.0"?>', '<!DOCTYPE a [<!ENTITY a0 "lol">']
    lines += [f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12)]
    text = "\n".join(
        [*lines, "]>", samples.header_xml(SHAPE).split("?>", 1)[1].replace("h&#252;bsch", "&a11;")]
    )
    return _oct(text.encode(encoding), message="document type")


def external_entity(folder: Path) -> tuple[Path, dict[str, Any], str]:
    text = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY a SYSTEM "file:///etc/passwd">]><Ocity>&a;</Ocity>'
    return samples.thorlabs(folder / "a.oct", samples.volume(), xml=text), OCT, "document type"


def file_of(content: bytes, message: str, facts: dict[str, Any] = NPY, name: str = "a.bin") -> Case:
    def make(folder: Path) -> tuple[Path, dict[str, Any], str]:
        (folder / name).write_bytes(content)
        return folder / name, facts, message

    return make


def npy(header: str, content: bytes = b"") -> bytes:
    text = header.encode().ljust(118 - 10) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + content


class Evil:
    """Leaves a trace when it is unpickled."""

    def __init__(self, trace: str) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.trace,)


def pickled_npy(folder: Path) -> tuple[Path, dict[str, Any], str]:
    objects = np.array([[[Evil(str(folder / "unpickled"))]]], object)
    np.save(folder / "a.npy", objects, allow_pickle=True)
    return folder / "a.npy", NPY, "not real or complex numbers"


def pickled_npz(folder: Path) -> tuple[Path, dict[str, Any], str]:
    objects = np.array([Evil(str(folder / "unpickled"))], object)
    np.savez(folder / "a.npz", scan=samples.volume(), axes=objects)
    return folder / "a.npz", NPY, r"allow_pickle=False|object"


def npz_bomb(folder: Path) -> tuple[Path, dict[str, Any], str]:
    head = npy(_npy_header("(1024, 512, 1024)"))
    stream = _deflated(BOMB, head=head)
    return _zip(folder / "a.npz", [("scan.npy", stream, BOMB + len(head))]), NPY, "zip bomb"


def empty_image_in_folder(folder: Path) -> tuple[Path, dict[str, Any], str]:
    images, facts = samples.WRITERS["folder"](folder, samples.volume())
    (images / "scan_99.png").write_bytes(b"")
    return images, facts, "is no image"


def images_of_mixed_shapes(folder: Path) -> tuple[Path, dict[str, Any], str]:
    images, facts = samples.WRITERS["folder"](folder, samples.volume())
    Image.fromarray(np.zeros((7, 7), np.uint8)).save(images / "scan_99.png")
    return images, facts, r"scan_99.png has shape \(7, 7\).*must agree"


def images_of_mixed_types(folder: Path) -> tuple[Path, dict[str, Any], str]:
    images, facts = samples.WRITERS["folder"](folder, samples.volume())
    Image.fromarray(np.zeros((7, 6), np.uint16)).save(images / "scan_99.png")
    return images, facts, "type uint16.*must agree"


def folder_without_images(folder: Path) -> tuple[Path, dict[str, Any], str]:
    (folder / "notes.txt").write_text("nothing here")
    return folder, samples.GIVEN, "holds no images"


def png(width: int, height: int, content: bytes = b"") -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", content)
        + chunk(b"IEND", b"")
    )


def tiff(tags: dict[int, tuple[int, int]], content: bytes = b"", following: int = 0) -> bytes:
    """One page with the given LONG tags ``{tag: (count, value)}``, samples at byte 8."""
    entries = b"".join(struct.pack("<HHII", t, 4, n, v) for t, (n, v) in sorted(tags.items()))
    content = content.ljust(len(content) + len(content) % 2, b"\0")
    directory = struct.pack("<H", len(tags)) + entries + struct.pack("<I", following)
    return b"II*\0" + struct.pack("<I", 8 + len(content)) + content + directory


def grey(
    width: int, height: int, compression: int = 1, size: int = 8
) -> dict[int, tuple[int, int]]:
    values = {
        256: width,
        257: height,
        258: 8,
        259: compression,
        262: 1,
        273: 8,
        277: 1,
        278: height,
        279: size,
    }
    return {tag: (1, value) for tag, value in values.items()}


def tiff_strip_bomb(folder: Path) -> tuple[Path, dict[str, Any], str]:
    strip = _deflated(BOMB, wbits=15)
    (folder / "a.tif").write_bytes(tiff(grey(64, 64, 8, len(strip)), strip))
    return folder / "a.tif", samples.GIVEN, ""


def ome_entity_bomb(folder: Path) -> tuple[Path, dict[str, Any], str]:
    lines = ['<?xml version="1.0"?><!DOCTYPE a [<!ENTITY a0 "lol">']
    lines += [f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12)]
    text = "".join(lines) + "]><OME><Image><Pixels>&a11;</Pixels></Image></OME>"
    tifffile.imwrite(
        folder / "a.ome.tif",
        np.ones((3, 4, 5), np.uint8),
        description=text,
        metadata=None,
        photometric="minisblack",
    )
    return folder / "a.ome.tif", samples.GIVEN, "document type"


def ome_that_names_other_files(folder: Path) -> tuple[Path, dict[str, Any], str]:
    text = (
        '<?xml version="1.0"?><OME><Image><Pixels SizeZ="3" SizeY="4" SizeX="5"><TiffData>'
        '<UUID FileName="../../../etc/passwd">urn:uuid:1</UUID></TiffData></Pixels></Image></OME>'
    )
    tifffile.imwrite(
        folder / "a.ome.tif",
        np.ones((3, 4, 5), np.uint8),
        description=text,
        metadata=None,
        photometric="minisblack",
    )
    return folder / "a.ome.tif", {"scale": "dB"}, r"spacing \(mm along z, y, x\)"


def nifti(**fields: Any) -> bytes:
    import nibabel

    header = nibabel.Nifti1Header()
    header.set_data_dtype(np.float32)
    header["dim"] = [3, 6, 5, 7, 1, 1, 1, 1]
    header["pixdim"][1:4] = 0.01
    header["magic"] = b"n+1"
    header["vox_offset"], header["xyzt_units"] = 352, 2
    for name, value in fields.items():
        header[name] = value
    return header.binaryblock + b"\0" * 4


def dicom(change: Callable[[bytes], bytes], message: str) -> Case:
    def make(folder: Path) -> tuple[Path, dict[str, Any], str]:
        path, facts = samples.WRITERS["dicom"](folder, samples.volume())
        path.write_bytes(change(path.read_bytes()))
        return path, facts, message

    return make


def dicom_sizes(content: bytes) -> bytes:
    rows = struct.pack("<HH2sH", 0x28, 0x10, b"US", 2)
    frames = struct.pack("<HH2sH", 0x28, 0x08, b"IS", 2)
    at = content.index(rows) + 8
    content = content[:at] + b"\xff\xff" + content[at + 2 :]
    at = content.index(frames)
    return (
        content[:at]
        + struct.pack("<HH2sH", 0x28, 0x08, b"IS", 10)
        + b"2000000000"
        + content[at + 10 :]
    )


def dicom_deflate_bomb(content: bytes) -> bytes:
    syntax = content.index(b"1.2.840.10008.1.2.1")
    end = syntax + 20
    length = struct.unpack_from("<I", content, 140)[0]
    deflated = b"1.2.840.10008.1.2.1.99"
    group = struct.pack("<I", length + len(deflated) - 20)
    return (
        content[:140]
        + group
        + content[144 : syntax - 2]
        + struct.pack("<H", len(deflated))
        + deflated
        + content[end : 144 + length]
        + _deflated(BOMB)
    )


def h5(write: Callable[[h5py.File, Path], Any], message: str, **facts: Any) -> Case:
    def make(folder: Path) -> tuple[Path, dict[str, Any], str]:
        with h5py.File(folder / "a.h5", "w") as file:
            write(file, folder)
        return folder / "a.h5", NPY | facts, message

    return make


def h5_external(file: h5py.File, folder: Path) -> None:
    (folder / "secret.bin").write_bytes(bytes(1000))
    file.create_dataset("v", (5, 5, 5), "u1", external=[(str(folder / "secret.bin"), 0, 125)])


def h5_virtual(file: h5py.File, folder: Path) -> None:
    layout = h5py.VirtualLayout((5, 5, 5), "u1")
    layout[:] = h5py.VirtualSource(str(folder / "other.h5"), "v", (5, 5, 5))
    file.create_virtual_dataset("v", layout)


def h5_link(file: h5py.File, folder: Path) -> None:
    with h5py.File(folder / "other.h5", "w") as other:
        other["v"] = np.ones((5, 5, 5))
    file["v"] = h5py.ExternalLink(str(folder / "other.h5"), "v")


def mat_bomb(folder: Path) -> tuple[Path, dict[str, Any], str]:
    n = 2**28
    element = struct.pack("<4I", 6, 8, 6, 0) + struct.pack("<2I4i", 5, 12, 1024, 512, 512, 0)
    element += struct.pack("<2I", 1, 3) + b"vol\0\0\0\0\0" + struct.pack("<2I", 9, 8 * n)
    matrix = struct.pack("<2I", 14, 8 * n + len(element)) + element
    body = _deflated(8 * n, head=matrix, wbits=15)
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    (folder / "a.mat").write_bytes(head + struct.pack("<2I", 15, len(body)) + body)
    return folder / "a.mat", NPY, "zip bomb"


def mat_size(folder: Path) -> tuple[Path, dict[str, Any], str]:
    scipy.io.savemat(folder / "a.mat", {"vol": samples.volume()})
    content = bytearray((folder / "a.mat").read_bytes())
    at = content.index(struct.pack("<3i", 7, 5, 6))
    content[at : at + 12] = struct.pack("<3i", 2**31 - 1, 2**31 - 1, 2**31 - 1)
    (folder / "a.mat").write_bytes(content)
    return folder / "a.mat", NPY, "840 bytes of stored type 7"


def mat_negative(folder: Path) -> tuple[Path, dict[str, Any], str]:
    path, facts, _ = mat_size(folder)
    content = path.read_bytes().replace(
        struct.pack("<i", 2**31 - 1) * 3, struct.pack("<3i", -7, -5, 6)
    )
    path.write_bytes(content)
    return path, facts, "negative dimension"


def raw(text: str, message: str) -> Case:
    def make(folder: Path) -> tuple[Path, dict[str, Any], str]:
        (folder / "a.raw").write_bytes(bytes(210))
        (folder / "a.raw.toml").write_text(text)
        return folder / "a.raw", {}, message

    return make


RAW = 'dtype = "uint8"\nshape = [7, 5, 6]\naxes = "zyx"\nscale = "dB"\nspacing_mm = [1, 1, 1]\n'


def zarr_edited(edit: Callable[[str], str], message: str) -> Case:
    def make(folder: Path) -> tuple[Path, dict[str, Any], str]:
        import zarr

        array = zarr.create_array(
            str(folder / "a"), shape=SHAPE, chunks=(4, 2, 3), dtype="f4", zarr_format=2
        )
        array[:] = samples.volume()
        meta = folder / "a" / ".zarray"
        meta.write_text(edit(meta.read_text()))
        for chunk in (folder / "a").glob("?.?.?"):
            chunk.write_bytes(pickle.dumps(Evil(str(folder / "unpickled"))))
        return folder / "a", NPY, message

    return make


def pickle_filter(text: str) -> str:
    return text.replace('"filters": null', '"filters": [{"id": "pickle", "protocol": 5}]').replace(
        '"compressor": {', '"compressor": null, "x": {'
    )


def ome_zarr_outside(folder: Path) -> tuple[Path, dict[str, Any], str]:
    path, facts = samples.WRITERS["ome_zarr"](folder, samples.volume())
    path.rename(folder / "inner")
    attributes = folder / "inner" / ".zattrs"
    attributes.write_text(attributes.read_text().replace('"path": "0"', '"path": "../../inner/0"'))
    return folder / "inner", facts, "inner"


def zarr_damaged_blosc(folder: Path) -> tuple[Path, dict[str, Any], str]:
    """Its chunk claims 100 MB: the decoder would read beyond the 112 bytes that are there."""
    path, facts = samples.WRITERS["ome_zarr"](folder, samples.volume())
    chunk = path / "0" / "0.0.1.2.0"
    chunk.write_bytes(chunk.read_bytes()[:12] + struct.pack("<I", 100_663_296) + bytes(30))
    return path, facts, "chunk 0.0.1.2.0 is damaged"


def zarr_tiny_chunks(folder: Path) -> tuple[Path, dict[str, Any], str]:
    path, facts = samples.WRITERS["zarr"](folder, samples.volume())
    meta = path / "zarr.json"
    meta.write_text(re.sub(r'("shape": \[\s*7,\s*5,\s*)6', r"\g<1>65536", meta.read_text()))
    return path, facts, "too small to read"


def ome_zarr_edited(old: str, new: str) -> Case:
    def make(folder: Path) -> tuple[Path, dict[str, Any], str]:
        path, facts = samples.WRITERS["ome_zarr"](folder, samples.volume())
        attributes = path / ".zattrs"
        assert old in attributes.read_text()
        attributes.write_text(attributes.read_text().replace(old, new))
        return path, facts, "OME-Zarr metadata are damaged|is not an array"

    return make


def npz_broken_text(folder: Path) -> tuple[Path, dict[str, Any], str]:
    """Characters beyond Unicode, of which NumPy makes a string that crashes what uses it."""
    np.savez(folder / "a.npz", scan=samples.volume(), axes=np.array("zyx"))
    content = (
        (folder / "a.npz").read_bytes().replace("zyx".encode("utf-32-le"), b"\xff\xff\xff\x7f" * 3)
    )
    (folder / "a.npz").write_bytes(content)
    with zipfile.ZipFile(folder / "a.npz") as archive:
        members = [
            (m.filename, content[m.header_offset + 30 + len(m.filename) + 20 :][: m.file_size])
            for m in archive.infolist()
        ]
    _zip(folder / "a.npz", [(name, data, None) for name, data in members])
    return folder / "a.npz", NPY, "is no text"


def netcdf_damaged_heap(folder: Path) -> tuple[Path, dict[str, Any], str]:
    """One byte in the heap of texts and references, on which the HDF5 library loops for ever."""
    path, facts = samples.WRITERS["netcdf"](folder, samples.volume())
    content = bytearray(path.read_bytes())
    content[content.index(b"GCOL") + 48] = 0xFF
    path.write_bytes(content)
    return path, facts | {"untrusted": True}, "did not get through it"


def zarr_chunks_of_nothing(folder: Path) -> tuple[Path, dict[str, Any], str]:
    path, facts = samples.WRITERS["zarr"](folder, samples.volume())
    meta = path / "zarr.json"
    meta.write_text(re.sub(r'("chunk_shape": \[\s*)4', r"\g<1>0", meta.read_text()))
    return path, facts, ""


def named_pipe(folder: Path) -> tuple[Path, dict[str, Any], str]:
    os.mkfifo(folder / "a.oct")
    return folder / "a.oct", OCT, "neither a file nor a folder"


def _npy_header(shape: str, descr: str = "'<f4'") -> str:
    return f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"


CASES: dict[str, Case] = {
    "oct: truncated": truncated_zip,
    "oct: without its middle": zip_without_its_middle,
    "oct: bomb of declared size": zip_bomb_of_declared_size,
    "oct: bomb of undeclared size": zip_bomb_of_undeclared_size,
    "oct: header bomb": header_bomb,
    "oct: header of 50 MB": header_bomb_of_undeclared_size,
    "oct: a million members": zip_of_a_million_members,
    "oct: member ../x": archive_member("../../etc/passwd"),
    "oct: member ..\\x": archive_member("..\\..\\x"),
    "oct: member /x": archive_member("/tmp/x"),
    "oct: member C:\\x": archive_member("C:\\Windows\\x"),
    "oct: entity bomb": entity_bomb("utf-8"),
    "oct: entity bomb in UTF-16": entity_bomb("utf-16"),
    "oct: external entity": external_entity,
    "oct: deeply nested header": _oct("<a>" * 600_000 + "</a>" * 600_000, message="Intensity"),
    "oct: header is no XML": _oct("<Ocity><DataFiles>", message="not well-formed"),
    "oct: header of zeros": _oct(bytes(1000), message="not well-formed"),
    "oct: larger sizes": _oct(
        samples.header_xml((8, 5, 6)), message="960 bytes, the member has 840"
    ),
    "oct: smaller sizes": _oct(
        samples.header_xml((7, 4, 6)), message="672 bytes, the member has 840"
    ),
    "oct: negative size": _oct(samples.header_xml(SHAPE, size={"Z": -7}), message="SizeZ='-7'"),
    "oct: zero size": _oct(samples.header_xml(SHAPE, size={"X": 0}), message="SizeX='0'"),
    "oct: size 1e3": _oct(samples.header_xml(SHAPE, size={"X": "1e3"}), message="SizeX='1e3'"),
    "oct: huge sizes": _oct(
        samples.header_xml(SHAPE, size={"Z": 9_999_999, "Y": 9_999_999}), message="need"
    ),
    "oct: NaN range": _oct(samples.header_xml(SHAPE, reach={"Z": "nan"}), message="RangeZ='nan'"),
    "oct: negative range": _oct(samples.header_xml(SHAPE, reach={"Y": -1}), message="RangeY='-1'"),
    "oct: infinite range": _oct(samples.header_xml(SHAPE, reach={"X": "1e999"}), message="RangeX"),
    "npy: pickled objects": pickled_npy,
    "npy: huge shape": file_of(npy(_npy_header("(99999999, 99999999, 99999999)")), "need 39999"),
    "npy: negative shape": file_of(npy(_npy_header("(-7, -5, 6)"), bytes(840)), "has no samples"),
    "npy: zero shape": file_of(npy(_npy_header("(7, 0, 6)")), "has no samples"),
    "npy: truncated": file_of(npy(_npy_header("(7, 5, 6)"), bytes(839)), "truncated"),
    "npy: one axis": file_of(npy(_npy_header("(210,)"), bytes(840)), "a volume has 3"),
    "npy: records": file_of(
        npy(_npy_header("(7, 5, 6)", "[('a', '<f4')]"), bytes(840)), "not real or"
    ),
    "npy: text": file_of(npy(_npy_header("(7, 5, 6)", "'<U1'"), bytes(840)), "not real or"),
    "npy: nested header": file_of(npy("(" * 100), "NumPy"),
    "npy: truncated header": file_of(npy(_npy_header("(7, 5, 6)"))[:50], "NumPy"),
    "npz: pickled description": pickled_npz,
    "npz: bomb": npz_bomb,
    "images: empty file": empty_image_in_folder,
    "images: mixed shapes": images_of_mixed_shapes,
    "images: mixed types": images_of_mixed_types,
    "images: none": folder_without_images,
    "images: zero width": file_of(png(0, 5), "", samples.GIVEN),
    "images: huge": file_of(png(2**31 - 1, 2**31 - 1), "", samples.GIVEN),
    "images: 400 million pixels": file_of(png(20000, 20000), "", samples.GIVEN),
    "images: truncated": file_of(png(1000, 1000, zlib.compress(bytes(5000))), "", samples.GIVEN),
    "tiff: huge": file_of(tiff(grey(2**31 - 1, 2**31 - 1), bytes(64)), "", samples.GIVEN),
    "tiff: huge, compressed": file_of(tiff(grey(60000, 60000, 8), bytes(64)), "", samples.GIVEN),
    "tiff: zero width": file_of(tiff(grey(0, 8), bytes(64)), "", samples.GIVEN),
    "tiff: circular pages": file_of(
        tiff(grey(8, 8, 8, 8), bytes(64), following=72), "circular", samples.GIVEN
    ),
    "tiff: strip beyond the end": file_of(
        tiff(grey(8, 8, 8, 10**6), bytes(64)), "truncated", samples.GIVEN
    ),
    "tiff: no pages": file_of(b"II*\0\0\0\0\0" + bytes(20), "", samples.GIVEN),
    "tiff: OME entity bomb": ome_entity_bomb,
    "tiff: OME names other files": ome_that_names_other_files,
    "nifti: huge": file_of(
        nifti(dim=[3, 32767, 32767, 32767, 1, 1, 1, 1]), "truncated", {"scale": "dB"}
    ),
    "nifti: negative": file_of(
        nifti(dim=[3, -6, 5, 7, 1, 1, 1, 1]) + bytes(840), "", {"scale": "dB"}
    ),
    "nifti: zero": file_of(
        nifti(dim=[3, 0, 5, 7, 1, 1, 1, 1]) + bytes(840), "no samples", {"scale": "dB"}
    ),
    "nifti: NaN spacing": file_of(
        nifti(pixdim=[1, np.nan, 1, 1, 1, 1, 1, 1]) + bytes(840),
        "spacing along x is nan",
        {"scale": "dB"},
    ),
    "nifti: offset beyond the end": file_of(
        nifti(vox_offset=1e18) + bytes(840), "", {"scale": "dB"}
    ),
    "nifti: negative offset": file_of(nifti(vox_offset=-1e9) + bytes(840), "", {"scale": "dB"}),
    "nifti: gzip bomb": file_of(
        _deflated(BOMB, head=nifti(dim=[3, 1024, 1024, 512, 1, 1, 1, 1]), wbits=31),
        "zip bomb",
        {"scale": "dB"},
    ),
    "dicom: huge": dicom(dicom_sizes, "do not fit in"),
    "dicom: truncated": dicom(lambda content: content[:-100], ""),
    "dicom: deflate bomb": dicom(dicom_deflate_bomb, "deflated"),
    "hdf5: nothing stored": h5(
        lambda f, _: f.create_dataset("v", (10**6, 10**6, 10**6), "f4"), "B-scan|0 bytes"
    ),
    "hdf5: huge chunks": h5(
        lambda f, _: f.create_dataset(
            "v", (1000, 1000, 1000), "f4", chunks=(1000, 1000, 1000), compression=9
        ),
        "too large",
    ),
    "hdf5: samples in another file": h5(h5_external, "in other files"),
    "hdf5: virtual dataset": h5(h5_virtual, "in other files"),
    "hdf5: link to another file": h5(h5_link, "a link into another file", variable="v"),
    "hdf5: truncated": file_of(b"\x89HDF\r\n\x1a\n" + bytes(100), "HDF5"),
    "mat: bomb": mat_bomb,
    "mat: huge shape": mat_size,
    "mat: negative shape": mat_negative,
    "raw: too many bytes": raw(RAW.replace("7", "6"), "30 bytes more"),
    "raw: too few bytes": raw(RAW.replace("7", "8"), "truncated"),
    "raw: huge shape": raw(RAW.replace("7", "99999999999999"), "truncated"),
    "raw: negative shape": raw(RAW.replace("[7", "[-7"), "has no samples"),
    "raw: negative offset": raw("offset = -1\n" + RAW, "offset -1"),
    "raw: object type": raw(RAW.replace("uint8", "object"), "dtype 'object'"),
    "raw: NaN spacing": raw(RAW.replace("[1, 1, 1]", "[nan, 1.0, 1.0]"), "spacing along z is nan"),
    "raw: no TOML": raw("shape = [", "cannot be read"),
    "raw: deep JSON": raw("shape = " + "[" * 5000, "cannot be read"),
    "zarr: pickle filter": zarr_edited(pickle_filter, ""),
    "zarr: huge chunks": zarr_edited(
        lambda t: t.replace("4,", "4000,").replace("2,", "2000,").replace("3", "3000"), ""
    ),
    "zarr: not JSON": zarr_edited(lambda t: t[:20], ""),
    "zarr: path outside": ome_zarr_outside,
    "netcdf: damaged heap": netcdf_damaged_heap,
    "tiff: pages beyond the end": file_of(
        tiff(grey(8, 8), bytes(64), following=10**9), "beyond the end", samples.GIVEN
    ),
    "tiff: a page without tags": file_of(
        tiff({}, bytes(64)), "samples of an unsupported type", samples.GIVEN
    ),
    "tiff: one strip of four": file_of(
        tiff(grey(8, 8, 8, 24) | {278: (1, 2)}, zlib.compress(bytes(range(16)))),
        "1 of 4 strips",
        samples.GIVEN,
    ),
    "tiff: strip at a place that is no number": file_of(
        tiff(grey(8, 8, 8)).replace(struct.pack("<HH", 273, 4), struct.pack("<HH", 273, 2)),
        "",
        samples.GIVEN,
    ),
    "zarr: chunks of nothing": zarr_chunks_of_nothing,
    "zarr: OME image is a group": ome_zarr_edited('"path": "0"', '"path": "/"'),
    "zarr: damaged Blosc chunk": zarr_damaged_blosc,
    "zarr: tiny chunks": zarr_tiny_chunks,
    "zarr: OME of another kind": ome_zarr_edited('"multiscales": [', '"multiscales": 5, "x": ['),
    "zarr: OME without path": ome_zarr_edited('"path": "0"', '"path": 0'),
    "npz: broken text": npz_broken_text,
    "a named pipe": named_pipe,
}


@pytest.mark.parametrize("name", CASES)
def test_is_a_clear_error_in_bounded_time_and_memory(
    name: str, sandbox: Sandbox, tmp_path: Path
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path, facts, message = CASES[name](tmp_path)
    before = sorted(p.name for p in tmp_path.iterdir())
    outcome = sandbox.open(path, facts)
    assert outcome.text.startswith("InputError: "), outcome.text
    assert path.name in outcome.text  # says where
    assert re.search(message, outcome.text), outcome.text
    assert outcome.seconds < 5
    assert outcome.memory < 500 * 2**20
    assert sorted(p.name for p in tmp_path.iterdir()) == before, "nothing is extracted or run"


def test_tiff_strip_that_unpacks_to_far_more_than_its_page(
    sandbox: Sandbox, tmp_path: Path
) -> None:
    """The decoder may stop at the page's size and succeed, or refuse: what counts is the bound."""
    path, facts, _ = tiff_strip_bomb(tmp_path)
    outcome = sandbox.open(path, facts)
    assert outcome.text == "read" or outcome.text.startswith("InputError: ")
    assert outcome.seconds < 5
    assert outcome.memory < 500 * 2**20


@given(data=st.binary(min_size=1, max_size=300), repeat=st.integers(1, 200))
def test_every_lzw_stream_that_an_encoder_makes_is_valid(data: bytes, repeat: int) -> None:
    scrambled = np.random.default_rng(repeat).permuted(np.frombuffer(data * repeat, np.uint8))
    for content in (data * repeat, scrambled.tobytes()):  # small tables, and full ones
        stream = imagecodecs.lzw_encode(content)
        assert is_valid(np.frombuffer(stream, np.uint8))
        assert is_valid(np.frombuffer(stream[: len(stream) // 2], np.uint8))


def test_lzw_streams_that_the_decoder_must_not_see(sandbox: Sandbox, tmp_path: Path) -> None:
    """It looks codes that are not in the table up in memory that nobody has filled."""
    rng = np.random.default_rng(0)
    pages = rng.integers(0, 60, (20, 40, 64), np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", pages, photometric="minisblack", compression="lzw")
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        offsets = [page.dataoffsets[0] for page in file.pages]
    whole = (tmp_path / "a.tif").read_bytes()
    refused = 0
    for _ in range(30):
        content = bytearray(whole)
        for offset in offsets:
            content[offset + rng.integers(40)] = rng.integers(256)
        (tmp_path / "a.tif").write_bytes(content)
        outcome = sandbox.open(tmp_path / "a.tif", samples.GIVEN)
        assert outcome.text == "read" or outcome.text.startswith("InputError: "), outcome.text
        refused += "LZW stream" in outcome.text
    assert refused > 5
