"""A result to a file of whatever kind its name says."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

from optical_palpation.arguments import file_path
from optical_palpation.errors import InputError, OutputError
from optical_palpation.palpation.result import StressResult
from optical_palpation.present.deck import write_deck
from optical_palpation.present.matlab import write_mat
from optical_palpation.present.netcdf import write_result
from optical_palpation.present.output import SUFFIXES
from optical_palpation.present.panel import write_panel
from optical_palpation.present.profiles import write_profiles
from optical_palpation.present.tiff import write_tiff
from optical_palpation.present.vtk import write_vtk


def _deck(result: StressResult, path: Path) -> None:
    if result.problem is None:
        raise InputError(f"{path}: the algebraic method solves no problem that a deck could hold")
    write_deck(result.problem, path)


#: Writers by the kind of file, a key of ``SUFFIXES``.
WRITERS: Mapping[str, Callable[[StressResult, Path], None]] = {
    "result": write_result,
    "picture": write_panel,
    "ParaView file": write_vtk,
    "profiles": write_profiles,
    "deck": _deck,
    "MATLAB file": write_mat,
    "TIFF file": write_tiff,
}


def write(result: StressResult, path: str | os.PathLike[str]) -> None:
    """Write a result to a file of the kind that the ending of its name says.

    ``.nc`` is all of it; ``.png``, ``.pdf``, ``.svg`` the panel; ``.vts`` the deformed layer for
    ParaView; ``.csv`` the profiles through the centre; ``.inp`` the problem for Abaqus or
    CalculiX; ``.mat`` the maps for MATLAB and Octave; ``.tif`` the maps for ImageJ.

    Raises
    ------
    InputError
        If the result holds nothing of that kind, such as a layer of the algebraic method.
    OutputError
        If there is no such kind, or the file cannot be written.
    """
    path = file_path(path)
    for kind, writer in WRITERS.items():
        if path.suffix.lower() in SUFFIXES[kind]:
            writer(result, path)
            return
    endings = "; ".join(f"{', '.join(SUFFIXES[kind])} ({kind})" for kind in WRITERS)
    raise OutputError(f"{path}: the ending of the name says what to write: {endings}")
