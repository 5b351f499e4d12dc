"""A field too large for one mesh: fine tiles in a coarse solution, on Dask, blended to one map."""

from __future__ import annotations

import hashlib
import json
import os
import re
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.arguments import explained
from optical_palpation.batch.cluster import connected
from optical_palpation.batch.dispatch import BatchProgress, Dispatcher, Outcome
from optical_palpation.errors import (
    ConvergenceError,
    InputError,
    OpticalPalpationError,
    OutputError,
)
from optical_palpation.files import netcdf, replacing
from optical_palpation.palpation.memory import predicted_memory
from optical_palpation.palpation.plausibility import misread
from optical_palpation.palpation.result import Status, StressResult
from optical_palpation.palpation.submodel import (
    SubmodelInputs,
    checked_region,
    least_margin,
    settings_of,
    submodel_inputs,
    submodel_stress,
)
from optical_palpation.palpation.tiling import Blend, Tiling, tiled
from optical_palpation.present import read_result, write_result
from optical_palpation.runtime.source import source_digest
from optical_palpation.thickness.frames import layer_extent_of, typical_thickness

#: Bytes per pixel of the thickness maps that a worker holds besides its tile.
_PER_PIXEL = 120.0
#: How much wider the margin is at the second try.
_WIDER = 2.0


@explained
def field_stress(
    coarse: StressResult,
    loaded: xr.DataArray,
    initial_thickness: float | xr.DataArray,
    *,
    element_size: float | Sequence[float],
    tile: float,
    region: Sequence[float] | None = None,
    overlap: float | None = None,
    margin: float | None = None,
    imprint_smoothing: float | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    folder: str | os.PathLike[str] | None = None,
    progress: Callable[[BatchProgress], None] | None = None,
) -> StressResult:
    """Compute the stress of a whole field on finer elements than fit into memory at once.

    The field is divided into tiles that overlap. Each is a submodel of the coarse solution
    (:func:`~optical_palpation.palpation.submodel_stress`), computed by a worker of its own, and
    the maps are blended over the overlaps.

    Parameters
    ----------
    coarse, loaded, initial_thickness, element_size, imprint_smoothing
        As for :func:`~optical_palpation.palpation.submodel_stress`.
    tile
        Largest width of a tile in mm, without what it shares with its neighbours. Memory and time
        of a worker are those of the elements of one tile and its margin.
    region
        x0, x1, y0, y1 in mm; the whole layer by default.
    overlap
        Width in mm of the strip that neighbours share; by default as wide as the margin.
    margin
        As for ``submodel_stress``. A tile that finds no equilibrium is tried once more with twice
        the margin.
    workers, scheduler
        As for :func:`~optical_palpation.batch.run_batch`.
    folder
        Where workers leave their tiles; all of them must see it by this path. What is there
        already, of the same inputs, is not computed again. By default a temporary folder on this
        machine.
    progress
        Called with a :class:`~optical_palpation.batch.BatchProgress` now and then.

    Returns
    -------
    StressResult
        Maps of the field, without a layer. ``axial_stress_seam_error`` is the largest difference
        of the tiles that share a point, kPa. Among the attributes, ``seam_error`` is that
        difference as a fraction of the stress in the overlaps (root mean squares),
        ``seam_error_largest_kPa`` the largest one; ``submodel_sides_error`` the largest of the
        tiles; ``tiles_failed`` tells why tiles have no solution, by their names: there the maps
        have no value. ``tiles_told`` tells likewise of tiles that needed a second try.

    Raises
    ------
    InputError
        For a parameter or map that cannot be used; if Dask is missing, the scheduler cannot be
        reached, or a worker has another version.
    OutputError
        If the folder cannot be made or written.
    ConvergenceError
        If no tile has a solution.
    """
    if workers is not None and (workers < 1 or scheduler is not None):
        raise InputError(
            f"workers = {workers}: must be at least 1, and is for workers on this machine alone"
        )
    if scheduler is not None and folder is None:
        raise InputError(
            "folder: where the workers of the scheduler leave their tiles, which all of them and "
            "this process see by the same path"
        )
    inputs = submodel_inputs(coarse, loaded, initial_thickness, element_size, margin)
    extent = layer_extent_of(inputs.loaded)
    whole = checked_region(extent if region is None else region, inputs.loaded)
    overlap = inputs.margin if overlap is None else float(overlap)
    tiling = tiled(whole, inputs.sizes, float(tile), overlap)
    # elements of whole tiles lie on the points of the field
    hx, hy = (float(points[1] - points[0]) for points in (tiling.x, tiling.y))
    sizes = hx, hy, inputs.sizes[2]
    inputs = replace(inputs, sizes=sizes, margin=max(inputs.margin, least_margin(sizes)))
    with tempfile.TemporaryDirectory(prefix="optical-palpation-") as temporary:
        place = Path(temporary if folder is None else folder).resolve()
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = error.strerror or error
            raise OutputError(f"{place}: the folder cannot be made ({reason})") from error
        job = _laid_out(place, coarse, inputs, imprint_smoothing)
        jobs = {t.name: (job, t.name, tiling.region(t)) for t in tiling.tiles}
        need = _predicted_need(inputs, tiling)
        outcomes: dict[str, Outcome] = {}
        with connected(scheduler, workers, [need] * len(jobs)) as crew:
            tell = progress or (lambda _: None)
            Dispatcher(crew, compute_tile, jobs, dict.fromkeys(jobs, need), outcomes, tell).run()
        return _blended(coarse, inputs, tiling, job, outcomes)


_OWN = re.compile(r"(coarse|thickness|tile-\d+-\d+)-[0-9a-f]{16}\.nc")
Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class Job:
    """What all tiles of a field have in common, and where it lies.

    Attributes
    ----------
    folder
        Where inputs and tiles lie.
    key
        Hash of all that decides the result of a tile but its region.
    sizes
        Element sizes (x, y, z), mm.
    margin, smoothing
        As for ``submodel_stress``, mm.
    """

    folder: Path
    key: str
    sizes: tuple[float, float, float]
    margin: float
    smoothing: float | None

    @property
    def coarse(self) -> Path:
        """File of the coarse solution."""
        return self.folder / f"coarse-{self.key[:16]}.nc"

    @property
    def thickness(self) -> Path:
        """File of the thickness maps."""
        return self.folder / f"thickness-{self.key[:16]}.nc"

    def tile(self, name: str, region: Bounds) -> Path:
        """Return the file of a tile; once it is there it is complete, and of these inputs."""
        text = json.dumps([self.key, region])
        return self.folder / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.nc"


def remove_tiles(folder: Path) -> None:
    """Remove what :func:`field_stress` has left in a folder, and the folder if it is then empty."""
    for path in folder.iterdir():
        if _OWN.fullmatch(path.name):
            path.unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def compute_tile(
    task: tuple[Job, str, Bounds], threads: int, tell: Callable[[Any], None]
) -> Outcome:
    """Compute a tile in a worker and leave its maps in the folder; what fails is told.

    Parameters
    ----------
    task
        What the tiles have in common, and the name and region (x0, x1, y0, y1, mm) of this one.
    threads
        Number of threads.
    tell
        Called with reports of progress.
    """
    job, name, region = task
    started = time.monotonic()
    target = job.tile(name, region)
    said = ""
    try:
        if target.is_file():
            return Outcome(name, "earlier")
        coarse, loaded, initial = _inputs(job)

        def solve(margin: float) -> StressResult:
            return submodel_stress(
                coarse,
                loaded,
                initial,
                region,
                element_size=job.sizes,
                margin=margin,
                imprint_smoothing=job.smoothing,
                threads=threads,
                progress=tell,
            )

        try:
            solved = solve(job.margin)
        except ConvergenceError as error:
            said = f"computed with a margin of {_WIDER * job.margin:g} mm, because {error}"
        if said:  # only now is the memory of the first try free: an exception keeps it
            solved = solve(_WIDER * job.margin)
        write_result(StressResult(solved.maps), target)
    except OpticalPalpationError as error:
        return Outcome(
            name, "failed", str(error), type(error).__name__, seconds=time.monotonic() - started
        )
    return Outcome(name, "done", said, seconds=time.monotonic() - started)


def _laid_out(
    folder: Path, coarse: StressResult, inputs: SubmodelInputs, smoothing: float | None
) -> Job:
    """Leave what the tiles are computed from where the workers find it."""
    whole, state = coarse.problem, coarse.state
    assert whole is not None
    assert state is not None
    total = hashlib.sha256(source_digest("palpation").encode())
    settings = [inputs.sizes, inputs.margin, smoothing, str(whole.law), whole.friction]
    settings += [whole.glued, whole.edges, whole.slip_length, layer_extent_of(inputs.loaded)]
    total.update(json.dumps(settings).encode())
    arrays = [whole.grid.x, whole.grid.y, whole.grid.depth, state.u, state.p, state.slip]
    arrays += [state.anchor, state.normal_force, inputs.loaded["x"].values]
    arrays += [inputs.loaded["y"].values, inputs.loaded.values, inputs.initial.values]
    arrays += [] if whole.imprint.motion is None else [whole.imprint.motion]
    for array in arrays:
        total.update(np.ascontiguousarray(array).tobytes())
    job = Job(folder, total.hexdigest(), inputs.sizes, inputs.margin, smoothing)
    if not job.coarse.is_file():
        write_result(replace(coarse, layer=None, pixels=None, sensitivities=None), job.coarse)
    if not job.thickness.is_file():
        maps = xr.Dataset({"loaded": inputs.loaded, "initial": inputs.initial})
        with replacing(job.thickness) as temporary:
            temporary.write_bytes(netcdf(maps))
    return job


@lru_cache(maxsize=1)
def _inputs(job: Job) -> tuple[StressResult, xr.DataArray, xr.DataArray]:
    """Read what the tiles are computed from."""
    maps = xr.load_dataset(job.thickness, engine="h5netcdf")
    return read_result(job.coarse), maps["loaded"], maps["initial"]


def _predicted_need(inputs: SubmodelInputs, tiling: Tiling) -> float:
    """Memory of the largest tile, bytes."""
    hx, hy, hz = inputs.sizes
    through = max(1, round(typical_thickness(inputs.initial) / hz))
    across = [
        max(last - first for first, last in ends) + 2 * round(inputs.margin / size)
        for ends, size in (
            ([tile.rows for tile in tiling.tiles], hy),
            ([tile.columns for tile in tiling.tiles], hx),
        )
    ]
    # its sides may be those of the layer, which free edges refine
    shape = through + 1, across[0] + 2 * through, across[1] + 2 * through
    return predicted_memory(shape) + _PER_PIXEL * inputs.loaded.size


def _blended(
    coarse: StressResult,
    inputs: SubmodelInputs,
    tiling: Tiling,
    job: Job,
    outcomes: dict[str, Outcome],
) -> StressResult:
    """Blend the tiles that there are to maps of the field."""
    failed = {name: o.message for name, o in outcomes.items() if o.status == "failed"}
    if len(failed) == len(tiling.tiles):
        first = next(iter(failed))
        kind = (
            ConvergenceError if outcomes[first].error == ConvergenceError.__name__ else InputError
        )
        raise kind(f"no tile has a solution; the first, {first}: {failed[first]}")
    blend = Blend(tiling)
    found: list[dict[Any, Any]] = []
    for tile in tiling.tiles:
        if tile.name not in failed:
            maps = read_result(job.tile(tile.name, tiling.region(tile))).maps
            blend.add(tile, maps)
            found.append(maps.attrs | {"name": tile.name})
    maps = blend.maps()
    about, stress = coarse.maps.attrs, maps["axial_stress"]
    before = coarse.maps["axial_stress"].interp(x=stress["x"], y=stress["y"])
    change = np.sqrt(((stress - before) ** 2).mean() / (stress**2).mean())
    x, y = tiling.x, tiling.y
    worst = {
        key: choose(float(attrs[key]) for attrs in found)
        for key, choose in {
            "force_residual": max,
            "force_tolerance": max,
            "volume_residual": max,
            "volume_tolerance": max,
            "smallest_volume_ratio": min,
            "sides_force_share": max,
            "map_force_difference": max,
            "submodel_sides_error": max,
        }.items()
    }
    wider = [a["name"] for a in found if a["submodel_margin_mm"] > 1.5 * inputs.margin]
    nearly = any(attrs["status"] == Status.NEARLY for attrs in found)
    status = Status.NEARLY if nearly else Status.CONVERGED
    attrs: dict[Any, Any] = {
        **settings_of(about),
        "element_size_mm": list(found[0]["element_size_mm"]),
        "elements": [len(x) - 1, len(y) - 1, int(found[0]["elements"][2])],
        "imprint_smoothing_mm": found[0]["imprint_smoothing_mm"],
        **inputs.of_region((float(x[0]), float(x[-1]), float(y[0]), float(y[-1]))),
        "sample_force_mN": float(maps["contact_pressure"].fillna(0.0).integrate(["x", "y"])),
        "newton_iterations": sum(int(attrs["newton_iterations"]) for attrs in found),
        "status": str(Status.INCOMPLETE if failed else status),
        **worst,
        "submodel_region_mm": [float(x[0]), float(x[-1]), float(y[0]), float(y[-1])],
        "submodel_margin_mm": inputs.margin,
        "submodel_coarse_element_size_mm": about["element_size_mm"],
        "submodel_change": float(change),
        "tiles": list(tiling.shape[::-1]),
        "tile_overlap_mm": [
            n * float(points[1] - points[0])
            for n, points in zip(tiling.overlap[::-1], (x, y), strict=True)
        ],
    }
    said = [f"{tile['name']}: {text}" for tile in found for text in misread(tile)]
    if failed:
        attrs["tiles_failed"] = json.dumps(failed)
        said += _holes(tiling, failed)
    attrs["unusual"] = json.dumps([*json.loads(attrs.get("unusual", "[]")), *said])
    if wider:
        attrs["tiles_wider_margin"] = json.dumps(wider)
    maps.attrs |= attrs
    return StressResult(maps)


def _holes(tiling: Tiling, failed: Mapping[str, str]) -> list[str]:
    """Say where the maps have no value, and why."""
    said = []
    for tile in tiling.tiles:
        if tile.name in failed:
            x0, x1, y0, y1 = tiling.region(tile)
            said.append(
                f"{tile.name} (x {x0:g} to {x1:g}, y {y0:g} to {y1:g} mm) has no solution, and the "
                f"maps no value where no neighbour has one: {failed[tile.name]}"
            )
    return said
