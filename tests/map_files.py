"""Files of thickness maps made on purpose: formats x conventions x faults, each with its answer.

Every case is a function that writes a file into a folder and returns its path, options for
``read_thickness_map``, and the answer: a map in mm (with its coordinates where the file has them),
or what the refusal must say.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import scipy.io
import scipy.sparse
import tifffile
import xarray as xr

MAP = 0.4 + 0.1 * np.random.default_rng(5).random((4, 5)).round(3)
SQUARE = 0.4 + 0.1 * np.random.default_rng(6).random((4, 4)).round(3)
X, Y = np.array([0.0, 0.2, 0.4, 0.6, 0.8]), np.array([1.0, 1.3, 1.6, 1.9])
FIELD = {"field_of_view": (2.0, 1.0)}
HOLE = np.zeros(MAP.shape, bool)
HOLE[1, 3] = HOLE[2, 0] = True
HOLED = np.where(HOLE, np.nan, MAP)

#: name: (dims, values, attributes)
Parts = dict[str, tuple[tuple[str, ...], Any, dict[str, Any]]]


class Read(NamedTuple):
    """The map that must come out."""

    values: np.ndarray
    x: np.ndarray | None = None
    y: np.ndarray | None = None


class Refused(NamedTuple):
    """What the error must say, as a regular expression."""

    says: str


class Case(NamedTuple):
    write: Callable[[Path], Path]
    options: dict[str, Any]
    answer: Read | Refused


CASES: dict[str, Case] = {}


def add(name: str, write: Callable[[Path], Path], answer: Read | Refused, **options: Any) -> None:
    assert name not in CASES, name
    CASES[name] = Case(write, options or FIELD, answer)


def may_be_labels(values: np.ndarray) -> bool:
    """Tell whether first line and column look like labels.

    One of them is evenly spaced, as numbers of pixels are, or, with no number in the corner, both
    rise or fall, as coordinates do.
    """
    edges = values[0], values[:, 0]
    if np.isnan(values[0, 0]) and min(values.shape) > 2:
        steps = [np.diff(edge[1:]) for edge in edges]
        if all((s > 0).all() or (s < 0).all() for s in steps):
            return True
    return any(np.allclose(np.diff(edge, 2), 0.0) for edge in edges)


# --- containers ---------------------------------------------------------------------------------


def netcdf4(path: Path, parts: Parts) -> None:
    _dataset(parts).to_netcdf(path, engine="h5netcdf", encoding=_encoding(parts))


def netcdf3(path: Path, parts: Parts) -> None:
    _dataset(parts).to_netcdf(path, engine="scipy", encoding=_encoding(parts))


def _dataset(parts: Parts) -> xr.Dataset:
    return xr.Dataset(
        {name: (dims, values, attrs) for name, (dims, values, attrs) in parts.items()}
    )


def _encoding(parts: Parts) -> dict[str, Any]:
    return {name: {"_FillValue": None} for name, p in parts.items() if "_FillValue" not in p[2]}


def hdf5_scales(path: Path, parts: Parts) -> None:
    """Plain HDF5 whose axes are named by dimension scales."""
    with h5py.File(path, "w") as file:
        for name, (_, values, attrs) in parts.items():
            file[name] = values
            file[name].attrs.update(attrs)
        for name, (dims, _, _) in parts.items():
            for dim in dims:
                if dim == name:
                    file[name].make_scale(name)
        for name, (dims, values, _) in parts.items():
            for axis, dim in enumerate(dims):
                if dim == name:
                    continue
                if dim not in file:
                    file[dim] = np.zeros(np.shape(values)[axis])
                    file[dim].make_scale("This is a netCDF dimension but not a netCDF variable.")
                file[name].dims[axis].attach_scale(file[dim])


def hdf5_labels(path: Path, parts: Parts) -> None:
    """Plain HDF5 whose axes have labels only."""
    with h5py.File(path, "w") as file:
        for name, (dims, values, attrs) in parts.items():
            file[name] = values
            file[name].attrs.update(attrs)
            for axis, dim in enumerate(dims):
                file[name].dims[axis].label = dim


def matlab5(path: Path, parts: Parts) -> None:
    scipy.io.savemat(path, {name: values for name, (_, values, _) in parts.items()})


def matlab73(path: Path, parts: Parts) -> None:
    """What MATLAB's ``save -v7.3`` writes: column-major arrays in HDF5 behind a header."""
    kinds = {"b": "logical", "f": "double", "U": "char", "u": "uint8", "i": "int32"}
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, (_, given, _) in parts.items():
            values = np.asarray(given)
            kind = kinds[values.dtype.kind]
            if kind == "char":
                values = np.array([[ord(c) for c in str(given)]], np.uint16)
            values = np.atleast_2d(values.astype("u1") if kind == "logical" else values)
            file.create_dataset(name, data=values.T).attrs["MATLAB_class"] = np.bytes_(kind)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def npz(path: Path, parts: Parts) -> None:
    with path.open("wb") as stream:
        np.savez(stream, **{name: values for name, (_, values, _) in parts.items()})


LABELLED = {"nc4": netcdf4, "nc3": netcdf3, "h5scales": hdf5_scales, "h5labels": hdf5_labels}
BARE = {"mat5": matlab5, "mat73": matlab73, "npz": npz}
NETCDF = {"nc4": netcdf4, "nc3": netcdf3}
ATTRIBUTES = {"nc4": netcdf4, "nc3": netcdf3, "h5": hdf5_labels}
ALL = LABELLED | BARE


def stored(write: Callable[[Path, Parts], None], parts: Parts) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        write(folder / "map.dat", parts)
        return folder / "map.dat"

    return make


def named(name: str, values: Any, dims: tuple[str, ...] = ("y", "x"), **attrs: Any) -> Parts:
    return {name: (dims, values, attrs)}


COORDINATES: Parts = {"x": (("x",), X, {"units": "mm"}), "y": (("y",), Y, {"units": "mm"})}

# --- which axis is which ------------------------------------------------------------------------

for fmt, write in LABELLED.items():
    add(f"{fmt} (y, x)", stored(write, named("L1", MAP)), Read(MAP))
    add(f"{fmt} (x, y) is turned", stored(write, named("L1", MAP.T, ("x", "y"))), Read(MAP))
    add(
        f"{fmt} square (x, y) is turned",
        stored(write, named("L1", SQUARE.T, ("x", "y"))),
        Read(SQUARE),
    )
    add(
        f"{fmt} (column, row) is turned",
        stored(write, named("L1", MAP.T, ("column", "row"))),
        Read(MAP),
    )
    add(
        f"{fmt} other names of axes say nothing",
        stored(write, named("L1", MAP, ("a", "b"))),
        Read(MAP),
    )
    add(
        f"{fmt} B-scan (z, x)",
        stored(write, named("L1", MAP, ("z", "x"))),
        Refused(r"dimensions \(z, x\), not \(y, x\)"),
    )
    add(
        f"{fmt} x runs along the first dimension",
        stored(
            write,
            {
                "L1": (("a", "b"), SQUARE.T, {}),
                "x": (("a",), X[:4], {"units": "mm"}),
                "y": (("b",), Y, {"units": "mm"}),
            },
        ),
        Read(SQUARE, X[:4], Y),
        variable="L1",
    )
for fmt, write in NETCDF.items():
    add(
        f"{fmt} (x, y) with coordinates in um",
        stored(
            write,
            {
                "L1": (("x", "y"), MAP.T, {}),
                "x": (("x",), 1000 * X, {"units": "um"}),
                "y": (("y",), Y, {}),
            },
        ),
        Read(MAP, X, Y),
        variable="L1",
    )
    for silent, positions in (("x", 1000 * X), ("y", 1000 * Y)):
        other = "y" if silent == "x" else "x"
        add(
            f"{fmt} um along {other}, and perhaps along {silent}",
            stored(
                write,
                {
                    "L1": (("x", "y"), MAP.T, {}),
                    "x": (("x",), 1000 * X + 0.5, {"units": "um"}),
                    "y": (("y",), 1000 * Y + 0.5, {"units": "um"}),
                    silent: ((silent,), positions * 0.987, {}),
                },
            ),
            Refused(f"{other} is in um, and {silent} states no unit: um as well, or mm"),
            variable="L1",
        )
    add(
        f"{fmt} axis attributes name the axes",
        stored(
            write,
            {
                "L1": (("e", "n"), MAP.T, {}),
                "e": (("e",), X, {"axis": "X"}),
                "n": (("n",), Y, {"axis": "Y"}),
            },
        ),
        Read(MAP, X, Y),
        variable="L1",
    )
    add(
        f"{fmt} descending y",
        stored(write, {"L1": (("y", "x"), MAP, {}), **COORDINATES, "y": (("y",), Y[::-1], {})}),
        Read(MAP[::-1], X, Y),
        variable="L1",
    )
grids = np.meshgrid(X, Y)
for fmt, write in BARE.items():
    bare = (), MAP, {}
    add(
        f"{fmt} coordinates of every pixel, meshgrid",
        stored(write, {"L1": bare, "x": ((), grids[0], {}), "y": ((), grids[1], {})}),
        Read(MAP, X, Y),
        variable="L1",
    )
    add(
        f"{fmt} coordinates of every pixel, ndgrid: the map is turned",
        stored(
            write,
            {"L1": ((), MAP.T, {}), "X_um": ((), 1000 * grids[0].T, {}), "Y": ((), grids[1].T, {})},
        ),
        Read(MAP, X, Y),
        variable="L1",
    )
    add(
        f"{fmt} x as long as the rows",
        stored(write, {"L1": bare, "x": ((), Y, {}), "y": ((), X, {})}),
        Refused("4 rows along y and 5 columns along x"),
        variable="L1",
    )
    add(
        f"{fmt} coordinates along x only",
        stored(write, {"L1": bare, "x": ((), X, {})}),
        Refused("both x and y"),
        variable="L1",
    )
    add(
        f"{fmt} coordinates against the field of view",
        stored(write, {"L1": bare, "x": ((), X, {}), "y": ((), Y, {})}),
        Refused("contradicts the coordinates"),
        variable="L1",
        **FIELD,
    )

NAMES = (
    "nx ny|Nx Ny|xc yc|xdim ydim|x_dim y_dim|dim_x dim_y|ix iy|n_x n_y|X-axis Y-axis|"
    "x_index y_index|x_pix y_pix|x_px y_px|xpixel ypixel|xsize ysize|xx yy|pos_x pos_y|"
    "axis_x axis_y|coord_x coord_y|scan_x scan_y|x_grid y_grid|xdir ydir|lateral_x lateral_y|"
    "x_lateral y_lateral|ncol nrow|ncols nrows|n_cols n_rows|pixel line|samples lines|"
    "projection_x_coordinate projection_y_coordinate|image_width image_height|qx qy|nx row|"
    "pixelX yPixel|xc lines|xpos other|of_xy_x of_xy_y"
)
for pair in NAMES.split("|"):
    dims = tuple(pair.split())
    add(f"nc3 ({pair})", stored(netcdf3, named("L1", SQUARE.T, dims)), Read(SQUARE))
for pair in ("nx ny", "n_cols n_rows", "x_lateral y_lateral"):
    dims = tuple(pair.split())
    for fmt, write in LABELLED.items():
        if fmt != "nc3":
            add(f"{fmt} ({pair})", stored(write, named("L1", SQUARE.T, dims)), Read(SQUARE))
SCANS = (
    "A-line frame|aline frame|A-lines B-scans|nAlines nFrames|n_a_lines n_b_scans|ALine BLine|"
    "A-scan_number B-scan_number|ascan lines|line frame|line B-scan"
)
for pair in SCANS.split("|"):
    for fmt, write in NETCDF.items():
        one, other = pair.split()
        add(f"{fmt} ({pair})", stored(write, named("L1", MAP.T, (one, other))), Read(MAP))
        add(f"{fmt} ({other} {one})", stored(write, named("L1", MAP, (other, one))), Read(MAP))
for pair in ("line other", "other lines", "scan_line other", "line line2"):
    parts = named("L1", MAP, tuple(pair.split()))
    add(
        f"nc3 ({pair})",
        stored(netcdf3, parts),
        Refused(r"line\w*' may be x or y.*name them y and x"),
    )
add(
    "nc3 lines with a coordinate beside them",
    stored(
        netcdf3,
        {
            "L1": (("line", "other"), SQUARE, {}),
            "x": (("other",), X[:4], {"units": "mm"}),
            "y": (("line",), Y, {"units": "mm"}),
        },
    ),
    Read(SQUARE, X[:4], Y),
    variable="L1",
)
for pair in ("nz nx", "depth x", "axial lateral"):
    parts = named("L1", MAP, tuple(pair.split()))
    add(f"nc3 ({pair})", stored(netcdf3, parts), Refused(r"dimensions \(.*\), not \(y, x\)"))
for fmt, write in LABELLED.items():
    masked: Parts = {
        "L1": (("band", "x", "y"), SQUARE.T[np.newaxis], {}),
        "filled": (("band", "x", "y"), HOLE[np.newaxis, :, :4].transpose(0, 2, 1) * 1.0, {}),
    }
    add(
        f"{fmt} (band, x, y)",
        stored(write, masked),
        Read(np.where(HOLE[:, :4], np.nan, SQUARE)),
        variable="L1",
        **FIELD,
    )
    parts = named("L1", MAP[..., np.newaxis], ("y", "x", "time"))
    add(f"{fmt} (y, x, time)", stored(write, parts), Read(MAP))
    parts = named("L1", MAP[:, np.newaxis], ("z", "y", "x"))
    add(f"{fmt} one B-scan (z, y, x)", stored(write, parts), Refused(r"\(z, x\), not \(y, x\)"))
for fmt, write in BARE.items():
    add(f"{fmt} 4 x 5 x 1", stored(write, {"L1": ((), MAP[..., np.newaxis], {})}), Read(MAP))
    add(f"{fmt} 1 x 4 x 5", stored(write, {"L1": ((), MAP[np.newaxis], {})}), Read(MAP))
parts = named("L1", SQUARE, ("x_row", "x_row2"))
add("nc3 x twice", stored(netcdf3, parts), Refused("the same twice"))
add(
    "nc3 (nx, ny) with coordinates",
    stored(
        netcdf3,
        {
            "L1": (("nx", "ny"), SQUARE.T, {}),
            "nx": (("nx",), X[:4], {"units": "mm"}),
            "ny": (("ny",), Y, {"units": "mm"}),
        },
    ),
    Read(SQUARE, X[:4], Y),
    variable="L1",
)

# --- units --------------------------------------------------------------------------------------

SCALES = {"mm": 1.0, "um": 1e3, "nm": 1e6, "microns": 1e3}
for fmt, write in ALL.items():
    for unit, factor in SCALES.items():
        if fmt == "h5scales" or (fmt == "nc3" and unit == "mm"):
            continue
        add(f"{fmt} L1_{unit}", stored(write, named(f"L1_{unit}", factor * MAP)), Read(MAP))
for fmt, write in ATTRIBUTES.items():
    for key, text, factor in (
        ("units", "um", 1e3),
        ("unit", "um", 1e3),
        ("Units", "microns", 1e3),
        ("Unit", "nm", 1e6),
        ("units", "metres", 1e-3),
        ("UNITS", "Millimeter", 1.0),
    ):
        parts = named("L1", factor * MAP, **{key: text})
        add(f"{fmt} attribute {key} = {text}", stored(write, parts), Read(MAP))
    add(
        f"{fmt} unit that is no length",
        stored(write, named("L1", MAP, units="pixel")),
        Refused("'pixel'; known units of length"),
    )
    add(
        f"{fmt} suffix against attribute",
        stored(write, named("L1_um", MAP, Units="mm")),
        Refused("contradicting units of length: its name says um, its Units attribute says mm"),
    )
for fmt, write in BARE.items():
    parts = {"L1": ((), 1e3 * MAP, {}), "units": ((), "um", {})}
    add(f"{fmt} text units beside the map", stored(write, parts), Read(MAP))
    parts = parts | {"x": ((), X, {}), "y": ((), Y, {})}
    add(
        f"{fmt} text units that may be those of the coordinates too",
        stored(write, parts),
        Refused("for the coordinates too"),
        variable="L1",
    )

# --- masks --------------------------------------------------------------------------------------

for fmt, write in ALL.items():
    if fmt == "h5labels":
        continue
    kinds = {"float": float, "whole": np.uint8} | ({"bool": bool} if fmt != "nc3" else {})
    for kind, dtype in kinds.items():
        parts = {"L1": (("y", "x"), MAP, {}), "filled": (("y", "x"), HOLE.astype(dtype), {})}
        if not (fmt in ("nc3", "h5scales") and kind == "whole"):
            add(f"{fmt} {kind} mask filled", stored(write, parts), Read(HOLED))
    small = HOLE[:, :4].astype(float)
    parts = {"L1": (("y", "x"), MAP, {}), "filled": (("y", "x2"), small, {})}
    add(f"{fmt} mask of another shape", stored(write, parts), Refused("marks 4 x 4 pixels"))
    parts = {"L1": (("y", "x"), MAP, {}), "filled": (("y", "x"), 255.0 * HOLE, {})}
    add(f"{fmt} mask of 0 and 255", stored(write, parts), Refused("should hold 0 and 1"))
for fmt, write in BARE.items():
    parts = {"L1": ((), MAP, {}), "filled": ((), HOLE.T.astype(float), {})}
    add(f"{fmt} transposed mask", stored(write, parts), Refused("is it transposed"))
    parts = {"L1": ((), MAP, {}), "mask": ((), (~HOLE).astype(float), {})}
    add(f"{fmt} mask that may mean either", stored(write, parts), Refused("does not say what"))
for fmt, write in LABELLED.items():
    parts = {"L1": (("y", "x"), MAP, {}), "filled": (("x", "y"), HOLE.T.astype(float), {})}
    add(f"{fmt} mask (x, y) is turned", stored(write, parts), Read(HOLED))

# --- missing values -----------------------------------------------------------------------------

DEFAULT_FILL = 9.969209968386869e36


def packed(values: np.ndarray, fill: int = -1) -> np.ndarray:
    return np.where(np.isnan(values), fill, np.round((values - 0.3) / 1e-4)).astype("i2")


PACKED = {"scale_factor": 1e-4, "add_offset": 0.3}
for fmt, write in NETCDF.items():
    holes = np.where(HOLE, -1.0, MAP)
    for what, parts in {
        "_FillValue": named("L1", holes, _FillValue=-1.0),
        "missing_value": named("L1", holes, missing_value=-1.0),
        "valid_range": named("L1", np.where(HOLE, 77.7, MAP), valid_range=[0.0, 1.0]),
        "valid_min": named("L1", np.where(HOLE, 0.001, MAP), valid_min=0.1),
        "valid_max": named("L1", np.where(HOLE, 77.7, MAP), valid_max=1.0),
        "netCDF's default fill": named("L1", np.where(HOLE, DEFAULT_FILL, MAP)),
        "netCDF's default fill, single": named(
            "L1", np.where(HOLE, DEFAULT_FILL, MAP).astype("f4")
        ),
        "_FillValue in double precision": named(
            "L1", np.where(HOLE, 0.1, MAP).astype("f4"), missing_value=0.1
        ),
        "valid_range of bytes without a sign": named(
            "L1",
            np.where(HOLE, 250, 200 * MAP + 0.5).astype("u1").view("i1"),
            _Unsigned="true",
            valid_range=np.array([0, -16], "i1"),
            scale_factor=np.float32(1 / 200),
        ),
        "scale and offset": named("L1", packed(HOLED), _FillValue=np.int16(-1), **PACKED),
        "scale and offset, netCDF's default fill": named("L1", packed(HOLED, -32767), **PACKED),
        "valid_range of packed values": named(
            "L1", packed(HOLED, 9000), valid_range=np.array([0, 3000], "i2"), **PACKED
        ),
        "valid_range of unpacked values": named(
            "L1", packed(HOLED, 9000), valid_range=[0.0, 0.7], **PACKED
        ),
    }.items():
        expected = np.floor(200 * HOLED + 0.5) / 200 if "bytes" in what else HOLED
        add(f"{fmt} {what}", stored(write, parts), Read(expected))
    add(
        f"{fmt} valid_range that is no range",
        stored(write, named("L1", MAP, valid_range=[0.0, 1.0, 2.0])),
        Refused("valid_range"),
    )


def hdf5(build: Callable[[h5py.File], Any]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        with h5py.File(folder / "map.h5", "w") as file:
            build(file)
        return folder / "map.h5"

    return make


def partly_written(file: h5py.File, fill: float | None) -> None:
    dataset = file.create_dataset("L1", MAP.shape, "f8", chunks=(2, 3), fillvalue=fill)
    dataset[:, :3] = MAP[:, :3]
    dataset[:2, 3:] = MAP[:2, 3:]


UNWRITTEN = MAP.copy()
UNWRITTEN[2:, 3:] = np.nan
add("h5 chunks never written", hdf5(lambda f: partly_written(f, None)), Read(UNWRITTEN))
add("h5 chunks never written, fill 0.45", hdf5(lambda f: partly_written(f, 0.45)), Read(UNWRITTEN))
add(
    "h5 fill value of the dataset",
    hdf5(lambda f: f.create_dataset("L1", data=np.where(HOLE, 0.123, MAP), fillvalue=0.123)),
    Read(HOLED),
)
add(
    "h5 nothing written",
    hdf5(lambda f: f.create_dataset("L1", (4, 5), "f8", chunks=(2, 3))),
    Refused("only 0 bytes stored"),
)
add("h5 map in a group", hdf5(lambda f: f.create_dataset("scan/L1", data=MAP)), Read(MAP))


def npy(values: Any) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        np.save(folder / "map.npy", values)
        return folder / "map.npy"

    return make


add("npy 4 x 5 x 1", npy(MAP[..., np.newaxis]), Read(MAP))
add("npy 1 x 1 x 4 x 5", npy(MAP[np.newaxis, np.newaxis]), Read(MAP))
for mark in (999.0, 9999.0, 99999.0, 999.9, 32767.0, 65535.0, 1e20, DEFAULT_FILL / 2, 3.4e38):
    add(f"npy {mark:g} for missing", npy(np.where(HOLE, mark, MAP)), Refused("a mark of missing"))
for mark in (0.0, -1.0, -999.0, -9999.0):
    add(
        f"npy {mark:g} for missing",
        npy(np.where(HOLE, mark, MAP)),
        Refused("missing pixels with NaN"),
    )
add("npy NaN for missing", npy(HOLED), Read(HOLED))
one = np.full((20, 20), np.nan)
one[7, 9] = 0.45
add("npy one pixel of 400", npy(one), Refused("only 0.2% of the layer"))
few = np.where(np.arange(400).reshape(20, 20) < 195, 0.45, np.nan)
add("npy less than half measured", npy(few), Refused("only 48.8% of the layer"))
most = np.where(np.arange(400).reshape(20, 20) < 300, 0.45, np.nan)
add("npy three quarters measured", npy(most), Read(most))
add(
    "npy layer where it is measured",
    npy(few),
    Read(few),
    field_of_view=(19.0, 19.0),
    layer_extent=(0.0, 19.0, 0.0, 8.0),
)
add(
    "npy 999 um is a thickness",
    npy(np.where(HOLE, 999.0, 900 + 100 * MAP)),
    Read(np.where(HOLE, 0.999, 0.9 + 0.1 * MAP)),
    length_unit="um",
    **FIELD,
)
for kind, values, says in (
    ("counts", (1000 * MAP).astype(int), "pixel counts"),
    ("flags", MAP > 0.45, "type bool"),
    ("complex", MAP + 0j, "complex128"),
    ("text", MAP.astype(str), "floating-point"),
    ("volume", np.ones((3, 4, 5)), "3 x 4 x 5"),
    ("row", MAP[:1], "1 x 5"),
    ("infinite", np.where(HOLE, np.inf, MAP), "infinite"),
):
    add(f"npy {kind}", npy(values), Refused(says))
add("npy big-endian", npy(MAP.astype(">f8")), Read(MAP))
add("npy columns first", npy(np.asfortranarray(MAP)), Read(MAP))
add("npy half precision", npy(MAP.astype("f2")), Read(MAP.astype("f2").astype(float)))


def npy_of_two(folder: Path) -> Path:
    with (folder / "map.npy").open("wb") as file:
        np.save(file, MAP)
        np.save(file, HOLE)
    return folder / "map.npy"


add("npy two arrays one after the other", npy_of_two, Refused("bytes follow its array"))


def of_pandas(file: h5py.File, blocks: int) -> None:
    file["t/axis0"], file["t/axis1"] = np.arange(5), np.arange(4)
    file["t/block0_values"] = MAP
    if blocks > 1:
        file["t/block1_values"] = np.arange(4)[:, np.newaxis]


add("h5 pandas", hdf5(lambda f: of_pandas(f, 1)), Read(MAP))
add("h5 pandas, columns of two types", hdf5(lambda f: of_pandas(f, 2)), Refused("a pandas table"))

# --- text ---------------------------------------------------------------------------------------


def text(content: str | bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        raw = content.encode() if isinstance(content, str) else content
        (folder / "map.csv").write_bytes(raw)
        return folder / "map.csv"

    return make


def rows(separator: str = ",", end: str = "", values: np.ndarray = MAP) -> str:
    return "".join(
        separator.join("" if np.isnan(v) else f"{v:.17g}" for v in row) + end + "\n"
        for row in values
    )


def pandas(**options: Any) -> str:
    import pandas as pd

    return str(pd.DataFrame(MAP).to_csv(**options))


last = MAP.copy()
last[:, -1] = np.nan
partly = MAP.copy()
partly[1:, -1] = np.nan
corner = MAP[:, ::-1].copy()
corner[0, 0] = np.nan
names = ",".join("abcde")
points = "".join(
    f"{x},{y},{v}\n"
    for y, row in zip(Y, MAP, strict=True)
    for x, v in zip(X + 0.1, row, strict=True)
)
for name, content, answer in (
    ("pandas with header and index", pandas(), Read(MAP)),
    ("pandas with header", pandas(index=False), Read(MAP)),
    ("pandas with index", pandas(header=False), Refused("counts the lines")),
    ("pandas with named columns and index", pandas(header=list("abcde")), Read(MAP)),
    ("pandas with named columns", pandas(header=list("abcde"), index=False), Read(MAP)),
    ("pandas with a named index", pandas(index_label="row"), Refused("line 1, column 1: 'row'")),
    (
        "pandas, named index and columns",
        pandas(header=list("abcde"), index_label="row"),
        Refused("counts the lines"),
    ),
    (
        "R with row names",
        '"","V1","V2","V3","V4","V5"\n'
        + "".join(f'"{n}",{line}\n' for n, line in enumerate(rows().splitlines(), 1)),
        Read(MAP),
    ),
    (
        "coordinates as labels",
        ",0,0.2,0.4,0.6,0.8\n"
        + "".join(f"{y},{line}\n" for y, line in zip(Y, rows().splitlines(), strict=True)),
        Refused("may be coordinates"),
    ),
    (
        "unnamed column of coordinates",
        f",{names}\n"
        + "".join(f"{y},{line}\n" for y, line in zip(Y, rows().splitlines(), strict=True)),
        Refused("no count of the lines"),
    ),
    ("columns numbered from 1", "1,2,3,4,5\n" + rows(), Refused("counts the columns")),
    ("comma at every line end", rows(end=","), Refused("every line ends with a separator")),
    ("comma at every line end and after the header", f"{names},\n" + rows(end=","), Read(MAP)),
    ("comma at every line end below the header", f"{names}\n" + rows(end=","), Read(MAP)),
    ("empty last column", rows("\t", values=last), Refused("every line ends with a separator")),
    ("empty last column with a name", f"{names}\n" + rows(values=last), Read(last)),
    ("nan in the last column", rows("\t", values=last).replace("\t\n", "\tnan\n"), Read(last)),
    ("TSV, last column partly empty", rows("\t", values=partly), Read(partly)),
    ("CSV, last column partly empty", rows(values=partly), Read(partly)),
    ("empty corner", rows(values=corner), Read(corner)),
    ("semicolons", rows(";"), Read(MAP)),
    ("spaces", rows("  "), Read(MAP)),
    ("spaces at both ends", "".join(f"  {line}  \n" for line in rows(" ").splitlines()), Read(MAP)),
    ("tabs and a header", names.replace(",", "\t") + "\n" + rows("\t"), Read(MAP)),
    (
        "quoted cells",
        "".join(
            ",".join(f'"{cell}"' for cell in line.split(",")) + "\n" for line in rows().splitlines()
        ),
        Read(MAP),
    ),
    ("byte-order mark and CR LF", "\ufeff" + rows().replace("\n", "\r\n"), Read(MAP)),
    (
        "comments",
        "# made by us, 2024\n% and MATLAB\n" + rows().replace("\n", " # row\n"),
        Read(MAP),
    ),
    ("a line of another white space", "\x1f\n" + rows(), Read(MAP)),
    ("blank lines", "\n" + rows().replace("\n", "\n\n"), Read(MAP)),
    (
        "missing words",
        "0.4,NA,0.42\nnan,0.44,N/A\n",
        Read(np.array([[0.4, np.nan, 0.42], [np.nan, 0.44, np.nan]])),
    ),
    ("decimal commas", rows(";").replace(".", ","), Refused("write decimal points")),
    ("decimal commas and commas", rows().replace(".", ","), Refused("decimal commas, between")),
    ("999 for missing", rows(values=np.where(HOLE, 999, MAP)), Refused("mark of missing")),
    ("-- for missing", rows().replace(f"{MAP[1, 1]:.17g}", "--"), Refused("'--' is no number")),
    ("short line", rows().replace(f",{MAP[2, 4]:.17g}", ""), Refused("line 3: 4 columns")),
    ("long line", rows().replace(f",{MAP[2, 4]:.17g}", ",0.4,0.4"), Refused("line 3: 6 columns")),
    ("header longer than the lines", f"{names},f\n" + rows(), Refused("header has 6 columns")),
    ("first line of coordinates", "0.05,0.15,0.25,0.35,0.45\n" + rows(), Refused("evenly spaced")),
    (
        "first column of coordinates",
        "".join(
            f"{0.05 + 0.1 * n:.2f},{line}\n"
            for n, line in enumerate(rows(values=np.tile(MAP, (2, 1))).splitlines())
        ),
        Refused("evenly spaced"),
    ),
    ("list of points with a header", "x_mm,y_mm,L1\n" + points, Refused("list of points")),
    ("list of points", points, Refused("list of points")),
    ("title", "thickness of the layer\n" + rows(), Refused("header has 1 columns|no number")),
    ("ESRI grid", "ncols 5\nnrows 4\n" + rows(" "), Refused("'ncols' is no number")),
    ("UTF-16", rows().encode("utf-16"), Read(MAP)),
    ("UTF-16 with tabs", rows("\t").encode("utf-16"), Read(MAP)),
    ("Excel's mark of the separator", "sep=;\r\n" + rows(";"), Read(MAP)),
    ("unit in a comment, in brackets", "# thickness [um]\n" + rows(values=1e3 * MAP), Read(MAP)),
    ("unit in a comment, in words", "% thickness in microns\n" + rows(values=1e3 * MAP), Read(MAP)),
    ("unit (z)", "# Unit (z): micrometer\n" + rows(values=1e3 * MAP), Read(MAP)),
    ("name of Octave", "# name: L1_um\n# rows: 4\n" + rows(" ", values=1e3 * MAP), Read(MAP)),
    *(
        (f"header of Octave, {said}", f"# name: L1\n# {said}\n" + rows(" "), answer)
        for said, answer in {
            "rows: 4": Read(MAP),
            "columns: 5": Read(MAP),
            "Columns: 5": Read(MAP),
            "rows: 5": Refused("rows: 5, but the table has 4"),
            "rows: 40": Refused("rows: 40, but the table has 4"),
            "columns: 4": Refused("columns: 4, but the table has 5"),
            "rows: y, columns: x": Read(MAP),
        }.items()
    ),
    (
        "header of a table with numbers of its rows",
        "# rows: 4\n# columns: 5\n,a,b,c,d,e\n"
        + "".join(f"{n},{line}\n" for n, line in enumerate(rows().splitlines())),
        Read(MAP),
    ),
    *(
        (f"unit that is none of a thickness: {remark}", f"# {remark}\n" + rows(), Refused(unit))
        for remark, unit in {
            "thickness [px]": "'px'; known units",
            "thickness in pixels": "'pixels'; known",
            "thickness (pixel)": "'pixel'; known",
            "thickness (voxels)": "'voxels'; known",
            "thickness in inches": "'inches'; known",
            "L1 [inch]": "'inch'; known",
            "depth in mil": "'mil'; known",
            "thickness (mils)": "'mils'; known",
            "thickness [Å]": "'Å'; known",
            "imprint in px": "states px, perhaps for the positions only",
        }.items()
    ),
    *(
        (f"unit of something else: {remark}", f"# {remark}\n" + rows(), Read(MAP))
        for remark in (
            "position in pixels",
            "size in pixels: 5 x 4",
            "every 3 pixels in B-scan 7",
            "field of view (px) 500 x 400",
            "1 inch objective",
            "resolution in px",
            "thickness in mm, x in px",
        )
    ),
    ("latin-1 unit", ("# thickness [µm]\n" + rows()).encode("latin-1"), Refused("or write um")),
    ("units of each axis", "# x unit: um\n# z unit: mm\n" + rows(), Read(MAP)),
    ("unit of the pixels", "# pixel size [um]: 20\n" + rows(), Refused("for the positions only")),
    ("no number of Excel", rows(values=HOLED).replace(",,", ",#N/A,"), Refused("'#N/A' is no num")),
    ("percent", rows(end="%").replace(",", "%,"), Refused("%' is no number")),
    ("separator before every line", rows().replace("\n", "\n,"), Refused("columns")),
    (
        "empty first column",
        "".join(f",{line}\n" for line in rows().splitlines()),
        Refused("every line begins with a separator"),
    ),
    (
        "numbers of columns and rows",
        "0,1,2,3,4,5\n" + "".join(f"{n},{r}\n" for n, r in enumerate(rows().splitlines(), 1)),
        Refused("first column counts the lines"),
    ),
    ("uneven positions in the first line", "1,2.1,3.3,4.2,5\n" + rows(), Refused("far beyond")),
    (
        "positions as gnuplot has them",
        "5,.1,.12,.13,.14,.16\n"
        + "".join(f"{y},{r}\n" for y, r in zip(Y, rows().splitlines(), strict=True)),
        Refused("far beyond all others"),
    ),
    ("255 for missing", rows(values=np.where(HOLE, 255, MAP)), Refused("255, far above")),
    ("latin-1", ("# µm\n" + rows()).encode("latin-1"), Refused("as text in UTF-8")),
    ("two numbers with units", "0.4 mm,0.5 mm\n0.4 mm,0.5 mm\n", Refused("no numbers|no number")),
):
    add(f"text {name}", text(content), answer)

# --- TIFF ---------------------------------------------------------------------------------------

LARGE = np.random.default_rng(7).uniform(0.4, 0.5, (40, 50)).astype("f4")


def tiff(values: np.ndarray, **options: Any) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        tifffile.imwrite(folder / "map.tif", values, **options)
        return folder / "map.tif"

    return make


for name, options in {
    "plain": {},
    "deflate": {"compression": "zlib"},
    "LZW": {"compression": "lzw"},
    "PackBits": {"compression": "packbits"},
    "Zstandard": {"compression": "zstd"},
    "deflate, predictor": {"compression": "zlib", "predictor": 3},
    "tiled": {"tile": (16, 16)},
    "tiled, deflate": {"tile": (16, 16), "compression": "zlib"},
    "strips": {"rowsperstrip": 7, "compression": "zlib"},
    "big-endian": {"byteorder": ">"},
    "BigTIFF": {"bigtiff": True},
}.items():
    add(f"tiff {name}", tiff(LARGE, **options), Read(LARGE.astype(float)))
add("tiff double, deflate", tiff(MAP, compression="zlib"), Read(MAP))
for orientation in range(2, 9):
    add(
        f"tiff orientation {orientation}",
        tiff(MAP, extratags=[(274, "H", 1, orientation)]),
        Refused(f"orientation tag says {orientation}"),
    )
add("tiff orientation 1", tiff(MAP, extratags=[(274, "H", 1, 1)]), Read(MAP))
for nodata, mark in (("-9999", -9999.0), ("999", 999.0), ("0", 0.0), ("nan", np.nan)):
    for compression in (None, "zlib"):
        add(
            f"tiff GDAL_NODATA {nodata}, {compression or 'plain'}",
            tiff(
                np.where(HOLE, mark, MAP),
                compression=compression,
                extratags=[(42113, "s", 0, nodata)],
            ),
            Read(HOLED),
        )
add(
    "tiff GDAL_NODATA that is no number",
    tiff(MAP, extratags=[(42113, "s", 0, "none")]),
    Refused("GDAL_NODATA"),
)
add(
    "tiff GDAL scale",
    tiff(
        MAP,
        extratags=[
            (
                42112,
                "s",
                0,
                '<GDALMetadata><Item name="SCALE" sample="0" role="scale">0.001</Item>'
                "</GDALMetadata>",
            )
        ],
    ),
    Refused("a scale of 0.001"),
)
add("tiff whole numbers", tiff((1000 * MAP).astype("u2")), Refused("uint16"))
add("tiff white is zero", tiff(MAP, photometric="miniswhite"), Refused("inverted grey"))
add("tiff colour", tiff(np.ones((4, 5, 3), "f4"), photometric="rgb"), Refused("colour|4 x 5 x 3"))
add("tiff two pages", tiff(np.stack([MAP, MAP])), Refused("2 x 4 x 5"))
IMAGEJ = {"imagej": True, "resolution": (1 / 20, 1 / 30), "metadata": {"unit": "um"}}
add(
    "tiff ImageJ's pixel size",
    tiff(MAP.astype("f4"), **IMAGEJ),
    Read(MAP.astype("f4").astype(float), 0.02 * np.arange(5), 0.03 * np.arange(4)),
    variable=None,
)
add(
    "tiff ImageJ's pixel size against the field of view",
    tiff(MAP.astype("f4"), **IMAGEJ),
    Refused("states a pixel spacing of 0.03"),
)

# --- others -------------------------------------------------------------------------------------


def zarr(
    dims: tuple[str, str] | None, values: np.ndarray = MAP, **attrs: Any
) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        import zarr

        stored = values.T if dims == ("x", "y") else values
        array = zarr.create_array(
            str(folder / "map.zarr"),
            shape=stored.shape,
            chunks=(2, 2),
            dtype="f8",
            dimension_names=dims,
        )
        array[:] = stored
        array.attrs.update(attrs)
        return folder / "map.zarr"

    return make


def nifti(folder: Path) -> Path:
    import nibabel

    image = nibabel.Nifti1Image(MAP.T, np.diag([20.0, 30.0, 1.0, 1.0]))
    image.header.set_xyzt_units("micron")
    nibabel.save(image, folder / "map.nii")
    return folder / "map.nii"


def raw(folder: Path) -> Path:
    (folder / "map.raw").write_bytes(MAP.astype("<f8").tobytes())
    (folder / "map.raw.toml").write_text('dtype = "float64"\nshape = [4, 5]\n')
    return folder / "map.raw"


add("zarr (y, x)", zarr(("y", "x")), Read(MAP))
add("zarr (x, y) is turned", zarr(("x", "y")), Read(MAP))
add("zarr unit that is no length", zarr(("y", "x"), units="kPa"), Refused("'kPa'"))
add("nifti is (x, y)", nifti, Read(MAP, 0.02 * np.arange(5), 0.03 * np.arange(4)), variable=None)
add("raw with a sidecar", raw, Read(MAP))
for fmt, write in NETCDF.items():
    parts = named("L1", (1000 * MAP).astype("i4"), units="um")
    add(f"{fmt} whole numbers", stored(write, parts), Refused("whole numbers"))
    parts = {"L0": (("y", "x"), MAP + 0.1, {}), "L1": (("y", "x"), MAP, {})}
    add(f"{fmt} two maps", stored(write, parts), Refused("more than one array"))
    add(f"{fmt} named map of two", stored(write, parts), Read(MAP), variable="L1", **FIELD)

# --- conventions of other programs --------------------------------------------------------------

for fmt, write in NETCDF.items():
    for pair in ("width height", "lon lat", "x_position y_position", "x1 y1", "xs ys"):
        dims = tuple(pair.split())
        add(f"{fmt} ({pair})", stored(write, named("L1", SQUARE.T, dims)), Read(SQUARE))
    add(
        f"{fmt} standard names of the axes",
        stored(
            write,
            {
                "L1": (("e", "n"), SQUARE.T, {}),
                "e": (("e",), X[:4], {"standard_name": "projection_x_coordinate"}),
                "n": (("n",), Y, {"standard_name": "projection_y_coordinate"}),
            },
        ),
        Read(SQUARE, X[:4], Y),
        variable="L1",
    )
    marks = np.where(HOLE, [-1.0, -2.0, -1.0, -2.0, -1.0], MAP)
    add(
        f"{fmt} several missing values",
        stored(write, named("L1", marks, missing_value=[-1.0, -2.0])),
        Read(HOLED),
    )


def coordinates_above(file: h5py.File) -> None:
    """As netCDF's groups have them: dimensions of the file, the map in a group."""
    for name, at in (("x", X), ("y", Y[::-1])):
        file[name] = at
        file[name].make_scale(name)
    file["scan/L1"] = MAP[::-1]
    for axis, name in enumerate("yx"):
        file["scan/L1"].dims[axis].attach_scale(file[name])


add("h5 coordinates above", hdf5(coordinates_above), Read(MAP, X, Y), variable="scan/L1")


def unit_of_group(file: h5py.File) -> None:
    file["scan/L1"] = 1e3 * MAP
    file["scan"].attrs["units"] = "um"


def unit_beside(where: str, text: Any) -> Callable[[h5py.File], None]:
    def build(file: h5py.File) -> None:
        file[f"{where}L1"] = 1e3 * MAP
        file[f"{where}units"] = text

    return build


add("h5 unit of the group", hdf5(unit_of_group), Read(MAP))
add("h5 text units beside", hdf5(unit_beside("", "um")), Read(MAP))
add("h5 text units beside in a group", hdf5(unit_beside("scan/", "um")), Read(MAP))
add("h5 units that are a number", hdf5(unit_beside("", 1e-3)), Refused("units may state the unit"))
for key, said in (("unit_symbol", "um"), ("unit_name", "micrometer"), ("unitSI", 1e-6)):
    parts = named("L1", 1e3 * MAP, **{key: said})
    add(f"h5labels {key} = {said}", stored(hdf5_labels, parts), Read(MAP))
parts = named("L1", MAP, unitSI=0.0254)
add("h5labels unitSI of inches", stored(hdf5_labels, parts), Refused("no unit of length in m"))


def with_links(file: h5py.File) -> None:
    file["scan/L1"] = MAP
    file["L1"], file["group"] = h5py.SoftLink("/scan/L1"), h5py.ExternalLink("b.h5", "/")


def with_a_time(file: h5py.File) -> None:
    file["L1"] = MAP
    space = h5py.h5s.create(h5py.h5s.SCALAR)
    h5py.h5d.create(file.id, b"acquired", h5py.h5t.UNIX_D32LE, space)


def with_an_unknown_filter(file: h5py.File) -> None:
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_chunk(MAP.shape)
    plist.set_filter(32019, h5py.h5z.FLAG_OPTIONAL)
    space = h5py.h5s.create_simple(MAP.shape)
    dataset = h5py.h5d.create(file.id, b"L1", h5py.h5t.IEEE_F64LE, space, plist)
    dataset.write_direct_chunk((0, 0), MAP.tobytes())


link = Refused("L1 is a link to /scan/L1; name the array by that")
add("h5 link", hdf5(with_links), link, variable="L1", **FIELD)
for name in ("group", "group/L1"):
    link = Refused("link into another file, b.h5")
    add(f"h5 link into another file, {name}", hdf5(with_links), link, variable=name, **FIELD)
add("h5 a time beside", hdf5(with_a_time), Read(MAP))
add("h5 unknown filter", hdf5(with_an_unknown_filter), Refused("installed: 32019 .*h5repack"))


def labelled_without_mask(file: h5py.File) -> None:
    file["L1"], file["filled"] = SQUARE.T, HOLE[:, :4].T.astype(float)
    for axis, name in enumerate("xy"):
        file["L1"].dims[axis].label = name


add(
    "h5 mask without labels lies as the map",
    hdf5(labelled_without_mask),
    Read(np.where(HOLE[:, :4], np.nan, SQUARE)),
)


def with_axes(file: h5py.File) -> None:
    file["L1"] = SQUARE.T
    file["L1"].attrs.update(axes="xy", spacing_mm=[0.02, 0.03])


def against_axes(file: h5py.File) -> None:
    with_axes(file)
    file["L1"].dims[0].label = "y"


FRAME = 0.02 * np.arange(4), 0.03 * np.arange(4)
for said in ("x,y", "x y", "x:y", "[x, y]", "XY", ["x", "y"], ["x_um", "y_um"], "column row"):
    parts = {"L1": ((), SQUARE.T, {}), "axes": ((), said, {})}
    add(f"npz axes = {said}", stored(npz, parts), Read(SQUARE))
    parts = named("L1", SQUARE.T, ("", ""), axes=said)
    add(f"h5labels axes = {said}", stored(hdf5_labels, parts), Read(SQUARE))
    add(f"zarr axes = {said}", zarr(None, SQUARE.T, axes=said), Read(SQUARE))
for said in ("zx", "zyx", "ab", "x", ["time", "x"], "yx,t"):
    parts = {"L1": ((), SQUARE.T, {}), "axes": ((), said, {})}
    add(f"npz axes = {said}", stored(npz, parts), Refused("no order of y and x such as 'yx'"))
for fmt, write in (("mat5", matlab5), ("npz", npz)):
    for name in ("axes", "scale"):
        parts = {"L1": ((), MAP, {}), name: ((), 0.5, {})}
        add(f"{fmt} {name} that is a number", stored(write, parts), Refused("another name"))


def of_nexus(file: h5py.File, axes: Any, **attrs: Any) -> None:
    file["scan/L1"], file["scan/x"], file["scan/y"] = SQUARE.T, X[:4], Y
    file["scan"].attrs.update(NX_class="NXdata", signal="L1", axes=axes)
    file["scan/L1"].attrs.update(attrs)


nexus = {"variable": "scan/L1"}
add("h5 NeXus", hdf5(lambda f: of_nexus(f, ["x", "y"])), Read(SQUARE, X[:4], Y), **nexus)
add("h5 NeXus, one text", hdf5(lambda f: of_nexus(f, "x:y")), Read(SQUARE, X[:4], Y), **nexus)
add(
    "h5 NeXus against labels",
    hdf5(lambda f: of_nexus(f, ["x", "y"], DIMENSION_LABELS=["y", "x"])),
    Refused(r"said to be \(x, y\), but its dimensions are \(y, x\)"),
)
for dims in (["x", "y"], ["y", "x"]):
    turned = SQUARE.T if dims[0] == "x" else SQUARE
    parts = named("L1", turned, ("", ""), _ARRAY_DIMENSIONS=dims)
    add(f"h5labels dimensions of xarray {dims}", stored(hdf5_labels, parts), Read(SQUARE))
add("h5 axes by an attribute", hdf5(with_axes), Read(SQUARE, *FRAME), variable=None)
add("h5 axes against labels", hdf5(against_axes), Refused("axes are said to be xy"))


def of_octave(file: h5py.File) -> None:
    file["L1/value"] = SQUARE.T
    file["L1"].attrs["OCTAVE_NEW_FORMAT"] = np.uint8(1)


def of_matlab(file: h5py.File) -> None:
    file["L1"] = SQUARE.T
    file["L1"].attrs["MATLAB_class"] = np.bytes_("double")


add("h5 of Octave", hdf5(of_octave), Read(SQUARE), variable="L1", **FIELD)
add("h5 of MATLAB without its head", hdf5(of_matlab), Read(SQUARE))
for mask in ("L1_mask", "nanMask", "is_filled", "interpolated", "outliers", "qc", "status"):
    parts = {"L1": ((), MAP, {}), mask: ((), HOLE.astype("u1"), {})}
    add(f"npz mask {mask}", stored(npz, parts), Refused("does not say what it marks"))
parts = {"L1": ((), MAP, {}), "anything": ((), HOLE, {})}
add("npz flags of any name", stored(npz, parts), Refused("does not say what it marks"))
parts = {
    "initial_thickness": ((), MAP, {}),
    "initial_filled": ((), HOLE, {}),
    "filled": ((), ~HOLE, {}),
}
add("npz mask of the initial thickness", stored(npz, parts), Read(HOLED))
parts = {"L1": ((), 1e3 * MAP, {}), "units": ((), ["um", "mm"], {})}
add("npz two units", stored(npz, parts), Refused("units may state the unit"))
for name in ("L1um", "thicknessUm", "L1 [um]"):
    add(f"npz {name}", stored(npz, {name: ((), 1e3 * MAP, {})}), Read(MAP))
parts = {"L1": ((), SQUARE.T, {}), "axes": ((), "xy", {}), "spacing_mm": ((), [0.02, 0.03], {})}
for fmt, write in (("mat5", matlab5), ("npz", npz)):
    add(f"{fmt} axes = xy", stored(write, parts), Read(SQUARE, *FRAME), variable=None)
cell = np.empty((1, 1), object)
cell[0, 0] = "um"
for what, value in (("cell", cell), ("struct", {"L1": "um"}), ("number", 1e-3)):
    parts = {"L1": ((), 1e3 * MAP, {}), "units": ((), value, {})}
    add(f"mat5 units in a {what}", stored(matlab5, parts), Refused("units may state the unit"))
parts = {"L1": ((), MAP, {}), "filled": ((), scipy.sparse.csc_matrix(HOLE.astype(float)), {})}
add("mat5 sparse mask", stored(matlab5, parts), Refused("it is no array of numbers"))
parts = {"s/L1": ((), 1e3 * MAP, {}), "s/units": ((), "um", {})}
add("mat73 unit in the structure", stored(matlab73, parts), Read(MAP))


def of_xarray(version: int, values: np.ndarray, **encoding: Any) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        maps = xr.Dataset({"L1": (("x", "y"), values.T)}, {"x": X, "y": Y[::-1]})
        maps.to_zarr(
            folder / "map.zarr",
            zarr_format=version,  # type: ignore[arg-type]
            encoding={"L1": encoding},
            consolidated=False,
        )
        return folder / "map.zarr"

    return make


def zarr_unit_of_group(folder: Path) -> Path:
    import zarr

    group = zarr.open_group(str(folder / "map.zarr"), mode="w")
    array = group.create_array("L1", shape=MAP.shape, dtype="f8")
    array[:] = 1e3 * MAP
    group.attrs["units"] = "um"
    return folder / "map.zarr"


for version in (2, 3):
    for what, encoding in {
        "NaN": {},
        "a fill value": {"_FillValue": 0.77},
        "packed values": {"dtype": "i2", "_FillValue": 32767, **PACKED},
    }.items():
        add(
            f"zarr {version} of xarray with {what}",
            of_xarray(version, HOLED, **encoding),
            Read(np.round(HOLED, 4)[::-1], X, Y),
            variable="L1",
        )


def zarr_without_a_chunk(fill: float | None) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = zarr(None)(folder)
        import zarr as library

        array = library.create_array(
            str(path), data=MAP, chunks=(2, 2), zarr_format=2, fill_value=fill, overwrite=True
        )
        assert array.fill_value == fill
        (path / "1.1").unlink()
        return path

    return make


without_fill = zarr_without_a_chunk(None)
add("zarr without a chunk and a fill value", without_fill, Refused("lacks 1 of 6 chunks"))
holed_chunk = MAP.copy()
holed_chunk[2:, 2:4] = np.nan
for fill in (0.0, 0.5):
    add(f"zarr without a chunk, to be {fill}", zarr_without_a_chunk(fill), Read(holed_chunk))
add("zarr unit of the group", zarr_unit_of_group, Read(MAP))

rng = np.random.default_rng(3)
grid = np.stack([*np.meshgrid(X + 0.1, np.linspace(1, 2, 12)), 0.4 + rng.random((12, 5))], -1)
listed = grid.reshape(-1, 3)
for what, table in {
    "with holes": listed[rng.random(60) > 0.1],
    "in any order": rng.permutation(listed),
    "thickness first": listed[:, [2, 0, 1]],
    "with their quality": np.c_[listed, rng.random(60) + 0.1],
    "scattered": rng.random((60, 3)) + 0.1,
    "of a profile": np.c_[0.1 + 0.01 * np.arange(60), 0.4 + rng.random(60)],
}.items():
    add(f"text points {what}", text(rows(values=table)), Refused("list of points or a profile"))
octave = "# name: L0\n# rows: 4\n{}\n\n# name: L1\n# rows: 4\n{}".format(rows(" "), rows(" "))
um = 1e3 * MAP
for what, content, answer in (
    ("of Octave, two arrays", octave, Refused("2 tables")),
    ("of Octave", octave[: octave.index("\n\n")], Read(MAP)),
    ("in slices", "# New slice\n".join([rows(), rows(), ""]), Refused("2 tables")),
    ("in two parts", rows() + "\n\n" + rows(), Refused("2 tables")),
    ("um by a comment", "# units: um\n" + rows(values=um), Read(MAP)),
    ("unknown unit by a comment", "# unit = px\n" + rows(values=um), Refused("'px'; known units")),
    ("um by names", "a_um,b_um,c_um,d_um,e_um\n" + rows(values=um), Read(MAP)),
    ("um by a header", ",".join(5 * ["um"]) + "\n" + rows(values=um), Read(MAP)),
    ("two units", "# unit: um\na_mm,b,c,d,e\n" + rows(), Refused("several units: mm, um")),
    (
        "coordinates in mm as names",
        ",".join(f"{x + 0.1:g} mm" for x in X) + "\n" + rows(),
        Read(MAP),
    ),
    (
        "decimal commas of um between commas",
        "".join(",".join(f"{v:.1f}".replace(".", ",") for v in row) + "\n" for row in um + 0.1),
        Refused("decimal commas"),
    ),
):
    add(f"text {what}", text(content), answer)

CALIBRATED = {"cf": 0, "c0": 0.1, "c1": 0.5}
for what, meta, answer in (
    ("calibration", CALIBRATED, Read(0.1 + 0.5 * MAP)),
    ("calibration in um", {"cf": 0, "c0": 0.0, "c1": 1e3, "vunit": "um"}, Read(MAP)),
    ("no calibration", {"cf": 20}, Read(MAP)),
    ("a curved calibration", {"cf": 1, "c0": 0.1, "c1": 0.5, "c2": 1.0}, Refused("function 1")),
):
    given = {"unit": "pixel", **meta}
    values = MAP.astype("f4")
    add(f"tiff {what} of ImageJ", tiff(values, imagej=True, metadata=given), answer)


def gdal(*items: tuple[str, str]) -> dict[str, Any]:
    """GDAL's metadata, by role, as a tag."""
    text = "".join(
        f'<Item name="{role.upper()}" sample="0" role="{role}">{text}</Item>'
        for role, text in items
    )
    return {"extratags": [(42112, "s", 0, f"<GDALMetadata>{text}</GDALMetadata>")]}


for what, options, answer in (
    ("GDAL unit um", gdal(("unittype", "um")), Read(MAP)),
    ("GDAL unit that is no length", gdal(("unittype", "kPa")), Refused("'kPa'")),
    ("GDAL description", gdal(("description", "thickness (um)")), Read(MAP)),
    ("GDAL scale 1", gdal(("scale", "1"), ("offset", "0"), ("unittype", "um")), Read(MAP)),
    ("GDAL offset", gdal(("scale", "1"), ("offset", "5")), Refused("offset of 5")),
    (
        "GDAL units that contradict each other",
        gdal(("unittype", "m"), ("description", "thickness (um)")),
        Refused("contradicting units"),
    ),
    ("a description", {"description": "thickness in um"}, Read(MAP)),
    ("a description of lines", {"description": "map 3\nunit: um\nfov: 3 mm"}, Read(MAP)),
    ("a long description", {"description": "Thickness map in um of sample 3"}, Read(MAP)),
    ("a description of an entry", {"description": "Thickness: um"}, Read(MAP)),
    (
        "a description of pixels",
        {"description": "pixel size in um"},
        Refused("'pixel size in um' states um, perhaps .* give length_unit"),
    ),
    ("a description of a pixel", {"description": "map\nunit = px"}, Refused("'px'")),
    (
        "a description of two units",
        {"description": "thickness in um\nthickness in mm"},
        Refused("um'; known units|mm'; known units"),
    ),
    ("a description of positions", {"description": "thickness in um\npositions in mm"}, Read(MAP)),
):
    add(f"tiff {what}", tiff(1e3 * MAP, metadata=None, **options), answer)
metres = tiff(MAP / 1e3, metadata=None, **gdal(("unittype", "metre")))
add("tiff GDAL unit m", metres, Read(MAP))
add("tiff a description beside tifffile's", tiff(1e3 * MAP, description="unit: um"), Read(MAP))
add("tiff unit by tifffile", tiff(1e3 * MAP, metadata={"unit": "um"}), Read(MAP))
add("tiff long description", tiff(MAP, metadata=None, description="held by\na clamp"), Read(MAP))


def tiff_of_pages(*pages: tuple[np.ndarray, dict[str, Any]]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        with tifffile.TiffWriter(folder / "map.tif") as file:
            for values, options in pages:
                file.write(values, photometric="minisblack", metadata=None, **options)
        return folder / "map.tif"

    return make


smaller = (LARGE[::2, ::2], {"subfiletype": 1})
add("tiff overview", tiff_of_pages((LARGE, {}), smaller), Read(LARGE.astype(float)))
add(
    "tiff pages of two kinds",
    tiff_of_pages((MAP, {}), (MAP, {"compression": "zlib"})),
    Refused(r"a page of 4 x 5 float64 \(none\); a page of 4 x 5 float64 \(adobe_deflate\)"),
)
add("tiff axes by tifffile", tiff(SQUARE.T, metadata={"axes": "XY"}), Read(SQUARE))


def nifti_turned(folder: Path) -> Path:
    import nibabel

    turned = np.diag([0.02, 0.03, 1.0, 1.0])[[1, 0, 2, 3]]
    nibabel.save(nibabel.Nifti1Image(SQUARE, turned), folder / "map.nii")
    return folder / "map.nii"


def nifti_of_two_sizes(folder: Path) -> Path:
    path = nifti(folder)
    content = bytearray(path.read_bytes())
    content[80:88] = np.ones(2, "<f4").tobytes()  # pixdim
    path.write_bytes(content)
    return path


def nifti_of_one_layer(signs: tuple[int, int, int], order: list[int]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        import nibabel

        transform = np.diag([0.02, 0.03, 1.0, 1.0]) * [*signs, 1]
        image = nibabel.Nifti1Image(MAP.T[:, :, None], transform[[*order, 3]])
        image.header.set_xyzt_units("mm")
        nibabel.save(image, folder / "map.nii.gz")
        return folder / "map.nii.gz"

    return make


layer = Read(MAP, 0.02 * np.arange(5), 0.03 * np.arange(4))
for signs in ((1, 1, 1), (1, 1, -1), (-1, 1, -1), (-1, -1, 1)):
    upright = nifti_of_one_layer(signs, [0, 1, 2])
    add(f"nifti of one layer, mirrored {signs}", upright, layer, variable=None)
for turn, says in (([1, 0, 2], "x and y"), ([2, 1, 0], "x and z"), ([1, 2, 0], "x and y and z")):
    swapped = nifti_of_one_layer((1, 1, 1), turn)
    add(
        f"nifti of one layer, turned {turn}",
        swapped,
        Refused(f"swaps {says}; save it"),
        variable=None,
    )
for shape in ((1, 4, 5), (1, 1, 4, 5)):
    values = MAP.reshape(shape)
    add(f"tiff {shape}", tiff(values, photometric="minisblack"), Read(MAP))
    packed = tiff(values, photometric="minisblack", compression="zlib")
    add(f"tiff {shape}, packed", packed, Read(MAP))
for compression in (None, "zlib"):
    options = {"photometric": "minisblack", "compression": compression}
    add(f"tiff last axis of one, {compression}", tiff(MAP[..., None], **options), Read(MAP))
for options in ({}, {"variable": "map"}, {"variable": "map.L1"}):
    add(
        f"mat5 structure {options}",
        stored(lambda path, _: scipy.io.savemat(path, {"map": {"L1": MAP}}), {}),
        Refused(r"Not read: map \(a structure"),
        **FIELD | options,
    )
add("nifti turned by its transform", nifti_turned, Refused("swaps x and y"))
add("nifti of two pixel sizes", nifti_of_two_sizes, Refused("header says voxels of"))


def dicom_of_floats(folder: Path, values: np.ndarray = MAP, **elements: float) -> Path:
    from pydicom.dataset import FileDataset, FileMetaDataset

    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.30"
    meta.MediaStorageSOPInstanceUID = "1.2.3"
    meta.TransferSyntaxUID = "1.2.840.10008.1.2.1"
    image = FileDataset(None, {}, file_meta=meta, preamble=b"\0" * 128)
    image.Rows, image.Columns = MAP.shape
    image.SamplesPerPixel, image.PhotometricInterpretation = 1, "MONOCHROME2"
    image.BitsAllocated, image.PixelSpacing = 32, [0.03, 0.02]
    image.FloatPixelData = values.astype("<f4").tobytes()
    for element, value in elements.items():
        setattr(image, element, value)
    image.save_as(folder / "map.dcm", enforce_file_format=True)
    return folder / "map.dcm"


add(
    "dicom of floats",
    dicom_of_floats,
    Read(MAP, 0.02 * np.arange(5), 0.03 * np.arange(4)),
    variable=None,
)


def dicom_padded(folder: Path) -> Path:
    padded = np.where(HOLE, 99.5, MAP)
    return dicom_of_floats(folder, padded, FloatPixelPaddingValue=99.5)


def dicom_padded_by_a_range(folder: Path) -> Path:
    padded = np.where(HOLE, MAP - 9, MAP)
    limits = {"FloatPixelPaddingValue": -9.0, "FloatPixelPaddingRangeLimit": -8.0}
    return dicom_of_floats(folder, padded, **limits)


def dicom_padded_by_nan(folder: Path) -> Path:
    return dicom_of_floats(folder, HOLED, FloatPixelPaddingValue=np.nan)


for write in (dicom_padded, dicom_padded_by_a_range, dicom_padded_by_nan):
    answer = Read(HOLED, 0.02 * np.arange(5), 0.03 * np.arange(4))
    add(write.__name__.replace("_", " "), write, answer, variable=None)


def raw_turned(folder: Path) -> Path:
    (folder / "map.raw").write_bytes(SQUARE.T.astype(">f8").tobytes())
    (folder / "map.raw.json").write_text(
        '{"dtype": "float64", "shape": [4, 4], "byte_order": "big", "axes": "xy", '
        '"spacing_mm": [0.02, 0.03]}'
    )
    return folder / "map.raw"


def raw_of_two_sidecars(folder: Path) -> Path:
    (folder / "map.raw.toml").write_text('dtype = "float64"\nshape = [4, 4]\n')
    return raw_turned(folder)


def text_with_notes(folder: Path) -> Path:
    (folder / "map.csv.json").write_text('{"operator": "A", "unit": "mm", "notes": []}')
    return text(rows())(folder).rename(folder / "map.csv")


def raw_with_notes(folder: Path) -> Path:
    (folder / "map.raw.toml").write_text("operator = 'A'\n")
    return raw_turned(folder)


add("text with notes of another program", text_with_notes, Read(MAP))
add("raw with notes of another program", raw_with_notes, Read(SQUARE, *FRAME), variable=None)
add("raw axes = xy", raw_turned, Read(SQUARE, *FRAME), variable=None)
add("raw two sidecars", raw_of_two_sidecars, Refused("has two sidecars"))


def matlab_logical(folder: Path) -> Path:
    scipy.io.savemat(folder / "map.mat", {"L1": MAP, "anything": HOLE})
    return folder / "map.mat"


def element(kind: int, data: bytes) -> bytes:
    """Make an element of MATLAB v5 files."""
    if len(data) <= 4:
        return struct.pack("<HH", kind, len(data)) + data.ljust(4, b"\0")
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def matlab_object(name: str, *, compressed: bool = False) -> Callable[[Path], Path]:
    """A map, and a ``string`` as MATLAB saves it: with a name, but without dimensions."""
    flags = [element(6, struct.pack("<II", kind, 0)) for kind in (17, 13, 9)]
    inner = flags[1] + element(5, struct.pack("<2i", 6, 1)) + element(1, b"")
    inner = element(14, inner + element(6, struct.pack("<6I", 0xDD000000, 2, 1, 1, 1, 1)))
    said = element(1, name.encode()) + element(1, b"MCOS") + element(1, b"string")
    kept = element(5, struct.pack("<2i", 1, 64)) + element(1, b"") + element(2, bytes(64))
    parts = [element(14, flags[0] + said + inner), element(14, flags[2] + kept)]
    if compressed:
        packed = [zlib.compress(part) for part in parts]
        parts = [struct.pack("<II", 15, len(part)) + part for part in packed]

    def make(folder: Path) -> Path:
        scipy.io.savemat(folder / "map.mat", {"L1": MAP})
        with (folder / "map.mat").open("ab") as file:
            file.write(b"".join(parts))
        return folder / "map.mat"

    return make


for name in ("note", "notes", "time", "unit", "units", "axes"):
    says = Read(MAP) if name[0] in "nt" else Refused(f"{name} (may state|should describe)")
    add(f"mat5 string {name}", matlab_object(name), says)
    add(f"mat5 compressed string {name}", matlab_object(name, compressed=True), says)
add("mat5 flags of any name", matlab_logical, Refused("does not say what it marks"))
parts = {"L1": ((), MAP, {}), "confidence": ((), HOLE.astype("i4"), {})}
add("npz zeros and ones of any name", stored(npz, parts), Refused("does not say what it marks"))
for name in ("L1_px", "thickness (pixels)", "stress_kPa", "L1_inch"):
    add(f"npz {name}", stored(npz, named(name, MAP)), Refused("name ends with"))
add("npz ThicknessMicrons", stored(npz, named("ThicknessMicrons", 1e3 * MAP)), Read(MAP))
for fmt, write in NETCDF.items():
    parts = named("L1", MAP, ancillary_variables="anything")
    flags: Parts = {"anything": (("y", "x"), 2 * HOLE.astype("i4"), {})}
    add(f"{fmt} ancillary variable", stored(write, parts | flags), Refused("looks like a mask"))
    flags = {"Q": (("y", "x"), 2 * HOLE.astype("i4"), {"flag_meanings": "good bad"})}
    add(f"{fmt} flags good and bad", stored(write, named("L1", MAP) | flags), Refused("a mask"))
    flags = {"Q": (("y", "x"), HOLE.astype("i4"), {"flag_meanings": "open slip"})}
    add(f"{fmt} flags of something else", stored(write, named("L1", MAP) | flags), Read(MAP))
    for key, text_ in (("long_name", "thickness (um)"), ("description", "depth in micrometers")):
        parts = named("L1", 1e3 * MAP, **{key: text_})
        add(f"{fmt} unit in the {key}", stored(write, parts), Read(MAP))
    parts = named("L1", 1e3 * MAP, unit_of_length="um", long_name="under a travel of 2 mm")
    add(f"{fmt} attribute unit_of_length", stored(write, parts), Read(MAP))
    parts = named("L1", MAP, scale_factor="0.001")
    add(f"{fmt} scale_factor that is a text", stored(write, parts), Refused("scale_factor is"))
    counted: Parts = {
        axis: ((axis,), 1.0 + np.arange(n), {}) for axis, n in zip("yx", (4, 5), strict=True)
    }
    parts = named("L1", MAP) | counted
    add(f"{fmt} numbers of pixels", stored(write, parts), Refused("in mm"), variable="L1")
    add(f"{fmt} numbers of pixels, given", stored(write, parts), Read(MAP), variable="L1", **FIELD)
    for what, change, attrs in (
        ("of a part", lambda at: 4.0 + at, {}),
        ("falling", lambda at: 20.0 - at, {}),
        ("of averages", lambda at: 2.0 * at - 1.5, {}),
        ("that are whole", lambda at: (20 * at).astype("i4"), {}),
        ("in pixels", lambda at: 0.5 * at, {"units": "pixel"}),
        ("of unit 1", lambda at: 0.5 * at, {"units": "1"}),
    ):
        numbers: Parts = {a: (d, change(at), attrs) for a, (d, at, _) in counted.items()}
        write_, says = stored(write, parts | numbers), Refused("say the unit of the coordinates")
        add(f"{fmt} numbers of pixels {what}", write_, says, variable="L1")
        given = f"{fmt} numbers of pixels {what}, given"
        answer = Read(MAP[::-1, ::-1] if what == "falling" else MAP)
        add(given, write_, answer, variable="L1", **FIELD)
    in_mm = {axis: (dims, at, {"units": "mm"}) for axis, (dims, at, _) in counted.items()}
    whole = Read(MAP, 1.0 + np.arange(5), 1.0 + np.arange(4))
    add(f"{fmt} a pixel per mm", stored(write, parts | in_mm), whole, variable="L1")


def of_vigra(file: h5py.File) -> None:
    file["L1"] = SQUARE.T
    file["L1"].attrs["axistags"] = '{"axes": [{"key": "x"}, {"key": "y"}]}'


add("h5 tags of axes", hdf5(of_vigra), Read(SQUARE))
stress = tiff(MAP.astype("f4"), imagej=True, metadata={"unit": "mm", "vunit": "kPa"})
add("tiff ImageJ's values in kPa", stress, Refused("'kPa'"))
for name, content, says in (
    ("Excel", b"PK\x03\x04" + bytes(99), "zip"),
    ("gzip", b"\x1f\x8b" + bytes(99), "unpack"),
    ("pickle", b"\x80\x05" + bytes(99), "numpy.save"),
):
    add(f"not read: {name}", text(content), Refused(says))

errors = ("#N/A", "#DIV/0!", "#NV", "#REF!", "#VALUE!", "#NAME?", "#NULL!", "#NUM!", "#WERT!")
for error in errors:
    for sign, separator in {"commas": ",", "tabs": "\t", "semicolons": ";", "spaces": " "}.items():
        content = rows(separator).replace(f"{MAP[2, 0]:.17g}", error)
        add(
            f"text {error} begins a line, {sign}",
            text(content),
            Refused("line 3, column 1: " + re.escape(repr(error))),
        )
content = "".join(line.rsplit(" ", 1)[0] + " #N/A\n" for line in rows(" ").splitlines())
add("text #N/A in the last column, spaces", text(content), Refused("column 5: '#N/A'"))

marks = ("--", "-", "null", "NULL", "<NA>", "None", "*", "?", "missing", "1.#QNAN", "-nan(ind)")
for mark in (*marks, "#N/A", "L1"):
    first = ",".join(5 * [mark]) + "\n" + rows()
    add(f"text first line of {mark}", text(first), Refused("is no number. If .* missing pixels"))
add("text first line of marks", text(",".join(marks[:5]) + "\n" + rows()), Refused("no number"))

for sign, separator in {"commas": ",", "tabs": "\t", "semicolons": ";"}.items():
    for what, missing in {"first": [0], "second": [1], "third": [2], "last two": [2, 3]}.items():
        table = MAP.copy()
        table[missing] = np.nan
        inside = missing[0] in (1, 2) and len(missing) == 1
        answer = Read(table) if inside else Refused("line .: only separators. .* write nan")
        for above in ("", separator.join("abcde") + "\n"):
            name = f"text empty {what} row, {sign}{', header' if above else ''}"
            add(name, text(above + rows(separator, values=table)), answer)
    table[2:] = [[0.4, np.nan, np.nan, np.nan, 0.5], 5 * [np.nan]]
    written = rows(separator, values=table).replace(
        4 * separator + "\n", separator.join(5 * ["nan"])
    )
    add(f"text last row of nan, {sign}", text(written), Read(table))
for what, at in {"first": 0, "second": 1, "last": 4}.items():
    lines = rows(" ").splitlines()
    lines.insert(at, 4 * " ")
    says = Refused(f"line {at + 1}: only spaces. .* write nan")
    add(f"text empty {what} row, spaces", text("\n".join(lines) + "\n"), says)
add("text blank line of spaces", text(rows(" ") + "  \n"), Read(MAP))
add("text blank line of tabs, commas", text(rows() + "\t\n"), Read(MAP))
add("text comment after tabs", text("\t# so\n" + rows("\t") + "\t\t# so\n"), Read(MAP))
add("text trailing lines of Excel", text(rows() + 2 * ",,,,\n"), Refused("line 6: only separators"))
means = rows() + "\n" + rows(values=MAP.mean(0, keepdims=True))
add("text line of means", text(means), Refused("parts of 4, 1 lines"))
sparse = "".join(f"{r} {c} {MAP[r, c]}\n" for c in range(3) for r in range(4))
sparse = "# name: L1\n# type: sparse matrix\n# nnz: 12\n" + sparse
add("text of Octave, sparse", text(sparse), Refused("a sparse matrix of Octave"))

for comment, answer in {
    "centre wavelength in nm: 1300": MAP,
    "wavelength [nm]: 1300": MAP,
    "stage unit: nm": MAP,
    "x, y in um; thickness in mm": MAP,
    "lateral positions in um; axial values in mm": MAP,
    "unit x: um, unit z: mm": MAP,
    "units: x um, z mm": MAP,
    "units: x=um, y=um, z=mm": MAP,
    "indenter radius [um]: 500": MAP,
    "thickness under an indenter of radius 500 um": MAP,
    "pre-compression [um]: 50": MAP,
    "axial resolution (um): 5": MAP,
    "speed in um/s": MAP,
    "Height: 300 um": MAP,
    "x and y in mm, thickness in um": um,
    "field of view [mm]: 2 x 1, thickness [um]": um,
    "thickness at each pixel [um]": um,
    "thickness / um": um,
    "thickness, um": um,
    "units are um": um,
    "all lengths are in um": um,
    "x_um y_um L1_um": um,
    "um": um,
    "Value units: m": 1e-3 * MAP,
    "Werteinheiten: m": 1e-3 * MAP,
}.items():
    add(f"text comment {comment}", text(f"# {comment}\n" + rows(values=answer)), Read(MAP))
for comment in (
    "written in CM by Joe",
    "resolution of the map in um",
    "thickness [um]: 500",
    "x unit: um",
    "scale: 1e-3 mm per count",
    "1 count = 0.5 um",
):
    unclear = text(f"# {comment}\n" + rows())
    add(f"text comment {comment}", unclear, Refused("perhaps .* give length_unit"))
    add(f"text comment {comment}, given", unclear, Read(MAP), length_unit="mm", **FIELD)
for form, answer in {
    "x={} um": MAP,
    "{} um": MAP,
    "x = {} [um]": MAP,
    "x{}um": None,
    "x_um_{}": None,
    "col {} um": None,
}.items():
    content = ",".join(form.format(200 * n) for n in range(5)) + "\n" + rows()
    answer = Refused("perhaps .* give length_unit") if answer is None else Read(MAP)
    add(f"text header {form}", text(content), answer)
    add(f"text header {form}, given", text(content), Read(MAP), length_unit="mm", **FIELD)
for form in ("d/µm", "d / µm", "L1_um_{}", "L{}_um", "col{}_um", "column {} [um]", "um.{}", "[um]"):
    content = ",".join(form.format(1 + n) for n in range(5)) + "\n" + rows(values=um)
    add(f"text header {form}", text(content), Read(MAP))
for fmt, write in ATTRIBUTES.items():
    parts = named("L1", um, long_name="thickness/um")
    add(f"{fmt} unit behind a solidus", stored(write, parts), Read(MAP))
    parts = named("L1", MAP, long_name="thickness, coefficient 0.1/um, of um/mm")
    add(f"{fmt} reciprocal unit", stored(write, parts), Read(MAP))


def below_a_header(index: list[float], label: str, factor: float = 1.0) -> Callable[[Path], Path]:
    """Write as pandas does with a named index."""
    lines = rows(values=factor * np.tile(MAP, (2, 1))[: len(index)]).splitlines()
    head = f"{label},{names}\n"
    return text(head + "".join(f"{y:g},{r}\n" for y, r in zip(index, lines, strict=True)))


even = [100.0, 300, 500, 700, 900, 1100]
for label in ("y_um", "y_mm", "y", "position [mm]", "row", "time"):
    for what, index in {"even": even, "uneven": [100, 310, 500, 700, 900, 1100]}.items():
        written = below_a_header([*map(float, index)], label)
        add(f"text header, {what} {label}", written, Refused(f"{re.escape(label)}.*coordinates"))
add("text header, even column", below_a_header(even, "L"), Refused("evenly spaced"))
steady = below_a_header([100, 310, 500, 700, 900, 1100], "L")
add("text header, steady column", steady, Refused("far beyond all others"))
wedge = np.linspace(0.4, 0.5, 6)[:, None] * (1 + 0.1 * np.arange(4))
add("text header, a wedge", text("a,b,c,d\n" + rows(values=wedge)), Read(wedge))
add("text header of z", text("z1,z2,z3,z4,z5\n" + rows()), Read(MAP))
add(
    "text header, z in all columns",
    text(",".join(5 * ["z_um"]) + "\n" + rows(values=um)),
    Read(MAP),
)

digits = np.random.default_rng(9)
fine = np.floor(400 + 100 * digits.random((6, 6)))
for width in (1, 2, 3):
    decimals = fine + digits.integers(1, 10**width, fine.shape) / 10**width
    for what, values in {
        "um": [[f"{v:.{width}f}".replace(".", ",") for v in row] for row in decimals],
        "mm": [[f"1,{v:.0f}" for v in row] for row in fine],
    }.items():
        content = "".join(",".join(row) + "\n" for row in values)
        add(f"text {width} decimals, {what}", text(content), Refused("decimal commas"))
for what, values in {
    "at random": fine,
    "two columns": fine[:, :2],
    "apart, two columns": fine[:, :2] + [0, 200],
    "a slope": fine + 100 * np.arange(6),
    "one outlier": np.where(np.arange(36).reshape(6, 6) == 7, 790, fine),
}.items():
    options = {"length_unit": "um", **FIELD}
    add(f"text whole um, {what}", text(rows(values=values)), Read(1e-3 * values), **options)
for what, content in {
    "spaces": rows(" ").replace(".", ","),
    "spaces, aligned": rows("  ").replace(".", ","),
    "tabs": rows("\t").replace(".", ","),
}.items():
    add(f"text decimal commas, {what}", text(content), Refused("decimal points"))
quoted = "".join(",".join(f'"{v:.3f}"'.replace(".", ",") for v in row) + "\n" for row in MAP)
add("text decimal commas in quotes", text(quoted), Refused("line 1: write decimal points"))
half = rows(";", values=MAP[:1]).replace(".", ",") + rows(";", values=MAP[1:])
add("text decimal commas in the first line", text(half), Refused("line 1: write decimal points"))
