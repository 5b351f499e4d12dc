"""From a result and what it came from to one HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import xarray as xr

from optical_palpation.palpation.result import StressResult

if TYPE_CHECKING:
    from optical_palpation.volume import Volume


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
        None where there is nothing but the maps of the result.
    volumes
        Open volumes, ``"loaded"`` and ``"unloaded"``, either or both, to draw B-scans and
        maximum-intensity projections from. Each is read once, B-scan by B-scan. None for a study
        that starts from thickness maps.
    parameters
        Parameters of the study by name; a mapping within is shown as a section.
    python
        Python lines that compute the same result.
    title
        Heading of the report.
    warnings
        What the reader must know, in plain words. Those of
        :func:`~optical_palpation.present.summarise` are added.

    Raises
    ------
    InputError
        If a volume and the boundaries found in it do not have the same pixels.
    OutputError
        If the file cannot be written.
    """
    raise NotImplementedError
