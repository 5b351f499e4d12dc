"""Regions of interest from files: ImageJ, napari, masks and tables of outlines."""

from __future__ import annotations

import io
import os
import zipfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from scipy.ndimage import find_objects

from optical_palpation.analysis.maps import check_map, pixel_size
from optical_palpation.analysis.regions import Region
from optical_palpation.analysis.tracing import traced
from optical_palpation.arguments import explained, file_path
from optical_palpation.errors import InputError
from optical_palpation.files import replacing
from optical_palpation.volume.contents import translated_errors
from optical_palpation.volume.opening import open_contents
from optical_palpation.volume.text import MAX_VALUES, Columns, read_columns

_ENDINGS = ".roi or .zip (ImageJ), .csv (napari, or name, x_mm, y_mm), .tif, .png or .npy (masks)"
_LARGEST = 50_000_000  # bytes; an outline is a thousandth of that
_MOST_REGIONS = 10_000
_MOST_GREYS = 4
_ORIENTATION = 274  # tag of TIFF and EXIF
#: Share of the map's pixels along both axes in which shapes that could be in mm seem to be.
_CORNER = 0.15
_NAPARI = ["index", "shape-type", "vertex-index", "axis-0", "axis-1"]


@explained
def read_regions(path: str | os.PathLike[str], like: xr.DataArray | xr.Dataset) -> list[Region]:
    """Read regions of interest from a file.

    Parameters
    ----------
    path
        One of

        - ``.roi`` or ``.zip``: what ImageJ's ROI manager saves. Rectangles, ovals, polygons and
          composites; drawn on an image of the pixels of `like`, whose first row is the lowest y,
          as :func:`~optical_palpation.present.write_tiff` writes it.
        - ``.csv`` of a napari shapes layer (``index, shape-type, vertex-index, axis-0, axis-1``),
          drawn over an image of these pixels.
        - ``.csv`` with the columns ``name``, ``x_mm`` and ``y_mm``: the vertices of outlines. A
          region of several, or with holes, numbers them in a column ``outline``.
        - ``.tif``, ``.png`` or ``.npy``: a mask or labels with the pixels of `like`, first row
          lowest y; every whole number above 0 is a region.
    like
        A map of the result, or all of them: tells where pixels lie.

    Returns
    -------
    list of Region
        In the order of the file.

    Raises
    ------
    InputError
        If the file cannot be read, holds no region, or does not fit to the maps.
    """
    path = file_path(path)
    if isinstance(like, xr.Dataset):
        like = next(v for v in like.data_vars.values() if set(v.dims) == {"y", "x"})
    field = check_map(like, "map")
    try:
        if path.stat().st_size > _LARGEST:
            raise InputError(f"{path}: is too large for a file of regions")
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    readers = {
        ".roi": _imagej,
        ".zip": _imagej,
        ".csv": _table,
        ".tif": _labels,
        ".tiff": _labels,
        ".png": _labels,
        ".npy": _labels,
    }
    if (reader := readers.get(path.suffix.lower())) is None:
        raise InputError(f"{path}: regions are read from {_ENDINGS}")
    try:
        regions = reader(path, content, field)
    except InputError as error:
        named = str(error).startswith(str(path))
        raise error if named else InputError(f"{path}: {error}") from None
    except Exception as error:  # whatever a library makes of damaged data
        raise InputError(f"{path}: is damaged, or no file of regions ({error})") from error
    if not regions:
        raise InputError(f"{path}: holds no region")
    return _numbered(regions)


def _imagej(path: Path, content: bytes, field: xr.DataArray) -> list[Region]:
    import roifile

    if path.suffix.lower() == ".zip":
        rois = []
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [m for m in archive.infolist() if m.filename.lower().endswith(".roi")]
            if len(members) > _MOST_REGIONS or sum(m.file_size for m in members) > _LARGEST:
                raise InputError(f"{path}: holds more than a file of regions can")
            for member in members:
                roi = roifile.ImagejRoi.frombytes(archive.read(member))
                roi.name = roi.name or Path(member.filename).stem
                rois.append(roi)
    else:
        rois = [roifile.ImagejRoi.frombytes(content)]
    areas = {"RECT", "OVAL", "POLYGON", "FREEHAND", "TRACED", "COMPOSITE"}
    regions = []
    for roi in rois:
        kind = "COMPOSITE" if roi.composite else roi.roitype.name
        name = roi.name or path.stem
        if kind not in areas:
            raise InputError(
                f"{path}: {name!r} is a {kind.lower()}, which has no area; save areas only"
            )
        if kind == "RECT" and roi.rounded_rect_arc_size:
            raise InputError(f"{path}: {name!r} has rounded corners; save it as a polygon")
        outlines = roi.coordinates(multi=True)
        if not isinstance(outlines, list):
            outlines = [outlines]
        # ImageJ counts from the corner of the first pixel
        placed = [_placed(np.asarray(o, float) - 0.5, field) for o in outlines if len(o) > 2]
        if not placed:
            raise InputError(f"{path}: {name!r} has no area")
        for outline in placed:
            Region.polygon(name, outline)  # refuses what is not finite
        regions.append(Region(name, tuple(placed)))
    return regions


def _placed(pixels: NDArray[np.float64], field: xr.DataArray) -> NDArray[np.float64]:
    """Positions in mm of points (column, row) that count from the centre of the first pixel."""
    dy, dx = pixel_size(field)
    origin = np.array([float(field["x"][0]), float(field["y"][0])])
    return origin + pixels * [dx, dy]


def _table(path: Path, content: bytes, field: xr.DataArray) -> list[Region]:
    table = read_columns(path)
    if table.names[:5] == _NAPARI:
        if len(table.names) > 5:
            raise InputError(f"{path}: shapes in more than two dimensions; draw them on a map")
        return _shapes(path, table, field)
    for column in ("name", "x_mm", "y_mm"):
        if column not in table.names:
            raise InputError(
                f"{path}: needs the columns name, x_mm, y_mm (vertices of outlines), or those of a "
                f"napari shapes layer; found {', '.join(table.names)}"
            )
    at = table.names.index("name")
    names = [row.cells[at] for row in table.rows]
    if "" in names:
        line = table.rows[names.index("")].number
        raise InputError(f"{path}, line {line}: has no name; every vertex names its outline")
    vertices = np.column_stack([table.numbers("x_mm"), table.numbers("y_mm")])
    outlines = table.numbers("outline") if "outline" in table.names else np.zeros(len(names))
    parts: dict[str, list[NDArray[np.float64]]] = {}
    for (name, _), own in pd.DataFrame(vertices).groupby([names, outlines], sort=False):
        parts.setdefault(name, []).append(Region.polygon(name, own.to_numpy()).outlines[0])
    return [Region(name, tuple(own)) for name, own in parts.items()]


def _shapes(path: Path, table: Columns, field: xr.DataArray) -> list[Region]:
    """Shapes of napari, in the order of their numbers."""
    shape, vertex, *corners = (table.numbers(_NAPARI[n]) for n in (0, 2, 4, 3))
    if _could_be_mm(corners, field):
        raise InputError(
            f"{path}: all shapes lie in the first pixels of the map and seem to be in mm, not in "
            "pixels; save regions that are drawn in the plugin by its Save regions, or give "
            "vertices in mm as a table of name, x_mm, y_mm"
        )
    at = table.names.index("shape-type")
    regions = []
    for number in np.unique(shape):
        rows = np.flatnonzero(shape == number)
        rows = rows[np.argsort(vertex[rows])]
        kind = table.rows[rows[0]].cells[at]
        if kind in ("line", "path"):
            raise InputError(f"{path}: shape {number:g} is a {kind}, which has no area")
        if kind not in ("polygon", "rectangle", "ellipse"):
            raise InputError(f"{path}: shape {number:g} is a {kind!r}, which is not known")
        placed = _placed(np.column_stack(corners)[rows], field)
        make = Region.ellipse_in_box if kind == "ellipse" else Region.polygon
        regions.append(make(f"{kind} {number:g}", placed))
    return regions


def _could_be_mm(corners: list[NDArray[np.float64]], field: xr.DataArray) -> bool:
    """Whether coordinates (x, y) lie in a corner of the map's pixels, and within the map in mm."""
    return all(
        values.max() < _CORNER * field.sizes[axis]
        and values.min() >= float(field[axis].min())
        and values.max() <= float(field[axis].max())
        for axis, values in zip("xy", corners, strict=True)
    )


def _labels(path: Path, content: bytes, field: xr.DataArray) -> list[Region]:
    labels = _picture(path, content) if path.suffix.lower() == ".png" else _array(path)
    if labels.ndim == 3 and labels.shape[-1] in (3, 4):
        raise InputError(f"{path}: is a colour picture; save a mask or labels, one number a pixel")
    if labels.shape != field.shape or labels.dtype.kind not in "bui":
        raise InputError(
            f"{path}: a mask has whole numbers on the pixels of the map, "
            f"{field.shape[0]} x {field.shape[1]}; found {labels.dtype}, "
            f"{' x '.join(map(str, labels.shape))}"
        )
    values, ranks = np.unique(labels, return_inverse=True)
    found = [number for number in values if number > 0]
    if len(found) > _MOST_REGIONS:
        raise InputError(f"{path}: {len(found)} different numbers are no labels of regions")
    if labels.dtype == np.uint8 and 255 in found and len(found) > _MOST_GREYS:
        raise InputError(
            f"{path}: {len(found)} greys up to 255 are no labels: a mask was smoothed, or "
            "compressed with losses; save it with two values"
        )
    mask = xr.DataArray(labels, {"y": field["y"], "x": field["x"]}, ("y", "x"))
    one = path.stem if len(found) == 1 else None
    regions = []
    for number, place in zip(values, find_objects(1 + ranks.reshape(labels.shape)), strict=True):
        if number > 0:  # its own part of the map: thousands of whole ones would fill the memory
            part = mask[tuple(slice(max(at.start - 1, 0), at.stop + 1) for at in place)]
            regions.append(Region.of_mask(one or f"label {number}", part == number))
    return regions


def _array(path: Path) -> NDArray[Any]:
    """The only array of a TIFF or NumPy file, which lies as it seems to."""
    reader, contents = open_contents(path)
    with contents, translated_errors(path, reader.FORMAT):
        (variable,) = contents.variables.values()
        array = variable.open()
        if np.prod(array.shape) > MAX_VALUES:
            raise InputError(f"{path}: has more pixels than a map, {array.shape}")
        return np.asarray(array[(slice(None),) * len(array.shape)])


def _picture(path: Path, content: bytes) -> NDArray[Any]:
    from PIL import Image

    with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
        if (orientation := image.getexif().get(_ORIENTATION, 1)) != 1:
            raise InputError(f"{path}: its orientation tag says {orientation}; save it upright")
        return np.asarray(image)


def _numbered(regions: Sequence[Region]) -> list[Region]:
    """Give regions of the same name a number."""
    names = [region.name for region in regions]
    often, counts = Counter(names), dict[str, int]()
    result = []
    for region in regions:
        name = region.name
        if often[name] > 1:
            counts[name] = counts.get(name, 0) + 1
            name = f"{name} {counts[name]}"
        result.append(Region(name, region.outlines, region.mask))
    return result


def write_regions(regions: Sequence[Region], path: str | os.PathLike[str]) -> None:
    """Write outlines as a table of ``name``, ``x_mm`` and ``y_mm``, as :func:`read_regions` reads.

    Regions of the same name get a number, and masks become the outlines of their pixels. Where a
    region has several outlines, a column ``outline`` numbers those of each region.

    Raises
    ------
    InputError
        If the mask of a region holds less than half of every pixel.
    OutputError
        If the file cannot be written.
    """
    rows = []
    for region in map(traced, _numbered(regions)):
        if not region.outlines:
            raise InputError(f"region {region.name!r}: its mask holds no whole pixel")
        for number, outline in enumerate(region.outlines, 1):
            x, y = outline.T
            columns = {"name": region.name, "outline": number, "x_mm": x, "y_mm": y}
            rows.append(pd.DataFrame(columns))
    table = pd.concat(rows)
    if (table["outline"] == 1).all():
        del table["outline"]
    with replacing(path) as temporary:
        table.to_csv(temporary, index=False)
