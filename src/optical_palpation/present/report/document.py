"""From a result and what it came from to one HTML file."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import xarray as xr

from optical_palpation.analysis import Region
from optical_palpation.errors import InputError, OutputError
from optical_palpation.files import check_target, replacing
from optical_palpation.palpation.result import StressResult
from optical_palpation.present.output import provenance
from optical_palpation.present.report import content
from optical_palpation.present.report.bscans import draw_volume
from optical_palpation.present.summary import methods, of_unknown_sample, summarise
from optical_palpation.present.terms import percent
from optical_palpation.runtime import software_version

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

    from optical_palpation.volume import Volume

#: The script of the page; its files share one scope, so their order matters.
SCRIPTS = (
    "data.js",
    "plot.js",
    "maps.js",
    "stage.js",
    "bscans.js",
    "profiles.js",
    "download.js",
    "page.js",
)
_MARK = "WARNING: "
# Of a result, what it was computed with, for where no study tells that.
_GIVEN = (
    "input",
    "initial_thickness_input",
    "initial_thickness_mm",
    "method",
    "law",
    "c10_kPa",
    "c01_kPa",
    "c20_kPa",
    "c30_kPa",
    "bulk_to_shear",
    "window_contact",
    "sample_contact",
    "window_friction",
    "sample_friction",
    "edges",
    "element_size_mm",
    "elements",
    "imprint_smoothing_mm",
    "layer_extent_mm",
)
# Attributes of a result that the page shows as tables of their own.
_IN_TABLES = ("convergence", "inversion", "error_bands")


def write_report(
    path: str | Path,
    result: StressResult,
    *,
    loaded: xr.Dataset | None,
    unloaded: xr.Dataset | None,
    volumes: Mapping[str, Volume] | None,
    parameters: Mapping[str, object],
    python: str,
    title: str,
    warnings: Sequence[str],
    others: Mapping[str, StressResult] | None = None,
    regions: Sequence[Region] = (),
    result_file: str | None = None,
) -> None:
    """Write a study as one HTML file that needs neither server nor network.

    B-scans with the boundaries found, maps with a common cursor, profiles through it, forces,
    contact, convergence, warnings, parameters and the Python lines that give the same result.

    Parameters
    ----------
    path
        The file, ``.html`` or ``.htm``; it replaces an older one only when it is complete.
    result
        Stress by either method.
    loaded, unloaded
        What was found in each volume, on the pixels of that volume, as
        :func:`~optical_palpation.thickness.find_layer` gives it; or as
        :func:`~optical_palpation.thickness.clean_thickness` gives it, without depths and quality.
        Coordinates may have been shifted to register one to the other; pixels must not.
        None where there is nothing but the maps of the result.
    volumes
        Open volumes, ``"loaded"`` and ``"unloaded"``, either or both, to draw B-scans and
        maximum-intensity projections from. Each is read once, B-scan by B-scan. None for a study
        that starts from thickness maps.
    parameters
        Parameters of the study by name; a mapping within is shown as a section. Where there are
        none, what the result says that it was computed with.
    python
        Python lines that compute the same result.
    title
        Heading of the report.
    warnings
        What the reader must know, in plain words. Those of
        :func:`~optical_palpation.present.summarise` are added.
    others
        Other results by name, which are shown with their differences from this one.
    regions
        Regions of interest, for a table and outlines.
    result_file
        Name of the NetCDF file of the result beside the report, for a link to it.

    Raises
    ------
    InputError
        If a volume and the boundaries found in it do not have the same pixels; if another result
        or a region does not fit to this one.
    OutputError
        If the file cannot be written.
    """
    from jinja2 import Environment, PackageLoader
    from markupsafe import Markup

    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise OutputError(f"{path}: the report needs a name that ends in .html or .htm")
    check_target(path)
    layers = {"unloaded": unloaded, "loaded": loaded}
    scans, projections = {}, {}
    for state, volume in sorted((volumes or {}).items(), reverse=True):
        if state not in layers:
            raise InputError(f"volumes: {state!r} is neither 'loaded' nor 'unloaded'")
        scans[state], projections[state] = draw_volume(volume, layers[state], state)
    if result_file is not None and Path(result_file).name != result_file:
        raise InputError(f"result_file: the name of a file beside the report, not {result_file!r}")
    others = others or {}
    compared = content.comparisons(result, others)
    data = content.map_entries(result, loaded, unloaded, projections, compared, regions)
    headings, region_rows = content.region_rows(result, regions)
    data["convergence"] = content.convergence_rows(result)

    record = provenance(result.maps)
    given = {k: v for k, v in parameters.items() if k != "title"}
    given = given or {k: record[k] for k in _GIVEN if k in record}
    summary = summarise(result).splitlines()
    soft = of_unknown_sample(result.maps)
    cautions = [line.removeprefix(_MARK) for line in summary if line.startswith(_MARK)]
    environment = Environment(loader=PackageLoader(__package__, "templates"), autoescape=True)
    environment.filters |= {"whole": _whole, "percent": percent}
    script, style = (
        Markup("\n".join(_template(environment, name) for name in names))
        for names in (SCRIPTS, ["report.css"])
    )
    page = environment.get_template("report.html").stream(
        title=title,
        version=software_version(),
        script=script,
        script_hash=_hash(script),
        style=style,
        style_hash=_hash(style),
        data=_json(data),
        scans={state: _json(entry) for state, entry in scans.items()},
        both_thicknesses=unloaded is not None,
        quality=any(layer is not None and "quality" in layer for layer in layers.values()),
        warnings=[
            _sentence(line)
            for line in dict.fromkeys([*warnings, *cautions, *([soft] if soft else [])])
        ],
        figures=content.key_figures(result, loaded, unloaded),
        forces=content.force_rows(result),
        methods=list(methods(result)),
        uniform=content.uniform_maps(data["maps"], result),
        region_headings=headings,
        regions=region_rows,
        comparison=content.comparison_rows(result, others, compared),
        result_file=None if result_file is None else quote(result_file),
        stress=content.stress_rows(result),
        bands=content.band_rows(result),
        solutions=content.solution_rows(result),
        convergence=data["convergence"],
        parameters=content.parameter_sections(given),
        record=content.parameter_sections({k: v for k, v in record.items() if k not in _IN_TABLES}),
        python=python,
    )
    with replacing(path) as temporary, temporary.open("wb") as file:
        page.dump(file, encoding="utf-8", errors="replace")


def _template(environment: Environment, name: str) -> str:
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0].strip()


def _whole(text: str) -> str:
    """Text that breaks no line between a number, or its error, and its unit."""
    text = re.sub(r"(?<=[\d)]) (?=(?:mN|kPa|mm|um|\N{MICRO SIGN}m|%)(?!\w))", "\u00a0", text)
    return text.replace(" \N{PLUS-MINUS SIGN} ", " \N{PLUS-MINUS SIGN}\u00a0")


def _sentence(text: str) -> Markup:
    """Text that begins with a capital, and breaks no line within an option of the command."""
    from markupsafe import Markup, escape

    safe = str(escape(_whole(text[:1].upper() + text[1:])))
    return Markup(re.sub(r"--[a-z][a-z-]*", r'<span class="whole">\g<0></span>', safe))


def _hash(code: str) -> str:
    """Fingerprint by which the page's policy lets its own code run, and none that slips in."""
    return "sha256-" + base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()


def _json(data: object) -> Markup:
    """JSON that can stand in a script element: nothing in it can end the element."""
    from markupsafe import Markup

    return Markup(json.dumps(data, allow_nan=False).replace("<", "\\u003c"))
