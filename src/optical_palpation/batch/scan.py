"""One scan of a batch, as a worker runs it: a study, and the row that it adds to the table."""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.batch.dispatch import Outcome
from optical_palpation.batch.reading import ERROR, Scan
from optical_palpation.errors import FolderBusyError, InputError, OpticalPalpationError
from optical_palpation.files import seen_from

if TYPE_CHECKING:
    from optical_palpation.palpation import StressResult

#: Pixels along the longer side of a thumbnail.
_THUMBNAIL = 96
_BUSY = 60.0  # s
#: Elements that a wanted accuracy takes, as a fraction of the first that are tried.
_FINER = 0.5
RESULT, RECORD = "stress.nc", "provenance.json"


def run_scan(
    folder: Path,
    alike: Mapping[str, Sequence[str]],
    scan: Scan,
    threads: int | None,
    tell: Callable[[Any], None],
) -> Outcome:
    """Run the study of a scan and read its row; what fails is told and not raised.

    Parameters
    ----------
    folder
        Folder of the batch.
    alike
        By the name of a scan, those of the others with the same inputs. What does not depend on how
        they differ is made once.
    scan
        The scan.
    threads
        Number of threads; all by default.
    tell
        Called with reports of progress. An exception that it raises and that derives from
        ``BaseException`` alone ends the scan.
    """
    from optical_palpation.palpation.threads import limited_threads
    from optical_palpation.study import Progress, read_study, run_study

    started = time.monotonic()
    target = folder / scan.name
    errors = folder / f"{scan.name}{ERROR}"
    try:
        study = read_study(scan.study, _changes(folder, scan))
        beside = [folder / name for name in alike[scan.name]]
        with limited_threads(threads):
            while True:
                try:
                    done = run_study(study, beside=beside, progress=tell)
                    break
                except FolderBusyError:
                    # A worker that was given up may not have noticed yet that nobody waits for it.
                    if time.monotonic() > started + _BUSY:
                        raise
                    tell(Progress("waiting for an earlier run to leave the folder", 0.0))
                    time.sleep(0.5)
        row, thumbnail = _row(done.stress(), target, scan)
    except OpticalPalpationError as error:
        message, details, kind = str(error), str(error), type(error).__name__
    except Exception as error:
        kind = type(error).__name__
        message, details = f"{kind}: {error}", traceback.format_exc()
    else:
        errors.unlink(missing_ok=True)
        earlier = set(done.files) == set(done.earlier)
        status = "earlier" if earlier else "done"
        seconds = time.monotonic() - started
        return Outcome(scan.name, status, "", "", row, thumbnail, seconds)
    with suppress(OSError):  # the table says it as well
        errors.write_text(details + "\n", encoding="utf-8")
    return Outcome(scan.name, "failed", message, kind, seconds=time.monotonic() - started)


def earlier_outcome(folder: Path, scan: Scan) -> Outcome | None:
    """What became of a scan in an earlier run, if its study is the same; else None.

    Whether the files that it starts from are the same, only a run finds out.

    Parameters
    ----------
    folder
        Folder of the batch.
    scan
        The scan.
    """
    from optical_palpation.present import read_result
    from optical_palpation.study import read_study

    target = folder / scan.name
    try:
        with suppress(FileNotFoundError):
            said = (folder / f"{scan.name}{ERROR}").read_text(encoding="utf-8").strip()
            return Outcome(scan.name, "failed", said)
        record = json.loads((target / RECORD).read_text(encoding="utf-8"))
        asked = read_study(scan.study, _changes(folder, scan))
        if not record["complete"] or record["study_sha256"] != asked.sha256:
            return None
        row, thumbnail = _row(read_result(target / RESULT), target, scan)
    except (OSError, ValueError, KeyError, TypeError, OpticalPalpationError):  # none, or broken
        return None
    return Outcome(scan.name, "earlier", "", "", row, thumbnail)


def _changes(folder: Path, scan: Scan) -> dict[str, Any]:
    """What a scan changes in its study, and where its results go."""
    return {**scan.overrides, "outputs.folder": seen_from(scan.study.parent, folder / scan.name)}


def predicted_need(scan: Scan) -> float | None:
    """Memory of a scan's computation, bytes, from its study alone; None if that cannot be read.

    The thickness of the layer is not known before it was found in the volumes: half of their depth
    stands for it. Neither are the elements of a wanted accuracy: some finer than the first do.
    """
    from optical_palpation.mechanics.stack.assembly import Mesh, count_elements
    from optical_palpation.palpation.accuracy import first_size
    from optical_palpation.palpation.memory import predicted_memory, predicted_stack_memory
    from optical_palpation.study import read_study
    from optical_palpation.study.inputs import open_input
    from optical_palpation.study.plausible import even_blocks
    from optical_palpation.study.schema import MapInput, NumberInput
    from optical_palpation.thickness import read_thickness_map

    try:
        study = read_study(scan.study, scan.overrides)
        source, extent = study.loaded, study.layer.extent
        volume = 0.0
        if isinstance(source, MapInput):
            loaded = read_thickness_map(
                study.path(source.map), layer_extent=extent, **source.model_dump(exclude={"map"})
            )
            width, depth = (float(np.ptp(loaded[axis].values)) for axis in "xy")
            thickness = float(loaded.max())
        else:
            with open_input(study, source) as opened:
                nz, ny, nx = opened.shape
                dz, dy, dx = opened.metadata.spacing
            width, depth, thickness = nx * dx, ny * dy, 0.5 * nz * dz
            volume = 8.0 * nz * ny * nx
        if isinstance(study.unloaded, NumberInput):
            thickness = study.unloaded.thickness
        if extent is not None:
            width, depth = extent[1] - extent[0], extent[3] - extent[2]
        size = study.grid.element_size
        if study.sample.modelled and isinstance(size, float):
            blocks = even_blocks(study, (0.0, width, 0.0, depth), thickness)
            elements = count_elements(blocks, Mesh(size))
            return volume + predicted_stack_memory(elements)
        if size is None:
            size = _FINER * first_size(thickness, (width, depth))
        hx, hy, hz = size if isinstance(size, tuple) else (size, size, size)
        beyond = 6.0 * thickness if study.grid.edges == "padded" else 0.0
        through = max(2, round(thickness / hz))
        refined = 2 * through if study.grid.edges == "free" else 0
        across = [
            int(np.ceil((length + beyond) / h)) + refined
            for length, h in ((depth, hy), (width, hx))
        ]
        solver = "direct" if study.grid.solver == "direct" else "multigrid"
        return volume + predicted_memory((through, across[0], across[1]), solver)
    except Exception:  # the scan itself tells what is wrong, and the others go on
        return None


def _row(
    result: StressResult, folder: Path, scan: Scan
) -> tuple[dict[str, Any], NDArray[np.float32]]:
    """Entries of the table, units in the names of the columns, and the thumbnail."""
    from optical_palpation.analysis.maps import on_layer
    from optical_palpation.present.tables import result_columns
    from optical_palpation.study import warnings_about

    record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    row: dict[str, Any] = result_columns(result)
    warnings = warnings_about(result)
    if scan.regions is not None:
        try:
            row |= _regions(result.maps, scan.regions)
        except InputError as error:  # no reason to do without all else
            warnings = [*warnings, f"no regions: {error}"]
    row["seconds"] = round(sum(entry["seconds"] for entry in record["stages"].values()), 2)
    row["warnings"] = "; ".join(warnings)
    row["software_version"] = record["software_version"]
    row["study"] = str(scan.study)
    row["study_sha256"] = record["study_sha256"]
    for side, entry in record["inputs"].items():
        row[f"{side}_sha256"] = entry["sha256"]
    row["stress_sha256"] = record["stages"][RESULT]["sha256"]
    return row, _thumbnail(on_layer(result.maps)["axial_stress"])


def _regions(maps: xr.Dataset, path: Path) -> dict[str, float]:
    """Mean, spread, force, area and what is missing in each region, on columns of its name."""
    from optical_palpation.analysis import read_regions, region_statistics

    found = region_statistics(maps, read_regions(path, maps))
    columns = {
        "mean": "mean_kPa",
        "standard_deviation": "standard_deviation_kPa",
        "force": "force_mN",
        "area": "area_mm2",
        "missing": "missing",
    }
    return {
        f"{region}.{column}": float(found[key].sel(region=region))
        for region in found["region"].values
        for key, column in columns.items()
    }


def _thumbnail(stress: xr.DataArray) -> NDArray[np.float32]:
    values = stress.transpose("y", "x").values
    step = max(1, -(-max(values.shape) // _THUMBNAIL))
    return values[::step, ::step].astype(np.float32)
