"""The layer's two boundaries in an OCT volume, and its thickness between them."""

import json
import mmap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter, median_filter

from optical_palpation.arguments import choice, explained, in_words, number, numbers
from optical_palpation.errors import InputError

from .canny import canny_surface
from .cleaning import _fill
from .corrections import Corrections, read_corrections
from .intensity import BScans, Intensity, Scale, intensity_reader, point_spread
from .refinement import refine, take_band
from .rivals import rival_line, rival_rise
from .tracking import BLOCK, Edge, Reduced, gaps_between, reduce_volume, track

Method = Literal["surface", "canny"]
Range = tuple[float, float]
Progress = Callable[[float], None]
#: What a boundary looks like, about where it is, and what it lies below: `[y, x]`, pixels.
Estimate = tuple[Edge, NDArray, NDArray]

GUARD = 6.0  # axial resolutions (standard deviations) within which two boundaries are one
BAND = 24.0  # ... around a tracked surface that are read again for its refinement
NEAR = 6.0  # ... around it of which no more than a share may be missing:
MOST_MISSING = 0.5
GAP = 10.0  # axial resolutions that may be missing of the clear layer above a rise
CELLS = (2.0, 4.0)  # lateral averaging over this many resolution cells, in two and in one dimension
WORST_CONTRAST = 0.25  # a boundary of less contrast is not seen
HAMPEL = 3.0  # an outlier is this many (robust) standard deviations off the median around it
#: Times by which a reflection exceeds the usual intensity of the brightest sample of an A-scan.
SPECULAR = 8.0
FWHM = 2.355
SMALLEST = (32, 1, 4)  # shape of a volume that shows a layer and the width of its speckle
RELEASE = 32  # B-scans after which the pages of a mapped file are given back


class _Array:
    """An array `[z, y, x]`, in memory or mapped, as B-scans."""

    def __init__(self, array: NDArray) -> None:
        self.shape, self._array = array.shape, array
        base: object = array
        while isinstance(base, np.ndarray):
            base = base.base
        self._map: mmap.mmap | None = base if isinstance(base, mmap.mmap) else None

    def bscan(self, y: int) -> NDArray:
        image = self._array[:, y, :].copy()
        if self._map is not None and y % RELEASE == RELEASE - 1 and hasattr(mmap, "MADV_DONTNEED"):
            # Pages that were read stay with the system, but need not count as this process's.
            self._map.madvise(mmap.MADV_DONTNEED)
        return image


@dataclass(frozen=True)
class _Scan:
    """A volume with what its first reading told."""

    read: Intensity
    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]
    origin: tuple[float, float, float]
    sigma: float
    cell: tuple[float, float]
    reduced: Reduced
    speckled: bool

    @property
    def lateral(self) -> tuple[float, float]:
        """Standard deviations (y, x) of the lateral average, pixels."""
        cells = CELLS[0] if min(self.shape[1:]) > 1 else CELLS[1]
        return tuple(cells * max(FWHM * c, 1.0) for c in self.cell)  # type: ignore[return-value]

    def depths(self, given: Range | None, whole: Range) -> Range:
        """Range of depth in pixels from one in mm."""
        if given is None:
            return whole
        first, last = ((d - self.origin[0]) / self.spacing[0] for d in given)
        if not first < last or last < 0 or first > self.shape[0] - 1:
            raise InputError(
                f"search range {given} mm: it must run from shallow to deep within the volume, "
                f"{self.origin[0]:g} to {self.origin[0] + self.shape[0] * self.spacing[0]:g} mm"
            )
        return first, last

    def map(self, values: ArrayLike, name: str, units: str) -> xr.DataArray:
        """Values `[y, x]` with coordinates in mm."""
        _, y, x = (
            o + s * np.arange(n)
            for o, s, n in zip(self.origin, self.spacing, self.shape, strict=True)
        )
        coords = {"y": ("y", y, {"units": "mm"}), "x": ("x", x, {"units": "mm"})}
        return xr.DataArray(values, coords, ("y", "x"), attrs={"units": units, "long_name": name})


@explained
def find_layer(
    volume: BScans | NDArray,
    *,
    spacing: tuple[float, float, float] | None = None,
    scale: Scale | None = None,
    window: Edge | float = "line",
    sample: Edge = "rise",
    window_range: Range | None = None,
    sample_range: Range | None = None,
    corrections: Corrections | str | Path | None = None,
    method: Method = "surface",
    progress: Progress | None = None,
) -> xr.Dataset:
    """Find both boundaries of a transparent layer in an OCT volume.

    Parameters
    ----------
    volume
        Array `[z, y, x]`, memory-mapped or not, or anything with ``shape`` (z, y, x) and
        ``bscan(y)`` that gives `[z, x]`. It is read twice, B-scan by B-scan.
    spacing
        Physical pixel spacing (z, y, x), mm; may be left out for a volume that knows its own.
    scale
        "linear" ("amplitude" or "intensity", which shows unless it is said) or "dB"; may be left
        out likewise.
    window
        How the window side shows: a bright "line" (a reflection), a "fall" from bright to dark
        (a scattering window), or its depth in mm where it is known, as 0 in common-path OCT.
    sample
        How the sample side shows: a "rise" from dark to scattering, which ignores thin lines if
        there is scattering below them, or a "line" (a mirror-like sample).
    window_range, sample_range
        Depths (shallow, deep), mm, between which to search.
    corrections
        Anchor points and excluded regions, or the file that lists them.
    method
        "surface" tracks a smooth surface through the volume; "canny" takes the edges of each
        B-scan for themselves.
    progress
        Called with the finished share, 0 to 1.

    Returns
    -------
    xarray.Dataset
        On (y, x): ``window_depth``, ``sample_depth`` and ``thickness`` in mm, ``quality`` in
        [0, 1] (the lower Michelson contrast of the two boundaries, lower where a reflection
        outshines the sample, 0 where interpolated), ``window_filled`` and ``sample_filled`` (True
        where the boundary was not seen, or was an outlier, and was interpolated), ``filled`` (True
        where either of them was) and ``specular`` (True where there is such a reflection, which may
        draw the boundary to itself). The attribute ``doubts`` is a list of texts (JSON): what else
        in the volume may be a boundary as well, and whether its scale is in doubt.

    Raises
    ------
    InputError
        If spacing or scale are missing, or a boundary is nowhere to be seen.
    """
    tell = progress or (lambda share: None)
    finder = LayerFinder(
        volume,
        spacing=spacing,
        scale=scale,
        window=window,
        sample=sample,
        window_range=window_range,
        sample_range=sample_range,
        method=method,
        progress=lambda share: tell(0.4 * share),
    )
    return finder.find(corrections, progress=lambda share: tell(0.4 + 0.6 * share))


@dataclass(frozen=True)
class _Located:
    """First estimate of a boundary, and what it was made from."""

    first: NDArray[np.float64]
    last: NDArray[np.float64]
    anchors: list[tuple[float, float, float]]
    excluded: NDArray[np.bool_]
    start: NDArray[np.float64]


class LayerFinder:
    """Finds the layer in a volume again and again, as corrections are made.

    The volume is read once when the finder is made, and once more for the boundaries that a
    correction has changed; the others stay. The result is that of :func:`find_layer` with the same
    corrections, to the last bit.

    Parameters
    ----------
    volume, spacing, scale, window, sample, window_range, sample_range, method, progress
        As for :func:`find_layer`.

    Raises
    ------
    InputError
        If spacing or scale are missing, or a parameter cannot be used.
    """

    def __init__(
        self,
        volume: BScans | NDArray,
        *,
        spacing: tuple[float, float, float] | None = None,
        scale: Scale | None = None,
        window: Edge | float = "line",
        sample: Edge = "rise",
        window_range: Range | None = None,
        sample_range: Range | None = None,
        method: Method = "surface",
        progress: Progress | None = None,
    ) -> None:
        if isinstance(window, str):
            choice(window, "window", "line", "fall", "rise")
        else:
            number(window, "window", "'line', 'fall', 'rise' or a depth in mm")
        choice(sample, "sample", "rise", "line", "fall")
        choice(method, "method", "surface", "canny")
        for name, given in (("window_range", window_range), ("sample_range", sample_range)):
            if given is not None:
                numbers(given, 2, name, "two depths (shallow, deep) in mm")
        self._scan = _scan(volume, spacing, scale, progress or (lambda share: None))
        self._window, self._sample, self._method = window, sample, method
        self._ranges = {"window": window_range, "sample": sample_range}
        self._located: dict[str, _Located] = {}
        self._parts: dict[str, tuple[NDArray, NDArray, NDArray, NDArray]] = {}
        self._finished: dict[str, tuple[NDArray, ...]] = {}

    def find(
        self,
        corrections: Corrections | str | Path | None = None,
        *,
        progress: Progress | None = None,
    ) -> xr.Dataset:
        """Find both boundaries.

        Parameters
        ----------
        corrections, progress
            As for :func:`find_layer`.

        Returns
        -------
        xarray.Dataset
            As from :func:`find_layer`.

        Raises
        ------
        InputError
            If a correction lies outside of the volume, or a boundary is nowhere to be seen.
        """
        tell = progress or (lambda share: None)
        scan, window = self._scan, self._window
        fixes = _corrections(corrections)
        fixes.check_inside(scan.origin, scan.spacing, scan.shape)
        ny, nx = scan.shape[1:]
        whole = (0.0, scan.shape[0] - 1.0)
        first, last = scan.depths(self._ranges["window"], whole)
        found: dict[str, Estimate] = {}
        if isinstance(window, str):
            ends = np.full((ny, nx), first), np.full((ny, nx), last)
            top = self._locate("window", window, *ends, fixes)
            found["window"] = window, top, np.zeros((ny, nx))
        else:
            top = np.full((ny, nx), (float(window) - scan.origin[0]) / scan.spacing[0])
        first, last = scan.depths(self._ranges["sample"], whole)
        guarded = np.maximum(top + GUARD * scan.sigma, 0.0)
        ends = np.maximum(first, guarded), np.full((ny, nx), last)
        bottom = self._locate("sample", self._sample, *ends, fixes)
        found["sample"] = self._sample, bottom, guarded
        tell(0.1)
        nowhere = np.zeros((ny, nx), bool)
        parts = {"window": (top, np.ones((ny, nx)), nowhere, nowhere)}
        parts |= self._finish(found, fixes, lambda share: tell(0.1 + 0.9 * share))
        found_layer = self._dataset(parts)
        found_layer.attrs["doubts"] = json.dumps(self._doubts(parts))
        tell(1.0)
        return found_layer

    def _locate(
        self,
        boundary: Literal["window", "sample"],
        edge: Edge,
        first: NDArray[np.float64],
        last: NDArray[np.float64],
        fixes: Corrections,
    ) -> NDArray[np.float64]:
        """First estimate of a boundary, that of before if it is made from the same."""
        scan = self._scan
        anchors = fixes.anchor_pixels(boundary, scan.origin, scan.spacing)
        excluded = _excluded(scan, fixes, boundary)
        known = self._located.get(boundary)
        if (
            known is None
            or known.anchors != anchors
            or not np.array_equal(known.excluded, excluded)
            or not np.array_equal(known.first, first)
            or not np.array_equal(known.last, last)
        ):
            start = _locate(scan, edge, first, last, fixes, boundary, self._method)
            known = _Located(first, last, anchors, excluded, start)
            self._located[boundary] = known
        return known.start

    def _finish(
        self, found: dict[str, Estimate], fixes: Corrections, progress: Progress
    ) -> dict[str, tuple[NDArray, NDArray, NDArray, NDArray]]:
        """Refine the boundaries whose estimate or excluded pixels have changed."""
        changed, made_from = {}, {}
        for boundary, (_, *depths) in found.items():
            made_from[boundary] = *depths, _excluded(self._scan, fixes, boundary)
            before = self._finished.get(boundary)
            if before is None or not all(
                np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
                for a, b in zip(before, made_from[boundary], strict=True)
            ):
                changed[boundary] = found[boundary]
        if changed:
            new = _finish(self._scan, changed, fixes, self._method, progress)
            self._parts |= new
            self._finished |= {boundary: made_from[boundary] for boundary in new}
        return {boundary: self._parts[boundary] for boundary in found}

    def _doubts(self, parts: dict[str, tuple[NDArray, NDArray, NDArray, NDArray]]) -> list[str]:
        """What else may be a boundary of the layer, in words."""
        scan = self._scan
        said = [scan.read.doubt] if scan.read.doubt else []
        if not scan.speckled and self._sample != "line":
            width = 1e3 * FWHM * scan.sigma * scan.spacing[0]
            said.append(
                "the axial resolution does not show in the sample's speckle (averaged away, or the "
                f"sample has none): {width:.2g} um was taken, that of the brightest reflection if "
                "there is one. The sample side may be off by half of it"
            )
        seen = scan.reduced, scan.sigma, parts["window"][0], parts["sample"][0]
        dz = scan.spacing[0]
        if self._window == "line":
            search = scan.depths(self._ranges["window"], (0.0, scan.shape[0] - 1.0))
            if (off := rival_line(*seen, search)) is not None:
                said.append(
                    f"a line nearly as bright as the window's lies about {dz * off:.2g} mm from "
                    "it: see which is the window, and say so by window_range"
                )
        if self._sample == "rise" and (off := rival_rise(*seen)) is not None:
            said.append(
                f"there is scattering from about {dz * off:.2g} mm above the sample side on: see "
                "where the sample begins, and say so by sample_range"
            )
        return said

    def _dataset(self, parts: dict[str, tuple[NDArray, NDArray, NDArray, NDArray]]) -> xr.Dataset:
        scan = self._scan
        top, top_quality, top_filled = parts["window"][:3]
        bottom, bottom_quality, bottom_filled, specular = parts["sample"]
        filled = top_filled | bottom_filled
        quality = np.where(filled, 0.0, np.minimum(top_quality, bottom_quality))
        dz, z0 = scan.spacing[0], scan.origin[0]
        return xr.Dataset(
            {
                "window_depth": scan.map(z0 + dz * top, "depth of the window side", "mm"),
                "sample_depth": scan.map(z0 + dz * bottom, "depth of the sample side", "mm"),
                "thickness": scan.map(dz * (bottom - top), "thickness of the layer", "mm"),
                "quality": scan.map(quality, "contrast of the weaker boundary", "1"),
                "filled": scan.map(filled, "interpolated", "1"),
                "window_filled": scan.map(top_filled, "window side interpolated", "1"),
                "sample_filled": scan.map(bottom_filled, "sample side interpolated", "1"),
                "specular": scan.map(
                    specular.copy(), "as bright as a reflection, near or at the pixel", "1"
                ),
            },
            attrs={
                "method": self._method,
                "specular_share": float(np.mean(specular)),
                "axial_resolution_mm": float(FWHM * scan.sigma * dz),
                "filled_share": float(np.mean(filled)),
            },
        )


def side_filled(found: xr.Dataset, side: str) -> xr.DataArray:
    """Where a boundary is interpolated; files of older versions tell only that one of both is.

    Parameters
    ----------
    found
        As from :func:`find_layer`.
    side
        ``window`` or ``sample``.
    """
    return found.get(f"{side}_filled", found["filled"])


def find_surface(
    volume: BScans | NDArray,
    *,
    edge: Edge = "rise",
    spacing: tuple[float, float, float] | None = None,
    scale: Scale | None = None,
    search: Range | None = None,
    method: Method = "surface",
) -> xr.Dataset:
    """Find one surface; parameters as for :func:`find_layer`.

    Returns
    -------
    xarray.Dataset
        ``depth`` in mm, ``quality`` and ``filled`` on (y, x).
    """
    scan = _scan(volume, spacing, scale, lambda share: None)
    first, last = scan.depths(search, (0.0, scan.shape[0] - 1.0))
    shape = scan.shape[1:]
    fixes = Corrections()
    found = _locate(
        scan, edge, np.full(shape, first), np.full(shape, last), fixes, "sample", method
    )
    estimates = {"sample": (edge, found, np.zeros(shape))}
    parts = _finish(scan, estimates, fixes, method, lambda share: None)
    depth, quality, filled, _ = parts["sample"]
    return xr.Dataset(
        {
            "depth": scan.map(scan.origin[0] + scan.spacing[0] * depth, "depth", "mm"),
            "quality": scan.map(np.where(filled, 0.0, quality), "contrast", "1"),
            "filled": scan.map(filled, "interpolated", "1"),
        }
    )


def _excluded(scan: _Scan, fixes: Corrections, boundary: str) -> NDArray[np.bool_]:
    return fixes.excluded_pixels(boundary, scan.origin, scan.spacing, scan.shape[1:])


def _corrections(given: Corrections | str | Path | None) -> Corrections:
    if given is None:
        return Corrections()
    return given if isinstance(given, Corrections) else read_corrections(given)


def _scan(
    volume: BScans | NDArray,
    spacing: tuple[float, float, float] | None,
    scale: Scale | None,
    progress: Progress,
) -> _Scan:
    """Read the volume for the first time."""
    if not (isinstance(volume, np.ndarray) or hasattr(volume, "bscan")):
        raise InputError(
            f"volume: an opened volume (open_volume), or an array [z, y, x], not {in_words(volume)}"
        )
    metadata = getattr(volume, "metadata", None)
    source: BScans = _Array(volume) if isinstance(volume, np.ndarray) else volume
    if spacing is None:
        spacing = getattr(metadata, "spacing", None)
    scale = getattr(metadata, "scale", None) if scale is None else scale
    if spacing is None or scale is None:
        raise InputError("find_layer: give the spacing (z, y, x) in mm and the scale of the volume")
    if len(source.shape) != 3 or not np.all(np.greater_equal(source.shape, SMALLEST)):
        raise InputError(
            f"a volume of shape {source.shape} (z, y, x) is too small for a layer; is the order of "
            "the axes right?"
        )
    try:
        dz, dy, dx = map(float, spacing)
    except (TypeError, ValueError):
        raise InputError(
            f"spacing: three positive numbers (z, y, x) in mm, not {in_words(spacing)}"
        ) from None
    # A single B-scan has no spacing along y; any will do.
    dy = dx if source.shape[1] == 1 and not np.isfinite(dy) else dy
    if not (np.all(np.isfinite([dz, dy, dx])) and min(dz, dy, dx) > 0):
        raise InputError(f"spacing: three positive numbers (z, y, x) in mm, not {tuple(spacing)}")
    origin = getattr(metadata, "origin", None) or (0.0, 0.0, 0.0)
    read = intensity_reader(source, scale)
    sigma, across, speckled = point_spread(read, source.shape[1])
    shape = (source.shape[0], source.shape[1], source.shape[2])
    reduced = reduce_volume(read, shape, progress)
    cell = (across * dx / dy, across)
    return _Scan(read, shape, (dz, dy, dx), tuple(origin), sigma, cell, reduced, speckled)


def _locate(
    scan: _Scan,
    edge: Edge,
    first: NDArray,
    last: NDArray,
    fixes: Corrections,
    boundary: Literal["window", "sample"],
    method: Method,
) -> NDArray[np.float64]:
    """First estimate of a boundary, pixels; NaN where the Canny detector sees nothing."""
    if method == "canny":
        return canny_surface(scan.read, scan.shape, edge, first, last, sigma=scan.sigma)
    return track(
        scan.reduced,
        edge,
        sigma=scan.sigma,
        spacing=scan.spacing,
        first=first,
        last=last,
        anchors=fixes.anchor_pixels(boundary, scan.origin, scan.spacing),
        excluded=_excluded(scan, fixes, boundary),
    )


def _finish(
    scan: _Scan,
    found: dict[str, Estimate],
    fixes: Corrections,
    method: Method,
    progress: Progress,
) -> dict[str, tuple[NDArray, NDArray, NDArray, NDArray]]:
    """Refine the boundaries found, reject what is not to be believed and fill the gaps.

    Returns depth (pixels), quality, filled and specular pixels of each boundary.
    """
    ny, nx = scan.shape[1:]
    reach = round(BAND * scan.sigma) + 2
    bands = {name: np.empty((ny, nx, 2 * reach + 1), np.float32) for name in found}
    starts = {
        name: np.nan_to_num(np.round(depth), nan=0.0).astype(np.int64) - reach
        for name, (_, depth, _) in found.items()
    }
    for y in range(ny):
        image = scan.read(y)
        for name in found:
            take_band(image, starts[name][y], bands[name][y])
        progress(0.5 * (y + 1) / ny)
    parts = {}
    for name, (edge, start, shallowest) in found.items():
        lateral = scan.lateral
        # a line is a reflection everywhere
        glare = _glare(bands[name], lateral) if edge == "rise" else np.ones((ny, nx))
        blank = _unseen(scan, bands[name], starts[name], edge, shallowest)
        depth, quality = refine(
            bands.pop(name),
            starts[name],
            np.nan_to_num(start),
            scan.reduced.floor,
            edge,
            sigma=scan.sigma,
            cell=scan.cell,
            lateral=lateral,
        )
        if method == "canny":
            depth = start
        excluded = _excluded(scan, fixes, name)
        lost = ~np.isfinite(depth) | (quality < WORST_CONTRAST) | excluded | blank
        lost |= (depth < shallowest) | (depth > scan.shape[0] - 1)
        if np.mean(lost) > 0.95:
            raise InputError(
                f"the {name} side of the layer is nowhere to be seen; check the volume, what the "
                f"boundary looks like ({edge!r}) and the range it is searched in"
            )
        lost |= _outliers(np.where(lost, np.nan_to_num(start), depth), lateral, scan.sigma)
        weights = [1.0 / scan.spacing[1] ** 2, 1.0 / scan.spacing[2] ** 2]
        depth = _fill(np.where(lost, np.nan, depth), lost, weights)
        parts[name] = depth, np.clip(quality / glare, 0.0, 1.0), lost, glare > 1.0
        progress(0.5 + 0.5 * len(parts) / len(found))
    return parts


def _unseen(
    scan: _Scan,
    band: NDArray[np.float32],
    first: NDArray[np.int64],
    edge: Edge,
    shallowest: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Where too many samples are missing to see a boundary, though its neighbours may tell it.

    These are the samples around it, in the middle of a ``band`` that begins in the rows ``first``,
    and of a rise those between it and the ``shallowest`` depth: the boundary may lie in a gap there
    as well, or above it. A gap counts as far as its block and the average of profiles reach; single
    A-scans that are blank do no harm to others.
    """
    ny, nx, rows = band.shape
    reach, depth = rows // 2, scan.shape[0]
    near = min(reach, round(NEAR * scan.sigma) + 2)
    gaps = np.zeros((ny, nx), np.int32)
    for k in range(reach - near, reach + near + 1):
        gaps += (band[..., k] < 0) & (first + k >= 0) & (first + k < depth)
    unseen = gaps > MOST_MISSING * (2 * near + 1)
    if edge == "rise":
        unseen |= gaps_between(scan.reduced, shallowest, first + reach) > GAP * max(scan.sigma, 1.0)
    blank = np.all(band < 0, axis=2)
    beside = [BLOCK // 2 + int(np.ceil(s)) for s in scan.lateral]
    size = [2 * b + 1 if n > 1 else 1 for b, n in zip(beside, (ny, nx), strict=True)]
    return blank | maximum_filter(unseen & ~blank, size)


def _glare(band: NDArray[np.float32], lateral: tuple[float, float]) -> NDArray[np.float64]:
    """How far a reflection outshines scattering at a boundary: 1 where it does not, else more.

    The brightest sample of each A-scan is compared with what is usual around it. Of speckle, whose
    intensity is distributed exponentially, it exceeds that eightfold once in a million A-scans.
    Profiles are averaged laterally, so that a reflection counts as far as the average reaches.
    """
    brightest = band.max(axis=2)
    axes = list(zip(lateral, brightest.shape, strict=True))
    near = [2 * int(np.ceil(3.0 * s)) + 1 if n > 1 else 1 for s, n in axes]
    around = [2 * int(np.ceil(6.0 * s)) + 1 if n > 1 else 1 for s, n in axes]
    usual = median_filter(brightest, around, mode="reflect")
    ratio = brightest / np.maximum(usual, np.finfo(np.float32).tiny)
    return np.maximum(maximum_filter(ratio, near) / SPECULAR, 1.0).astype(np.float64)


def _outliers(
    depth: NDArray[np.float64], lateral: tuple[float, float], sigma: float
) -> NDArray[np.bool_]:
    """Hampel identifier in two dimensions: far from the median of the neighbourhood."""
    from scipy.signal import savgol_filter  # slow to load, and not needed without volumes

    rest = depth.copy()
    size = [1, 1]
    for axis, (s, n) in enumerate(zip(lateral, depth.shape, strict=True)):
        window = 2 * int(np.ceil(2.0 * s)) + 1
        if n > window:
            size[axis] = window
            rest -= savgol_filter(rest, window, 2, axis=axis)  # slopes and bends are no outliers
    off = np.abs(rest - median_filter(rest, size))
    scale = 1.4826 * median_filter(off, size)
    return off > HAMPEL * np.maximum(scale, sigma)
