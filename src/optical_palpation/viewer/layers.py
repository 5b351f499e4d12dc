"""What napari shows, made of the project's objects, and the other way round; no napari in it.

A layer is described as napari's readers do: data, the keywords of the layer, and its kind. Volumes
are `[z, y, x]`, maps `[y, x]`, all in mm. Boundaries and corrections of a volume lie on its samples
and share its scale; regions of interest are in mm.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from optical_palpation.analysis import Region
from optical_palpation.analysis.maps import evenly
from optical_palpation.errors import InputError
from optical_palpation.present.figure import colour_map
from optical_palpation.present.terms import STATE_NUMBERS, STATES, common_limits, is_map, term
from optical_palpation.thickness import Corrections
from optical_palpation.thickness.boundaries import side_filled
from optical_palpation.thickness.corrections import Anchor, Boundary, Exclusion
from optical_palpation.volume import Volume, VolumeMetadata

#: Key of this plugin in the metadata of a layer.
KEY = "optical_palpation"
BOUNDARIES: tuple[Boundary, ...] = ("window", "sample")
# As in the pictures of the boundaries.
COLOURS = {"window": "#56B4E9", "sample": "#E69F00", "filled": "#CC79A7"}
#: B-scans from which the limits of a volume's grey scale are taken.
_LOOKED_AT = 5
#: Width of a boundary on a B-scan, of the width of the B-scan.
_LINE = 0.002
#: Diameter of an anchor, likewise.
_ANCHOR = 0.012
#: Width of the outlines of excluded regions and of regions of interest, of the width of the map.
_OUTLINE = 0.006
#: Of regions; told apart from all of viridis and cividis.
_REGION = "#FF3030"
_MM = {2: ("mm", "mm"), 3: ("mm", "mm", "mm")}


class Layer(NamedTuple):
    """A layer as napari's readers give it."""

    data: Any
    keywords: dict[str, Any]
    kind: str


class Frame(NamedTuple):
    """Where the samples of a volume lie: spacing and origin along (z, y, x), mm, and how many."""

    spacing: tuple[float, float, float]
    origin: tuple[float, float, float]
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, metadata: VolumeMetadata) -> Frame:
        """Frame of an open volume; a single B-scan is as thick as its samples are apart."""
        z, y, x = metadata.spacing
        y = y if np.isfinite(y) else x
        return cls((z, y, x), tuple(metadata.origin), metadata.shape)  # type: ignore[arg-type]

    def keywords(self) -> dict[str, Any]:
        """Keywords of a layer that lies on the samples."""
        return {
            "scale": self.spacing,
            "translate": self.origin,
            "units": _MM[3],
            "axis_labels": ("z", "y", "x"),
        }

    def to_samples(self, mm: ArrayLike) -> NDArray[np.float64]:
        """Positions (..., 3) in mm as fractional numbers of samples."""
        return (np.asarray(mm, float) - self.origin) / np.asarray(self.spacing)

    def to_mm(self, samples: ArrayLike) -> NDArray[np.float64]:
        """Positions (..., 3) in numbers of samples as mm."""
        return np.asarray(samples, float) * self.spacing + self.origin


class LazyVolume:
    """Samples `[z, y, x]` that are read from the file as they are shown."""

    ndim = 3

    def __init__(self, volume: Volume) -> None:
        self._samples = volume.to_xarray().variable
        self._complex = volume.metadata.is_complex
        self._lock = threading.Lock()  # napari may slice in a thread of its own
        self.shape = volume.shape
        self.size = int(np.prod(self.shape))
        self.dtype = np.dtype(np.float32)

    def __getitem__(self, key: Any) -> NDArray[np.float32]:
        with self._lock:
            part = self._samples[key].values
        return np.abs(part).astype(np.float32) if self._complex else part

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[...], dtype)

    def __len__(self) -> int:
        return self.shape[0]


def volume_layer(
    volume: Volume, file: str, how: Mapping[str, Any] | None = None, name: str | None = None
) -> Layer:
    """Show a volume, which has to stay open.

    Parameters
    ----------
    volume
        The volume.
    file
        Its file, complete.
    how
        Keys of a study file that had to be given for it to be opened, such as ``axes``.
    name
        What to call it; by default after its file.
    """
    about = volume.metadata
    keywords = Frame.of(about).keywords() | {
        "name": name or about.path.name,
        "colormap": "gray",
        "contrast_limits": _grey_limits(volume),
        # amplitudes of scattering differ by orders of magnitude, decibels do not
        "gamma": 1.0 if about.scale == "dB" else 0.5,
        "metadata": {
            KEY: {"kind": "volume", "input": {"volume": file, **(how or {})}, "scale": about.scale}
        },
    }
    return Layer(LazyVolume(volume), keywords, "image")


def _grey_limits(volume: Volume) -> tuple[float, float]:
    rows = np.unique(np.linspace(0, len(volume) - 1, _LOOKED_AT).astype(int))
    values = np.concatenate([np.abs(volume.bscan(int(y))).ravel() for y in rows])
    if volume.metadata.scale == "dB":
        values = np.concatenate([volume.bscan(int(y)).ravel() for y in rows])
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(values, [5.0, 99.5]))
    return (low, high) if high > low else (low, low + 1.0)


def boundary_layers(found: xr.Dataset, frame: Frame, side: str) -> list[Layer]:
    """Show both boundaries of a volume as lines on its B-scans, and what was filled.

    Parameters
    ----------
    found
        As from :func:`~optical_palpation.thickness.find_layer`.
    frame
        That of the volume.
    side
        ``unloaded`` or ``loaded``, for the name.
    """
    result = []
    (_, dy, dx), z0 = frame.spacing, frame.origin[0]
    for boundary in BOUNDARIES:
        depth = found[f"{boundary}_depth"].values
        filled = side_filled(found, boundary).values
        y, x = np.indices(depth.shape)
        # along z in units of the spacing along x, so that lines are as wide along both
        points = np.stack([(depth - z0) / dx, y, x], -1).astype(np.float32)
        # a line from each A-scan to the next; half a sample to either side where there is one only
        if points.shape[1] > 1:
            start, step = points[:, :-1], np.diff(points, axis=1)
            made_up = filled[:, :-1] | filled[:, 1:]
        else:
            step = np.zeros_like(points)
            step[..., 2] = 1.0
            start = points - 0.5 * step
            made_up = filled
        keywords = frame.keywords() | {
            "scale": (dx, dy, dx),
            "name": f"{side}: {boundary} side",
            "features": {"filled": made_up.ravel()},
            "edge_color": np.where(made_up.ravel(), COLOURS["filled"], COLOURS[boundary]),
            "edge_width": _LINE * depth.shape[1],
            "vector_style": "line",
            "opacity": 1.0,
            "metadata": {KEY: {"kind": "boundary", "side": side}},
        }
        vectors = np.stack([start, step], -2).reshape(-1, 2, 3)
        result.append(Layer(vectors, keywords, "vectors"))
    return result


def map_layers(
    maps: xr.Dataset, prefix: str = "", only: Sequence[str] | None = None
) -> list[Layer]:
    """Show maps, each in its colours; those of one quantity share their limits.

    Parameters
    ----------
    maps
        Variables on ``(y, x)``, mm; others are left out.
    prefix
        Put before their names, as in "loaded: Thickness (mm)".
    only
        Names of the variables, in the order of the layers; all by default.
    """
    names = [str(n) for n in (only or maps.data_vars) if n in maps and is_map(maps[n])]
    terms = {name: term(maps, name) for name in names}
    groups: dict[str, dict[str, xr.DataArray]] = {}
    for name in names:
        groups.setdefault(terms[name].scale, {})[name] = maps[name]
    layers = []
    for name in names:
        field, about = evenly(maps[name].transpose("y", "x").sortby(["y", "x"])), terms[name]
        caption = f"{prefix}{about.label}"
        y, x = field["y"].values, field["x"].values
        steps = [float(v[-1] - v[0]) / (v.size - 1) if v.size > 1 else 1.0 for v in (y, x)]
        colours: dict[str, Any] | str
        if about.colours == "states":
            limits = -0.5, len(STATES) - 0.5
            colours = _steps(list(STATES.values()), name)
            caption += f"\n{STATE_NUMBERS}"  # napari's colour bar has numbers alone
        elif about.colours == "flags":
            limits = -0.5, 1.5
            colours = _steps(["#DDDDDD", COLOURS["filled"]], name)
        else:
            limits = common_limits(groups[about.scale], about.colours)
            colours = _continuous(about.colours)
        keywords = {
            "name": f"{prefix}{about.label}",
            "scale": steps,
            "translate": [float(y[0]), float(x[0])],
            "units": _MM[2],
            "axis_labels": ("y", "x"),
            "colormap": colours,
            "contrast_limits": limits,
            "metadata": {
                KEY: {"kind": "map", "variable": name, "units": about.units, "caption": caption}
            },
        }
        layers.append(Layer(field.values.astype(np.float32), keywords, "image"))
    return layers


def _continuous(name: str) -> dict[str, Any]:
    return {"name": name, "colors": colour_map(name)(np.linspace(0.0, 1.0, 256))}


def _steps(colours: list[str], name: str) -> dict[str, Any]:
    """Colour map with a step between whole numbers."""
    rgba = [[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] + [1.0] for c in colours]
    controls = np.linspace(0.0, 1.0, len(colours) + 1)
    return {"name": name, "colors": rgba, "controls": controls, "interpolation": "zero"}


def anchor_layer(corrections: Corrections, frame: Frame, side: str) -> Layer:
    """Anchors of a volume as points on its B-scans, and those still to be set with the mouse."""
    anchors = corrections.anchors
    points = frame.to_samples([(a.z, a.y, a.x) for a in anchors]) if anchors else np.empty((0, 3))
    keywords = frame.keywords() | {
        "name": f"{side}: anchors",
        "features": {"boundary": np.array([a.boundary for a in anchors], dtype=object)},
        "feature_defaults": {"boundary": "sample"},
        "face_color": [COLOURS[a.boundary] for a in anchors] or COLOURS["sample"],
        "border_color": "white",
        "symbol": "disc",
        "size": _ANCHOR * frame.shape[2],
        "metadata": {KEY: {"kind": "anchors", "side": side}},
        "ndim": 3,
    }
    return Layer(points, keywords, "points")


def exclusion_layer(corrections: Corrections, frame: Frame, side: str) -> Layer:
    """Excluded regions of a volume as rectangles on its maps."""
    given = corrections.exclusions
    corners = [
        np.array([(e.y_min, e.x_min), (e.y_min, e.x_max), (e.y_max, e.x_max), (e.y_max, e.x_min)])
        for e in given
    ]
    keywords = {
        "name": f"{side}: excluded",
        "shape_type": "rectangle",
        "features": {"boundary": np.array([e.boundary for e in given], dtype=object)},
        "feature_defaults": {"boundary": "sample"},
        "edge_color": [COLOURS[e.boundary] for e in given] or COLOURS["sample"],
        "face_color": "transparent",
        "edge_width": _OUTLINE * frame.shape[2] * frame.spacing[2],
        "units": _MM[2],
        "axis_labels": ("y", "x"),
        "metadata": {KEY: {"kind": "excluded", "side": side}},
        "ndim": 2,
    }
    return Layer(corners, keywords, "shapes")


def corrections_from(
    anchors: ArrayLike,
    anchor_boundaries: Sequence[str],
    excluded: Sequence[ArrayLike],
    excluded_boundaries: Sequence[str],
    frame: Frame,
) -> Corrections:
    """Corrections of what was drawn.

    Parameters
    ----------
    anchors
        Points (n, 3) in samples (z, y, x).
    anchor_boundaries
        ``window`` or ``sample`` for each.
    excluded
        Vertices (m, 2) of shapes, mm (y, x): the rectangle around each is excluded.
    excluded_boundaries
        As for the anchors.
    frame
        That of the volume.

    Raises
    ------
    InputError
        If one of them lies outside of the volume, or names no boundary.
    """
    for name in (*anchor_boundaries, *excluded_boundaries):
        if name not in BOUNDARIES:
            raise InputError(f"corrections: a boundary is window or sample, not {name!r}")
    points = frame.to_mm(np.asarray(anchors, float).reshape(-1, 3)).tolist()
    drawn = [
        Anchor(_boundary(name), x, y, z)
        for name, (z, y, x) in zip(anchor_boundaries, points, strict=True)
    ]
    rectangles = []
    for name, vertices in zip(excluded_boundaries, excluded, strict=True):
        corners = np.asarray(vertices, float).reshape(-1, 2)
        (y0, x0), (y1, x1) = corners.min(0).tolist(), corners.max(0).tolist()
        rectangles.append(Exclusion(_boundary(name), x0, x1, y0, y1))
    result = Corrections(tuple(drawn), tuple(rectangles))
    result.check_inside(frame.origin, frame.spacing, frame.shape)
    return result


def _boundary(name: str) -> Boundary:
    return "window" if name == "window" else "sample"


def region_layer(maps: xr.Dataset, regions: Sequence[Region] = ()) -> Layer:
    """Regions of interest on maps as shapes, mm, to draw more of."""
    outlines = [outline[:, ::-1] for region in regions for outline in region.outlines]
    names = [region.name for region in regions for _ in region.outlines]
    wholes = [whole_of(region) for region in regions for _ in region.outlines]
    keywords = {
        "name": "regions",
        "shape_type": "polygon",
        "features": {
            "name": np.array(names, dtype=object),
            "part of": np.array(wholes, dtype=object),
        },
        "feature_defaults": {"name": "", "part of": ""},
        "text": {"string": "{name}", "color": _REGION, "size": 11, "anchor": "center"},
        "edge_color": _REGION,
        "face_color": "transparent",
        "edge_width": _OUTLINE * float(np.ptp(maps["x"].values)),
        "opacity": 1.0,
        "units": _MM[2],
        "axis_labels": ("y", "x"),
        "metadata": {KEY: {"kind": "regions"}},
        "ndim": 2,
    }
    return Layer(outlines, keywords, "shapes")


def whole_of(region: Region) -> str:
    """What tells that several shapes are one region, as a ring is; "" where one shape is."""
    return region.name if len(region.outlines) > 1 else ""


def free_name(name: str, taken: Collection[str]) -> str:
    """Return a name, with a number where it is taken."""
    numbers = (f"{name} {number}" for number in itertools.count(2))
    return next(it for it in itertools.chain([name], numbers) if it not in taken)


def regions_from(
    shapes: Sequence[ArrayLike],
    kinds: Sequence[str],
    names: Sequence[object],
    wholes: Sequence[object] = (),
) -> list[Region]:
    """Regions of what was drawn.

    Parameters
    ----------
    shapes
        Vertices (m, 2), mm (y, x), as napari keeps them: of an ellipse the corners of its box.
    kinds
        ``rectangle``, ``ellipse``, ``polygon``; of the rest, lines, there is no region.
    names
        What to call them; those without a name, or with that of another, get a number.
    wholes
        Shapes with the same text here are one region; "" for those that are one each, as all
        are by default.

    Raises
    ------
    InputError
        If none of them has an area.
    """
    regions: dict[str, Region] = {}
    started: dict[str, str] = {}
    wholes = wholes or [""] * len(shapes)
    rows = zip(shapes, kinds, names, wholes, strict=True)
    for number, (vertices, kind, given, whole) in enumerate(rows, 1):
        if kind in ("line", "path"):
            continue
        corners = np.asarray(vertices, float)[:, ::-1]
        make = Region.ellipse_in_box if kind == "ellipse" else Region.polygon
        if isinstance(whole, str) and whole in started:
            name = started[whole]
            outlines = regions[name].outlines + make(name, corners).outlines
            regions[name] = Region(name, outlines)
            continue
        name = given.strip() if isinstance(given, str) else ""
        if not name or name in regions:
            name = free_name(f"{name or 'region'} {number}", regions)
        if isinstance(whole, str) and whole:
            started[whole] = name
        regions[name] = make(name, corners)
    if not regions:
        raise InputError("draw a rectangle, an ellipse or a polygon on the map: there is none yet")
    return list(regions.values())
