"""Running a study: everything that its file asks for, in one folder that tells where it is from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import xarray as xr

from optical_palpation.errors import ConvergenceError, InputError, MaterialError
from optical_palpation.palpation.result import StressResult
from optical_palpation.study.compute import algebraic_of, thickness_of
from optical_palpation.study.inputs import (
    Unchanged,
    by_side,
    facts,
    open_input,
    parameters,
    read_sample,
    sample_input,
)
from optical_palpation.study.plausible import check_study, check_study_memory
from optical_palpation.study.record import Progress, check_folder, make_all
from optical_palpation.study.schema import MapInput, Study
from optical_palpation.study.stages import (
    STRESS,
    THICKNESS,
    Stages,
    warnings_about,
    warnings_about_thickness,
)
from optical_palpation.thickness import read_thickness_map


@dataclass(frozen=True)
class StudyResult:
    """Where the results of a study lie.

    Attributes
    ----------
    folder
        The result folder.
    files
        Names of the files in it, in the order in which they are made.
    earlier
        Those of them that an earlier run had made already.
    """

    folder: Path
    files: tuple[str, ...]
    earlier: tuple[str, ...]
    _stages: Stages = field(repr=False, compare=False)

    def stress(self) -> StressResult:
        """Return the stress as its file holds it, which is read only if it has not been already.

        Raises
        ------
        InputError
            If there is no such file, or it is damaged.
        """
        return self._stages.stress(self.folder / STRESS)

    def warnings(self) -> list[str]:
        """Say in plain words what casts doubt on the stress, or on the thickness if that is all."""
        if STRESS in self.files:
            return warnings_about(self.stress())
        thickness = xr.load_dataset(self.folder / THICKNESS, engine="h5netcdf")
        return warnings_about_thickness(thickness.attrs)


def describe_inputs(study: Study) -> str:
    """Read and check all inputs of a study, compute and write nothing, and say what they are.

    Raises
    ------
    InputError, MaterialError
        If an input cannot be used, numbers do not fit together, or memory does not suffice.
    OutputError
        If the result folder cannot be made, or holds something else.
    """
    check_folder(study.folder, study.file)
    said, inputs = [], {}
    for side, source in study.inputs.items():
        try:
            inputs[side] = facts(study, source)
            if isinstance(source, MapInput):
                read = read_thickness_map(
                    study.path(source.map), **source.model_dump(exclude={"map"})
                )
                said.append(f"{side} map of {' x '.join(map(str, read.shape))} pixels")
            else:
                with open_input(study, source) as volume:
                    said.append(f"{side} volume of {' x '.join(map(str, volume.shape))} samples")
        except InputError as error:
            raise InputError(f"{study.where(f'[{side}]')}: {error}") from error
    read_sample(study)
    check_study(study, inputs)
    check_study_memory(study, inputs)
    if not by_side(study):  # of maps alone the algebraic method costs nothing
        try:
            algebraic_of(study, thickness_of(study, {}))
        except (InputError, MaterialError) as error:
            raise type(error)(f"{study.where()}: {error}") from error
    return ", ".join(said)


def run_study(
    study: Study,
    *,
    thickness_only: bool = False,
    beside: Sequence[Path] = (),
    progress: Callable[[Any], None] | None = None,
) -> StudyResult:
    """Do everything that a study file asks for; go on where an earlier run was interrupted.

    A file of the result folder is made anew if it is not there or damaged, or if anything that it
    depends on has changed: an input file, a parameter, the part of the software that makes it. The
    record ``provenance.json`` tells all of these, and ``complete`` in it whether the folder is.

    Parameters
    ----------
    study
        As :func:`read_study` gives it.
    thickness_only
        Stop before the stress, to look at the boundaries first.
    beside
        Result folders of other studies. What they hold that would be the same here, such as the
        boundaries in the same volumes, is copied.
    progress
        Called now and then with an object that has ``stage`` (text), ``load`` (share that is
        done; of the load in the computational method), ``newton`` (iterations, or None) and
        ``message``.

    Raises
    ------
    InputError, MaterialError
        If an input cannot be used, or changes while it is worked on.
    ConvergenceError
        If the full load is not reached.
    OutputError
        If the result folder cannot be written, or holds something else, or another run works in it.
    """
    tell = progress or (lambda report: None)
    tell(Progress("reading the inputs", 0.0))
    unchanged = Unchanged(study)
    inputs = {}
    for side, source in study.inputs.items():
        try:
            inputs[side] = facts(study, source)
        except InputError as error:
            raise InputError(f"{study.where(f'[{side}]')}: {error}") from error
    read_sample(study)  # should a file be useless, that is better known before all the work
    about = {
        "study_sha256": study.sha256,
        "parameters": parameters(study),
        "inputs": inputs | sample_input(study),
    }
    unchanged()
    check_study(study, inputs)
    stages = Stages(study)
    plan = stages.plan(inputs)
    until = THICKNESS if thickness_only else None
    try:
        files, earlier = make_all(
            study.folder,
            study.file,
            about,
            plan,
            tell,
            until,
            check_inputs=unchanged,
            beside=beside,
        )
    except (InputError, ConvergenceError) as error:
        raise type(error)(f"{study.where()}: {error}") from error
    return StudyResult(study.folder, tuple(files), tuple(earlier), stages)
