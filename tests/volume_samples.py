"""Small valid volumes in every format, for the tests and the fuzzer of the readers.

Every writer takes a folder and an array [z, y, x], and returns the path and what must be given to
``open_volume`` because the format cannot say it.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io
import tifffile
import xarray as xr
from PIL import Image

SPACING = {"z": 0.0035, "y": 0.02, "x": 0.01}
GIVEN: dict[str, Any] = {"spacing": SPACING, "scale": "linear"}
Sample = tuple[Path, dict[str, Any]]


def volume(shape: tuple[int, int, int] = (7, 5, 6), dtype: str = "float32") -> np.ndarray:
    """An array without any symmetry, so that swapped or flipped axes are seen."""
    rng = np.random.default_rng(1)
    values = rng.integers(1, 200, shape).astype(dtype)
    return values * (1 + 0.5j) if np.dtype(dtype).kind == "c" else values


def header_xml(
    shape: tuple[int, int, int],
    *,
    slash: str = "\\",
    size: dict[str, Any] | None = None,
    reach: dict[str, Any] | None = None,
    kind: str = "Real",
    extra: str = "",
    image: str = "",
    index: float = 1.0,
) -> str:
    """Header.xml as ThorImage lays it out, with attributes that can be spoiled."""
    nz, ny, nx = shape
    sizes = {"Z": nz, "X": nx, "Y": ny} | (size or {})
    ranges = {
        a: sizes[a] * SPACING[a.lower()] if isinstance(sizes[a], int) else 1 for a in "ZXY"
    } | (reach or {})
    attributes = " ".join(
        [f'Size{a}="{v}"' for a, v in sizes.items()]
        + [f'Range{a}="{v}"' for a, v in ranges.items()]
    )
    return f"""<?xml version="1.0" encoding="utf-8"?>
<Ocity version="1.0">
  <MetaInfo><Comment>h&#252;bsch</Comment><AcquisitionMode>Mode3D</AcquisitionMode></MetaInfo>
  <DataFiles>
    <DataFile Type="Real" SizeZ="2048" RangeZ="1" BytesPerPixel="4">data{slash}Chirp.data</DataFile>
    {extra}
    <DataFile Type="{kind}" {attributes} BytesPerPixel="4">data{slash}Intensity.data</DataFile>
  </DataFiles>
  <Image Type="Processed"><AxisOrder>ZXYT</AxisOrder>{image}</Image>
  <Acquisition><RefractiveIndex>{index}</RefractiveIndex></Acquisition>
</Ocity>"""


def thorlabs(
    path: Path,
    data: np.ndarray,
    *,
    slash: str = "\\",
    compression: int = zipfile.ZIP_DEFLATED,
    chirp: bytes = b"",
    xml: str | bytes | None = None,
) -> Path:
    """Write an .oct archive; the intensity is stored with z fastest, then x, then y."""
    samples = np.ascontiguousarray(data.transpose(1, 2, 0), "<f4").tobytes()
    with zipfile.ZipFile(path, "w", compression) as archive:
        # A directory entry's name is taken as it is: zipfile would turn no backslash on Linux.
        archive.writestr("Header.xml", header_xml(data.shape, slash=slash) if xml is None else xml)
        archive.writestr(zipfile.ZipInfo(f"data{slash}Chirp.data"), chirp)
        member = zipfile.ZipInfo(f"data{slash}Intensity.data")
        member.compress_type = compression
        archive.writestr(member, samples)
    return path


def _thorlabs(folder: Path, data: np.ndarray) -> Sample:
    return thorlabs(folder / "a.oct", data), {"refractive_index": 1.0}


def _thorlabs_slash(folder: Path, data: np.ndarray) -> Sample:
    path = thorlabs(folder / "b.oct", data, slash="/", compression=zipfile.ZIP_STORED)
    return path, {"refractive_index": 1.0}


def _npy(folder: Path, data: np.ndarray) -> Sample:
    np.save(folder / "a.npy", data)
    return folder / "a.npy", GIVEN | {"axes": "zyx"}


def _npy_fortran(folder: Path, data: np.ndarray) -> Sample:
    np.save(
        folder / "f.npy",
        np.asfortranarray(data.transpose(2, 0, 1)).astype(
            ">f8" if data.dtype.kind != "c" else ">c16"
        ),
    )
    return folder / "f.npy", GIVEN | {"axes": "xzy"}


def _npz(folder: Path, data: np.ndarray) -> Sample:
    np.savez_compressed(
        folder / "a.npz",
        scan=data.transpose(1, 0, 2),
        x_mm=np.arange(5),
        spacing_mm=[SPACING[a] for a in "yzx"],
        axes="yzx",
        scale="linear",
    )
    return folder / "a.npz", {}


def _npz_stored(folder: Path, data: np.ndarray) -> Sample:
    np.savez(folder / "s.npz", scan=data, axes="zyx", spacing_mm=list(SPACING.values()), scale="dB")
    return folder / "s.npz", {}


def _tiff(folder: Path, data: np.ndarray) -> Sample:
    tifffile.imwrite(
        folder / "a.tif", data.transpose(1, 0, 2), photometric="minisblack", metadata=None
    )
    return folder / "a.tif", GIVEN


def _tiff_compressed(folder: Path, data: np.ndarray) -> Sample:
    tifffile.imwrite(
        folder / "c.tif",
        data.transpose(1, 0, 2),
        photometric="minisblack",
        compression="zlib",
        byteorder=">",
        rowsperstrip=3,
    )
    return folder / "c.tif", GIVEN


def _tiff_imagej(folder: Path, data: np.ndarray) -> Sample:
    tifffile.imwrite(
        folder / "ij.tif",
        data.transpose(1, 0, 2),
        imagej=True,
        resolution=(1 / 10, 1 / 3.5),
        metadata={"axes": "ZYX", "spacing": 20.0, "unit": "um"},
    )
    return folder / "ij.tif", {"scale": "linear"}


def _tiff_ome(folder: Path, data: np.ndarray) -> Sample:
    tifffile.imwrite(
        folder / "o.ome.tif",
        data,
        photometric="minisblack",
        compression="lzw",
        metadata={
            "axes": "ZYX",
            "PhysicalSizeX": 10.0,
            "PhysicalSizeY": 20.0,
            "PhysicalSizeZ": 3.5,
            "PhysicalSizeXUnit": "µm",
            "PhysicalSizeYUnit": "µm",
            "PhysicalSizeZUnit": "µm",
        },
    )
    return folder / "o.ome.tif", {"scale": "linear"}


def _folder(folder: Path, data: np.ndarray) -> Sample:
    images = folder / "bscans"
    images.mkdir()
    for y in range(data.shape[1]):
        Image.fromarray(data[:, y].astype(np.uint8)).save(images / f"scan_{y + 8}.png")
    (images / "Thumbs.db").write_bytes(b"not an image")
    return images, GIVEN


def _folder_tiff(folder: Path, data: np.ndarray) -> Sample:
    images = folder / "tiffs"
    images.mkdir()
    for y in range(data.shape[1]):
        tifffile.imwrite(
            images / f"scan_{y + 8}.tif", data[:, y].astype(np.uint16), compression="packbits"
        )
    return images, GIVEN


def _mat5(folder: Path, data: np.ndarray) -> Sample:
    scipy.io.savemat(
        folder / "a.mat",
        {
            "vol": data,
            "note": "phantom",
            "axes": "zyx",
            "spacing_mm": list(SPACING.values()),
            "scale": "linear",
        },
        do_compression=True,
    )
    return folder / "a.mat", {}


def _mat5_plain(folder: Path, data: np.ndarray) -> Sample:
    scipy.io.savemat(folder / "p.mat", {"vol": data.transpose(0, 2, 1), "s": {"a": 1.0}})
    return folder / "p.mat", GIVEN | {"axes": "zxy"}


def _mat73(folder: Path, data: np.ndarray) -> Sample:
    path = folder / "m73.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        stored = data.T  # MATLAB's [z, y, x] as HDF5 counts it
        if data.dtype.kind == "c":
            pairs = np.empty(stored.shape, [("real", "<f8"), ("imag", "<f8")])
            pairs["real"], pairs["imag"] = stored.real, stored.imag
            stored = pairs
        file.create_dataset("vol", data=stored, chunks=(2, 3, 7), compression="gzip")
        file["axes"] = np.array([[ord(c)] for c in "zyx"], np.uint16)
        file["axes"].attrs["MATLAB_class"] = np.bytes_("char")
        file["spacing_mm"] = np.array([list(SPACING.values())]).T
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    with path.open("r+b") as raw:
        raw.write(head)
    return path, {"scale": "linear"}


def _hdf5(folder: Path, data: np.ndarray) -> Sample:
    with h5py.File(folder / "a.h5", "w") as file:
        dataset = file.create_dataset(
            "scans/oct", data=data.transpose(2, 1, 0), chunks=(3, 2, 7), compression="gzip"
        )
        dataset.attrs["axes"] = "xyz"
        dataset.attrs["spacing_mm"] = [SPACING[a] for a in "xyz"]
        dataset.attrs["scale"] = "linear"
        file["mask"] = np.ones((5, 6))
    return folder / "a.h5", {}


def _netcdf(folder: Path, data: np.ndarray) -> Sample:
    coords = {
        a: (a, 1000 * SPACING[a] * np.arange(n), {"units": "um"})
        for a, n in zip("zyx", data.shape, strict=True)
    }
    xr.DataArray(data, coords=coords, dims=tuple("zyx"), name="oct").to_netcdf(
        folder / "a.nc", engine="h5netcdf"
    )
    return folder / "a.nc", {"scale": "linear"}


def _raw(folder: Path, data: np.ndarray) -> Sample:
    path = folder / "scan.raw"
    path.write_bytes(b"head" + data.transpose(1, 2, 0).astype(">u2").tobytes())
    nz, ny, nx = data.shape
    sidecar = folder / "scan.raw.toml"
    sidecar.write_text(
        f'dtype = "uint16"\nbyte_order = "big"\noffset = 4\naxes = "yxz"\n'
        f"shape = [{ny}, {nx}, {nz}]\n"
        f"spacing_mm = [{SPACING['y']}, {SPACING['x']}, {SPACING['z']}]\nscale = 'linear'\n"
    )
    return path, {}


def _raw_json(folder: Path, data: np.ndarray) -> Sample:
    path = folder / "scan.bin"
    path.write_bytes(data.tobytes())
    entries = {
        "dtype": data.dtype.name,
        "shape": data.shape,
        "axes": "zyx",
        "spacing_mm": list(SPACING.values()),
    }
    (folder / "scan.bin.json").write_text(json.dumps(entries | {"scale": "linear"}))
    return path, {}


def _nifti(folder: Path, data: np.ndarray) -> Sample:
    import nibabel

    image = nibabel.Nifti1Image(data.transpose(2, 1, 0), np.diag([10, 20, 3.5, 1]))
    image.header.set_xyzt_units("micron")
    nibabel.save(image, folder / "a.nii")
    return folder / "a.nii", {"scale": "linear"}


def _nifti_gz(folder: Path, data: np.ndarray) -> Sample:
    import nibabel

    image = nibabel.Nifti2Image(data.transpose(0, 1, 2)[..., None], np.eye(4))
    nibabel.save(image, folder / "g.nii.gz")
    return folder / "g.nii.gz", GIVEN | {"axes": "zyx"}


def _dicom(folder: Path, data: np.ndarray) -> Sample:
    import pydicom
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.uid import (
        ExplicitVRLittleEndian,
        MultiFrameGrayscaleWordSecondaryCaptureImageStorage,
    )

    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = MultiFrameGrayscaleWordSecondaryCaptureImageStorage
    meta.MediaStorageSOPInstanceUID = "1.2.3"
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset = FileDataset(None, {}, file_meta=meta, preamble=b"\0" * 128)
    dataset.Rows, dataset.NumberOfFrames, dataset.Columns = data.shape
    dataset.SamplesPerPixel, dataset.PhotometricInterpretation = 1, "MONOCHROME2"
    dataset.BitsAllocated = dataset.BitsStored = 16
    dataset.HighBit, dataset.PixelRepresentation = 15, 0
    measures = pydicom.Dataset()
    measures.PixelSpacing = [SPACING["z"], SPACING["x"]]
    measures.SpacingBetweenSlices = SPACING["y"]
    groups = pydicom.Dataset()
    groups.PixelMeasuresSequence = [measures]
    dataset.SharedFunctionalGroupsSequence = [groups]
    dataset.PixelData = data.transpose(1, 0, 2).astype("<u2").tobytes()
    dataset.save_as(folder / "a.dcm", enforce_file_format=True)
    return folder / "a.dcm", {"scale": "linear"}


def _zarr(folder: Path, data: np.ndarray) -> Sample:
    import zarr

    array = zarr.create_array(
        str(folder / "a.zarr"), shape=data.shape, chunks=(4, 2, 3), dtype=data.dtype
    )
    array[:] = data
    array.attrs.update({"axes": "zyx", "spacing_mm": list(SPACING.values()), "scale": "linear"})
    return folder / "a.zarr", {}


def _ome_zarr(folder: Path, data: np.ndarray) -> Sample:
    import zarr

    group = zarr.open_group(str(folder / "o.zarr"), mode="w", zarr_format=2)
    array = group.create_array(
        "0", shape=(1, 1, *data.shape), chunks=(1, 1, 4, 2, 3), dtype=data.dtype
    )
    array[:] = data[None, None]
    axes = [{"name": "t", "type": "time"}, {"name": "c", "type": "channel"}]
    axes += [{"name": a, "type": "space", "unit": "micrometer"} for a in "zyx"]
    scale = [1, 1, *(1000 * v for v in SPACING.values())]
    datasets = [{"path": "0", "coordinateTransformations": [{"type": "scale", "scale": scale}]}]
    group.attrs["multiscales"] = [{"version": "0.4", "axes": axes, "datasets": datasets}]
    return folder / "o.zarr", {"scale": "linear"}


WRITERS: dict[str, Callable[[Path, np.ndarray], Sample]] = {
    name.strip("_"): writer
    for name, writer in list(globals().items())
    if name.startswith("_") and callable(writer) and not name.startswith("__")
}
COMPLEX = ("npy", "npy_fortran", "npz", "mat5", "mat5_plain", "mat73", "hdf5", "raw_json", "zarr")
