"""The stages of a study: boundaries, thickness, stress by both methods, and what is made of it.

Every stage reads files and writes one. What comes from memory and what comes from an earlier run
is therefore the same to the last bit.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation import present
from optical_palpation.files import readable_name
from optical_palpation.palpation.result import StressResult
from optical_palpation.study.compute import algebraic_of, stress_of, thickness_of
from optical_palpation.study.inputs import (
    by_side,
    find_boundaries,
    finding,
    open_input,
    parameters,
    sample_facts,
    unused_errors,
)
from optical_palpation.study.record import Make, Progress, Stage, Tell
from optical_palpation.study.schema import MapInput, NumberInput, Study
from optical_palpation.study.script import reproducing_lines
from optical_palpation.thickness import write_thickness_map

THICKNESS, ALGEBRAIC, STRESS = "thickness.nc", "algebraic.nc", "stress.nc"
_NOTABLE_FILLED = 0.02
_NOTABLE_IMBALANCE = 0.01
# What makes the files: a change there makes them anew.
_HERE = ("study/stages.py", "study/compute.py", "study/inputs.py")
_FINDING = ("thickness", "volume", *_HERE)
_SOLVING = ("palpation", "present/netcdf.py", "present/output.py", *_HERE)
_SHOWING = ("present", *_HERE)


@dataclass(frozen=True)
class Stages:
    """Makers of the files of a study's result folder."""

    study: Study
    _kept: dict[tuple[Path, int, int], StressResult] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def stress(self, path: Path) -> StressResult:
        """Read the stress from its file, once for all who ask for it.

        Raises
        ------
        InputError
            If the file is not there or damaged.
        """
        about = path.stat() if path.is_file() else None
        key = (path, about.st_mtime_ns, about.st_size) if about else (path, 0, 0)
        if key not in self._kept:
            self._kept.clear()
            self._kept[key] = present.read_result(path)
        kept = self._kept[key]
        return replace(kept, maps=kept.maps.copy())

    def plan(self, inputs: Mapping[str, Mapping[str, Any]]) -> list[Stage]:
        """List the stages in the order in which they are made.

        Parameters
        ----------
        inputs
            Facts about the input files, by ``unloaded`` and ``loaded``.
        """
        study = self.study
        stages, found = [], []
        for side in by_side(study):
            found.append(f"boundaries-{side}.nc")
            stages.append(Stage(found[-1], inputs[side], (), self._boundaries(side), code=_FINDING))
            picture = f"boundaries-{side}.png"
            make = self._picture(side)
            stages.append(Stage(picture, inputs[side], found[-1:], make, code=_SHOWING))
        facts: dict[str, Any] = {
            "layer": study.layer.model_dump(mode="json"),
            "glued": study.friction.sample_glued,
        }
        facts |= {side: inputs[side] for side in inputs if side not in by_side(study)}
        if isinstance(study.unloaded, NumberInput):
            facts["unloaded"] = study.unloaded.thickness
        stages.append(Stage(THICKNESS, facts, found, self._thickness, code=_FINDING))
        tables = {
            name: getattr(study, name).model_dump(mode="json")
            for name in ("material", "friction", "grid", "errors")
        }
        for name in unused_errors(study):
            del tables["errors"][name]
        del tables["grid"]["threads"]  # which changes the stress in the ninth digit
        facts = {"material": tables["material"], "glued": study.friction.sample_glued}
        stages.append(Stage(ALGEBRAIC, facts, [THICKNESS], self._algebraic, code=_SOLVING))
        facts = tables | sample_facts(study)
        solving = ("stiffness", *_SOLVING) if study.sample.modelled else _SOLVING
        stages.append(Stage(STRESS, facts, [THICKNESS], self._computational, code=solving))
        everything = parameters(study)
        del everything["outputs"]
        everything["grid"].pop("threads", None)
        makers = {
            kind: Stage(name, {}, [STRESS], self._from_result(write), code=_SHOWING)
            for kind, name, write in (
                ("panel", "stress.png", present.write_panel),
                ("vtk", "layer.vts", present.write_vtk),
                ("profiles", "profiles.csv", present.write_profiles),
            )
        }
        needs = [*found, THICKNESS, STRESS]
        makers["report"] = Stage(
            "report.html", everything, needs, self._report, code=("study/script.py", *_SHOWING)
        )
        return stages + [makers[kind] for kind in makers if kind in study.outputs.write]

    def _boundaries(self, side: str) -> Make:
        source = by_side(self.study)[side]
        fixes = self.study.path(source.corrections) if source.corrections else None

        def make(path: Path, tell: Tell) -> None:
            def share(done: float) -> None:
                tell(Progress(f"boundaries of the {side} layer", done))

            share(0.0)
            with open_input(self.study, source) as volume:
                found = find_boundaries(volume, finding(source), fixes, share)
                write_thickness_map(found, path)

        return make

    def _picture(self, side: str) -> Make:
        def make(path: Path, tell: Tell) -> None:
            tell(Progress(f"picture of the {side} layer", 0.0))
            with open_input(self.study, by_side(self.study)[side]) as volume:
                found = xr.load_dataset(path.with_suffix(".nc"), engine="h5netcdf")
                present.write_boundaries_figure(found, volume, path)

        return make

    def _thickness(self, path: Path, tell: Tell) -> None:
        tell(Progress("thickness", 0.0))
        found = {
            side: xr.load_dataset(path.with_name(f"boundaries-{side}.nc"), engine="h5netcdf")
            for side in by_side(self.study)
        }
        write_thickness_map(thickness_of(self.study, found), path)

    def _algebraic(self, path: Path, tell: Tell) -> None:
        tell(Progress("algebraic stress", 0.0))
        thickness = xr.load_dataset(path.with_name(THICKNESS), engine="h5netcdf")
        present.write_result(algebraic_of(self.study, thickness), path)

    def _computational(self, path: Path, tell: Tell) -> None:
        thickness = xr.load_dataset(path.with_name(THICKNESS), engine="h5netcdf")
        present.write_result(stress_of(self.study, thickness, tell), path)

    def _from_result(self, write: Callable[[StressResult, Path], None]) -> Make:
        """Make a stage of a writer of results."""

        def make(path: Path, tell: Tell) -> None:
            tell(Progress(path.name, 0.0))
            write(self.stress(path.with_name(STRESS)), path)

        return make

    def _report(self, path: Path, tell: Tell) -> None:
        from optical_palpation.present.report import write_report

        tell(Progress("report", 0.0))
        thickness = xr.load_dataset(path.with_name(THICKNESS), engine="h5netcdf")
        layers: dict[str, xr.Dataset | None] = {"loaded": None, "unloaded": None}
        for side, name in (("loaded", "loaded"), ("unloaded", "initial")):
            if isinstance(self.study.inputs.get(side), MapInput):
                filled = "filled" if side == "loaded" else "initial_filled"
                layers[side] = xr.Dataset(
                    {"thickness": thickness[f"{name}_thickness"], "filled": thickness[filled]}
                )
        result = self.stress(path.with_name(STRESS))
        with ExitStack() as opened:
            volumes = {}
            for side, source in by_side(self.study).items():
                volumes[side] = opened.enter_context(open_input(self.study, source))
                found = path.with_name(f"boundaries-{side}.nc")
                layers[side] = xr.load_dataset(found, engine="h5netcdf")
            write_report(
                path,
                result,
                loaded=layers["loaded"],
                unloaded=layers["unloaded"],
                volumes=volumes or None,
                parameters=parameters(self.study),
                python=reproducing_lines(self.study),
                title=self.study.title or Path(readable_name(self.study.file)).stem,
                warnings=warnings_about(result),
                result_file=STRESS,
            )


def warnings_about(result: StressResult) -> list[str]:
    """Say in plain words what casts doubt on a result."""
    attrs = result.maps.attrs
    said = [
        *present.of_solution(attrs),
        *json.loads(attrs.get("unusual", "[]")),
        *warnings_about_thickness(attrs),
        *present.of_sides(attrs),
    ]
    if (imbalance := attrs.get("force_balance", 0.0)) > _NOTABLE_IMBALANCE:
        said.append(
            f"the forces at window and sample differ by {present.percent(imbalance)}: the solution "
            "is not in equilibrium"
        )
    return said


def warnings_about_thickness(attrs: Mapping[Any, Any]) -> list[str]:
    """Say in plain words what casts doubt on the thickness, by the attributes of its maps."""
    said = []
    for of, which in (("", "loaded"), ("initial_", "unloaded")):
        if (share := attrs.get(f"{of}filled_share", 0.0)) > _NOTABLE_FILLED:
            said.append(
                f"{present.percent(share)} of the {which} thickness could not be measured and was "
                "interpolated: look at the boundaries before you trust what is computed there"
            )
        if (share := attrs.get(f"{of}specular_share", 0.0)) > 0:
            said.append(
                f"{present.percent(share)} of the {which} volume is outshone by reflections, which "
                "may draw the boundary to themselves: look at the pixels marked as specular in "
                f"boundaries-{which}.nc"
            )
        said += [f"{which} volume: {text}" for text in json.loads(attrs.get(f"{of}doubts", "[]"))]
    if "registration_shift_mm" in attrs:
        y, x = np.ravel(attrs["registration_shift_mm"])
        said.append(
            f"the unloaded map lay {x:+.3g} mm in x and {y:+.3g} mm in y off the loaded one and "
            "was shifted back by that"
        )
    return said
