"""Watching a folder: each volume or map that arrives there gets its stress.

The study says everything but the loaded layer. What does not depend on that is made once: kernels
are loaded, the unloaded layer is found, before the first file arrives.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
import tomllib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from filelock import FileLock, Timeout

from optical_palpation import present
from optical_palpation.errors import InputError, OpticalPalpationError, OutputError
from optical_palpation.files import readable_name, replacing
from optical_palpation.palpation import InputErrors, computational_stress
from optical_palpation.palpation.result import StressResult
from optical_palpation.palpation.threads import available_threads
from optical_palpation.present.tables import result_columns
from optical_palpation.runtime import software_version
from optical_palpation.study.compute import algebraic_of, stress_of, thickness_of
from optical_palpation.study.inputs import (
    Unchanged,
    described,
    file_state,
    find_boundaries,
    finding,
    open_input,
    sample_facts,
)
from optical_palpation.study.plausible import check_study
from optical_palpation.study.reading import read_study
from optical_palpation.study.record import Progress, sha256
from optical_palpation.study.schema import MapInput, Study, VolumeInput
from optical_palpation.study.stages import warnings_about
from optical_palpation.thickness import thickness_map
from optical_palpation.volume.opening import MAP_READERS, READERS, is_known

#: The table, in the result folder.
TABLE = "arrived.csv"
_LOCK = ".lock"
_PATIENCE = 30.0
"""Seconds within which another watch has written the table."""


@dataclass(frozen=True)
class Arrival:
    """What became of a file that arrived.

    Attributes
    ----------
    file
        Its name in the folder.
    status
        ``done``, ``earlier`` (the table has it from an earlier watch) or ``failed``.
    message
        Why it failed.
    row
        Its entries in the table, by column.
    seconds
        From the moment it was found complete to the written result.
    """

    file: str
    status: str
    message: str = ""
    row: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0


class Watch:
    """Computes the stress of files as they arrive in a folder.

    Parameters
    ----------
    study
        Study file; its loaded layer, a volume or a map, is replaced by the files that arrive and
        need not be there.
    folder
        The folder to watch.
    output
        Where results and the table go; by default ``FOLDER-stress`` beside the folder.
    pattern
        Names of the files that count, as a shell would write it, ``*.oct``.
    settle
        Seconds for which a file must not change before it counts as complete.
    estimates
        Whether to estimate the errors by the mesh, the sides and the inputs, as ``run`` does, which
        takes longer than the stress of a small grid itself.
    threads
        Number of threads; as the study says by default.

    Raises
    ------
    InputError
        If the study or the folder cannot be used.
    OutputError
        If the result folder cannot be made, or is the watched one.
    """

    def __init__(
        self,
        study: str | Path,
        folder: str | Path,
        output: str | Path | None = None,
        *,
        pattern: str = "*",
        settle: float = 1.0,
        estimates: bool = False,
        threads: int | None = None,
    ) -> None:
        self._file, self._folder = Path(study), Path(folder)
        if not os.path.isdir(self._folder):
            raise InputError(f"{folder}: there is no such folder to watch")
        beside = self._folder.resolve()
        self.output = Path(output) if output else beside.with_name(f"{beside.name}-stress")
        if self.output.resolve() == beside:
            raise OutputError(f"{output}: is the watched folder; results would arrive in it")
        try:
            self.output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{self.output}: cannot be made ({error.strerror})") from error
        self._settle, self._pattern, self._estimates = settle, pattern, estimates
        self._changes: dict[str, Any] = {} if threads is None else {"grid.threads": threads}
        self._file_state = file_state(self._file)
        # until a file arrives, the study file stands for it
        self._study = read_study(self._file, self._changes | self._loaded(self._file))
        self._unloaded: xr.Dataset | None = None
        self._unloaded_facts: dict[str, Any] = {}
        self._unloaded_state: object = None
        self._seen: dict[Path, tuple[object, float]] = {}
        self._handled: dict[Path, object] = {}
        self._rows: dict[str, dict[str, Any]] = self._read_table()

    def prepare(self, progress: Callable[[Any], None] | None = None) -> None:
        """Find the unloaded layer, and load or compile the kernels.

        Raises
        ------
        InputError, MaterialError
            If the unloaded layer or the material cannot be used.
        """
        study, source = self._study, self._study.unloaded
        if isinstance(source, VolumeInput):
            self._unloaded_state = file_state(study.path(source.volume))
            fixes = study.path(source.corrections) if source.corrections else None

            def tell(share: float) -> None:
                if progress:
                    progress(Progress("boundaries of the unloaded layer", share))

            with open_input(study, source) as volume:
                self._unloaded_facts = {"sha256": volume.sha256, "metadata": described(volume)}
                self._unloaded = find_boundaries(volume, finding(source), fixes, tell)
        self.warm_up(progress)

    def warm_up(self, progress: Callable[[Any], None] | None = None) -> None:
        """Load or compile the kernels, on a small layer."""
        study = self._study
        size = study.grid.element_size or 0.1
        x, y, z = size if isinstance(size, tuple) else (size, size, size)
        at = np.linspace(0, 1, 33)
        bump = 1.0 - 0.1 * np.exp(-((at - 0.5) ** 2 + (at[:, None] - 0.5) ** 2) / 0.05)
        depth = 4 * z
        small = thickness_map(0.95 * depth * bump, field_of_view=(12 * x, 12 * y))
        with suppress(OpticalPalpationError):  # a trial: what is wrong, the first file tells
            computational_stress(
                small, depth, study.material.make(), window_friction=study.friction.window,
                sample_friction=study.friction.sample, element_size=(x, y, z),
                edges=study.grid.edges, threads=study.grid.threads, progress=progress,
                mesh_check=self._estimates, edge_check=self._estimates,
                input_errors=InputErrors() if self._estimates else None,
            )  # fmt: skip

    def arrived(self) -> list[Path]:
        """Files that are complete and have not been worked on as they are, oldest first."""
        now = time.monotonic()
        try:
            there = [path for path in self._folder.iterdir() if not path.name.startswith(".")]
        except OSError as error:
            raise InputError(f"{self._folder}: cannot be read ({error.strerror})") from error
        complete = []
        own = {self.output.resolve(), self._file.resolve()}
        for path in there:
            if not path.match(self._pattern):
                continue
            state = file_state(path)
            if not state or self._handled.get(path) == state or path.resolve() in own:
                continue
            before = self._seen.get(path)
            if before is None or before[0] != state:
                self._seen[path] = state, now
            elif now >= before[1] + self._settle and self._recognised(path):
                complete.append((max(changed for *_, changed in state), path))
        return [path for _, path in sorted(complete)]

    def take(self, path: Path) -> None:
        """Count a file as worked on as it is now."""
        self._handled[path] = file_state(path)

    def give_up(self, path: Path, why: str) -> Arrival:
        """Write to the table why a file was not solved."""
        row = {"file": readable_name(path)} | self._failed(path, why)
        self._write_table(row)
        return Arrival(row["file"], "failed", why, row)

    def _failed(self, path: Path, why: str) -> dict[str, str]:
        """Entries of the table for a file without a result; one of an earlier time is removed."""
        self._result(path).unlink(missing_ok=True)
        return {"status": "failed", "message": why}

    def share_cores(self, workers: int) -> None:
        """Use a part of the cores, unless the study or the caller says how many threads."""
        if self._study.grid.threads is None:
            self._changes |= {"grid.threads": max(1, available_threads() // workers)}

    def solve(self, path: Path, progress: Callable[[Any], None] | None = None) -> Arrival:
        """Compute the stress of a file that has arrived, write it, and add it to the table.

        What is wrong with the file is told and not raised.

        Raises
        ------
        OutputError
            If the result or the table cannot be written.
        """
        started = time.monotonic()
        self.take(path)
        row: dict[str, Any] = {"file": readable_name(path)}
        try:
            if file_state(self._file) != self._file_state:
                raise InputError(f"{self._file} has changed: start the watch again")
            study = read_study(self._file, self._changes | self._loaded(path))
            unchanged = Unchanged(study)
            self._check_unloaded(study)
            row |= {"sha256": _sha256(path, study), "basis_sha256": self._basis(study)}
            row["software_version"] = software_version()
            known = self._rows.get(row["file"], {})
            same = all(str(known.get(key)) == value for key, value in row.items())
            if same and known["status"] == "done" and self._result(path).is_file():
                return Arrival(row["file"], "earlier", row=known)
            result = self._stress(study, progress)
            unchanged()
            present.write_result(result, self._result(path))
            row |= {"status": "done", "message": "", **result_columns(result)}
            row["warnings"] = "; ".join(warnings_about(result))
        except OutputError:
            raise
        except OpticalPalpationError as error:
            message = str(error).replace(f"{self._file}: ", "").replace(f"{self._file}, ", "")
            row |= self._failed(path, message)
        seconds = time.monotonic() - started
        row |= {
            "seconds": round(seconds, 3),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        self._write_table(row)
        return Arrival(row["file"], row["status"], row["message"], row, seconds)

    def _basis(self, study: Study) -> str:
        """Hash of all that a result depends on, but for the file that has arrived; hex."""
        exclude: Any = {
            "title": True,
            "outputs": True,
            "loaded": {"map", "volume"},
            "unloaded": {"map", "volume", "corrections"},
            "grid": {"threads"},  # which changes the stress in the ninth digit
        }
        used = study.model_dump(mode="json", exclude=exclude)
        files = dict(sample_facts(study))
        if isinstance(study.unloaded, MapInput):
            files["unloaded"] = sha256(study.path(study.unloaded.map))
        elif isinstance(study.unloaded, VolumeInput):
            fixes = study.unloaded.corrections
            files["unloaded"] = self._unloaded_facts["sha256"]
            files["corrections"] = sha256(study.path(fixes)) if fixes else None
        text = json.dumps([used, files, self._estimates], sort_keys=True)
        return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()

    def _stress(self, study: Study, progress: Callable[[Any], None] | None) -> StressResult:
        found, inputs = {}, {}
        if self._unloaded is not None:
            found["unloaded"], inputs["unloaded"] = self._unloaded, self._unloaded_facts
        if isinstance(study.loaded, VolumeInput):
            with open_input(study, study.loaded) as volume:
                inputs["loaded"] = {"metadata": described(volume)}
                found["loaded"] = find_boundaries(volume, finding(study.loaded))
        check_study(study, inputs)
        thickness = thickness_of(study, found)
        algebraic_of(study, thickness)  # refuses what no layer can take
        return stress_of(study, thickness, progress, estimates=self._estimates)

    def _check_unloaded(self, study: Study) -> None:
        source = study.unloaded
        if isinstance(source, VolumeInput):
            if self._unloaded is None:
                self.prepare()
            path = study.path(source.volume)
            if file_state(path) != self._unloaded_state:
                raise InputError(f"{path} has changed: start the watch again")

    def _loaded(self, path: Path) -> dict[str, Any]:
        """Changes that put a file in place of the loaded layer of the study."""
        try:
            given = tomllib.loads(self._file.read_text(encoding="utf-8-sig")).get("loaded", {})
        except (OSError, ValueError):
            return {}  # read_study tells what is wrong with the file
        key = "map" if "map" in given else "volume"
        # corrections belong to the volume that they were made for
        return {f"loaded.{key}": str(path.resolve()), "loaded.corrections": None}

    def _recognised(self, path: Path) -> bool:
        readers = MAP_READERS if isinstance(self._study.loaded, MapInput) else READERS
        return is_known(path, readers)

    def _result(self, path: Path) -> Path:
        return self.output / f"{readable_name(path)}.stress.nc"

    def _read_table(self) -> dict[str, dict[str, Any]]:
        try:
            table = pd.read_csv(self.output / TABLE, dtype=str, keep_default_na=False)
            return {str(row["file"]): row for row in table.to_dict("records")}  # type: ignore[misc]
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, KeyError) as error:
            raise OutputError(
                f"{self.output / TABLE}: is no table of an earlier watch ({error}); choose another "
                "--output"
            ) from error

    def _write_table(self, row: dict[str, Any]) -> None:
        """Add a row to the table, to which another watch may have added others."""
        try:
            with FileLock(self.output / _LOCK, timeout=_PATIENCE):
                self._rows = {**self._read_table(), row["file"]: row}
                with replacing(self.output / TABLE) as temporary:
                    pd.DataFrame(list(self._rows.values())).to_csv(temporary, index=False)
        except Timeout:
            raise OutputError(f"{self.output / TABLE}: another process holds it") from None


def _sha256(path: Path, study: Study) -> str:
    if os.path.isdir(path):
        assert isinstance(study.loaded, VolumeInput)  # maps are files
        with open_input(study, study.loaded) as volume:
            return volume.sha256
    return sha256(path)
