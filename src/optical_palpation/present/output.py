"""The kinds of output files, and what every one of them records."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.errors import IncompleteOutputError, OutputError
from optical_palpation.files import check_target, replacing
from optical_palpation.runtime import software_version

SUFFIXES = {
    "result": (".nc", ".nc4", ".h5"),
    "picture": (".png", ".pdf", ".svg"),
    "ParaView file": (".vts",),
    "profiles": (".csv",),
    "deck": (".inp",),
    "MATLAB file": (".mat",),
    "TIFF file": (".tif", ".tiff"),
    "table": (".csv",),
    "report": (".html", ".htm"),
    "record": (".json",),
    "calibration": (".nc", ".nc4", ".h5"),
}


def check_writable(path: str | Path, kind: str) -> Path:
    """Raise :class:`OutputError` now if a file of this kind could not be written there later.

    Parameters
    ----------
    path
        The intended file.
    kind
        A key of ``SUFFIXES``; the name must end as files of that kind do, because the programs
        that open them go by the ending.

    Raises
    ------
    OutputError
        Wrong ending, or as :func:`~optical_palpation.files.check_target`.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES[kind]:
        endings = " or ".join(SUFFIXES[kind])
        raise OutputError(f"{path}: the {kind} needs a name that ends in {endings}")
    check_target(path)
    return path


def check_outputs(outputs: Mapping[str, Path], inputs: Sequence[Path] = ()) -> None:
    """Raise :class:`OutputError` now if the files could not all be written later.

    Parameters
    ----------
    outputs
        Intended files by kind, a key of ``SUFFIXES``.
    inputs
        Files that must not be overwritten.

    Raises
    ------
    OutputError
        As :func:`check_writable`; or the same file is given twice.
    """
    taken = {path.resolve() for path in inputs}
    for kind, path in outputs.items():
        check_writable(path, kind)
        if path.resolve() in taken:
            raise OutputError(f"{path}: is also an input or another output; choose another name")
        taken.add(path.resolve())


def write_each(writers: Mapping[Path, Callable[[Path], object]]) -> None:
    """Write several files; one that cannot be written keeps none of the others back.

    Parameters
    ----------
    writers
        What writes a file, by its path.

    Raises
    ------
    IncompleteOutputError
        With what was written and what was not.
    OutputError
        If nothing was written.
    """
    written, failures = [], []
    for path, write in writers.items():
        try:
            write(path)
            written.append(str(path))
        except OutputError as error:
            failures.append(error)
    if failures and not written:
        raise failures[0]
    if failures:
        raise IncompleteOutputError(
            f"{'; '.join(map(str, failures))}. Written: {', '.join(written)}"
        )


@contextmanager
def atomic(path: str | Path, kind: str) -> Iterator[Path]:
    """Give a temporary path beside the target, which replaces the target if all goes well.

    Raises
    ------
    OutputError
        The target cannot be written; it is then as it was before.
    """
    with replacing(check_writable(path, kind)) as temporary:
        yield temporary


def provenance(maps: xr.Dataset) -> dict[str, Any]:
    """Return the attributes that every written file carries, in types that every format takes.

    The software and its version, axis order, origin and spacing of the maps in mm, and all
    attributes of the result (parameters, forces, convergence record, input hash). Values are
    text, numbers or lists of numbers.
    """
    x, y = maps["x"].values, maps["y"].values
    attributes: dict[str, Any] = {
        "software": "optical-palpation",
        "software_version": software_version(),
        "axis_order": "maps (y, x), volumes (z, y, x); z = 0 at the window, towards the sample",
        "stress_sign": "Cauchy stress, tension positive; contact_pressure compression positive",
        "origin_x_mm": float(x[0]),
        "origin_y_mm": float(y[0]),
        "spacing_x_mm": float((x[-1] - x[0]) / max(x.size - 1, 1)),
        "spacing_y_mm": float((y[-1] - y[0]) / max(y.size - 1, 1)),
    }
    origin = {k: v for k, v in maps["loaded_thickness"].attrs.items() if k.startswith("source")}
    for name, value in (origin | maps.attrs).items():
        # File name, hash, variable and unit of the map. In a NetCDF file "source" means otherwise.
        name = name.replace("source", "input") if name.startswith("source") else name
        attributes[name] = _plain(value)
    return attributes


def _plain(value: Any) -> Any:
    """Return text, a number or a list of numbers; anything else as JSON text."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, str | int | float):
        return value
    if isinstance(value, list | tuple) and value and all(type(v) in (int, float) for v in value):
        return list(value)
    return json.dumps(value, default=_as_list)


def _as_list(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)
