"""The index of a batch: a page with a thumbnail of every scan, that sorts, filters and links."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from optical_palpation.batch.dispatch import Outcome
from optical_palpation.batch.reading import CSV, ERROR, INDEX, PARQUET, Batch
from optical_palpation.files import replacing
from optical_palpation.present.terms import percent, rounded
from optical_palpation.runtime import software_version

_COLOURS = "viridis_r"
#: Columns of the page besides what differs between the scans; the tables have all.
_COLUMNS = {
    "window_force_mN": "window force (mN)",
    "mean_axial_stress_kPa": "mean axial stress (kPa)",
    "first_percentile_axial_stress_kPa": "99 % of the map above (kPa)",
    "algebraic_mean_axial_stress_kPa": "mean, algebraic (kPa)",
    "mean_loaded_thickness_mm": "mean thickness (mm)",
    "in_contact_fraction": "in contact",
    "interpolated_fraction": "interpolated",
    "median_sample_youngs_modulus_kPa": "modulus of the sample, median (kPa)",
    "seconds": "time (s)",
}
#: Those of them that are there only with a sample in the model.
_OF_SAMPLE = ("median_sample_youngs_modulus_kPa",)
_PERCENT = ("in_contact_fraction", "interpolated_fraction")
#: What the error of a column is called.
_ERRORS = {
    "window_force_mN": "force_error_mN",
    "mean_axial_stress_kPa": "mean_axial_stress_error_kPa",
}


def write_index(batch: Batch, outcomes: Sequence[Outcome]) -> Path:
    """Write ``index.html``: thumbnails on one colour scale, numbers, warnings, links to each scan.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    from jinja2 import Environment, PackageLoader

    found = {outcome.name: outcome for outcome in outcomes}
    maps = [outcome.thumbnail for outcome in outcomes if outcome.thumbnail is not None]
    finite = np.concatenate([m[np.isfinite(m)] for m in maps] or [np.zeros(1, np.float32)])
    low, high = (float(v) for v in np.percentile(finite if finite.size else [0.0], [1, 99]))
    settings = list(dict.fromkeys(key for scan in batch.scans for key in scan.overrides))
    with_sample = any(key in outcome.row for outcome in outcomes for key in _OF_SAMPLE)
    columns = {k: v for k, v in _COLUMNS.items() if with_sample or k not in _OF_SAMPLE}
    rows = []
    for scan in batch.scans:
        outcome = found.get(scan.name)
        row = outcome.row if outcome else {}
        status = "not run" if outcome is None else outcome.status
        picture = outcome.thumbnail if outcome else None
        rows.append(
            {
                "name": scan.title or scan.name,
                "status": "done" if status == "earlier" else status,
                "message": outcome.message if outcome else "",
                "warnings": row.get("warnings", ""),
                "settings": [_shown(scan.overrides.get(key)) for key in settings],
                "numbers": [_number(key, row) for key in columns],
                "picture": None if picture is None else _picture(picture, low, high),
                "link": _link(batch.folder, scan.name, status),
            }
        )
    page = (
        Environment(loader=PackageLoader("optical_palpation.batch"), autoescape=True)
        .get_template("index.html")
        .render(
            title=batch.source.name,
            version=software_version(),
            rows=rows,
            settings=settings,
            columns=list(columns.values()),
            low=rounded(low),
            high=rounded(high),
            scale=_picture(np.linspace(low, high, 128, dtype=np.float32)[None], low, high),
            counts={
                status: sum(row["status"] == status for row in rows)
                for status in ("done", "failed", "not run")
            },
            tables=[name for name in (CSV, PARQUET) if (batch.folder / name).is_file()],
        )
    )
    path = batch.folder / INDEX
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path


def _link(folder: Path, name: str, status: str) -> str:
    """The report of a scan, or what there is of it; of one that failed, why."""
    there = [f"{name}/report.html", f"{name}/stress.png", f"{name}/"]
    if status == "failed":  # what lies in its folder is of before
        there = [f"{name}{ERROR}"]
    return next((quote(file) for file in there if (folder / file).exists()), "")


def _shown(value: Any) -> dict[str, Any]:
    if value is None:
        return {"text": "", "sort": ""}
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return {"text": f"{value:g}" if number else str(value), "sort": value}


def _number(key: str, row: Mapping[str, Any]) -> dict[str, Any]:
    value = row.get(key)
    if value is None:
        return {"text": "", "sort": ""}
    if key in _PERCENT:
        return {"text": percent(value), "sort": value}
    return {"text": rounded(value, row.get(_ERRORS.get(key, "")), digits=4), "sort": value}


def _picture(values: NDArray[np.float32], low: float, high: float) -> str:
    """A map as PNG in a data URI; x to the right, y upwards; nothing where there is no value."""
    import matplotlib
    from PIL import Image

    scaled = (values - low) / max(high - low, 1e-12)
    colours = matplotlib.colormaps[_COLOURS](np.clip(np.nan_to_num(scaled), 0, 1), bytes=True)
    colours[~np.isfinite(values)] = 0
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(colours[::-1])).save(stream, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
