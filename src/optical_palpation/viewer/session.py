"""A study while it is worked on: the layer found, corrected and solved step by step, then saved.

It does what :func:`~optical_palpation.study.run_study` does, by the same functions, but keeps what
lies in between at hand: the open volumes, the layer in them, its thickness. So a change costs no
more than what depends on it, and the study that is saved gives the same results to the last bit.
"""

from __future__ import annotations

import os
import tempfile
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import tomli_w
import xarray as xr

from optical_palpation.errors import InputError, OutputError
from optical_palpation.files import replacing
from optical_palpation.palpation import Similar
from optical_palpation.palpation.result import StressResult
from optical_palpation.study import Progress, Study, find_boundaries, read_study
from optical_palpation.study.compute import algebraic_of, stress_of, thickness_of
from optical_palpation.study.inputs import by_side, described, file_state, finding, reading
from optical_palpation.study.plausible import check_study
from optical_palpation.study.reading import changed, make_study, relocated
from optical_palpation.study.schema import MapInput, VolumeInput
from optical_palpation.thickness import (
    Corrections,
    LayerFinder,
    read_corrections,
    write_corrections,
)
from optical_palpation.viewer.layers import Frame
from optical_palpation.volume import Volume, open_volume

Tell = Callable[[Any], None]
SIDES = ("unloaded", "loaded")
_PATHS = ("volume", "map", "corrections")


class Session:
    """What the viewer works on.

    One thread at a time may use it.

    Attributes
    ----------
    tables
        What the study file would say, file names complete; change it by :meth:`change`.
    corrections
        Anchors and excluded regions by ``unloaded`` and ``loaded``.
    """

    def __init__(self) -> None:
        self._temporary = tempfile.TemporaryDirectory(prefix="optical-palpation-")
        self.tables: dict[str, Any] = {}
        self.corrections: dict[str, Corrections] = {}
        self._layers: dict[str, _Kept] = {}
        self._thickness: tuple[object, xr.Dataset] | None = None
        self._opened: Path | None = None
        self._similar = Similar()

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Session:
        """Take up a study file.

        Raises
        ------
        InputError
            As :func:`~optical_palpation.study.read_study`; or if its corrections cannot be read.
        """
        path = Path(path).resolve()
        study = read_study(path)
        session = cls()
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        for side in SIDES:
            given = tables.get(side, {})
            for key in _PATHS:
                if key in given:
                    given[key] = str(study.path(given[key]).resolve())
            if corrections := given.pop("corrections", None):
                session.corrections[side] = read_corrections(corrections)
        if "sample" in tables:
            tables["sample"] = relocated(
                tables["sample"], lambda _, name: str(study.path(name).resolve())
            )
        session.tables, session._opened = tables, path
        return session

    def change(self, changes: Mapping[str, Any]) -> None:
        """Put values in place, by table and key: ``{"friction.window": 0.2}``; None removes one.

        Raises
        ------
        InputError
            If a change goes into something that is no table.
        """
        self.tables = changed(self.tables, changes)

    def input(self, side: str) -> Mapping[str, Any]:
        """The input of a side as a study file gives it, keys of both volumes included."""
        given = self.tables.get(side, {})
        return {**self.tables.get("volumes", {}), **given} if "volume" in given else given

    def open_volume(self, side: str) -> Volume:
        """Open the volume of a side, to be shown; the caller closes it.

        Raises
        ------
        InputError
            If there is no such volume, or it cannot be read.
        """
        source = self._volume_input(side)
        return open_volume(source.volume, **reading(source))

    def frame(self, side: str) -> Frame:
        """Where the samples of a volume lie.

        Raises
        ------
        InputError
            If the layer has not been looked for in such a volume.
        """
        if side not in self._layers:
            raise InputError(f"find the layer in the {side} volume first")
        return Frame.of(self._layers[side].volume.metadata)

    def study(self) -> Study:
        """The study as it stands.

        Raises
        ------
        InputError, MaterialError
            Naming everything that is missing or cannot be used.
        """
        return make_study(
            self._with_corrections(self.tables, self._folder), self._file, in_memory=True
        )

    @property
    def found(self) -> dict[str, xr.Dataset]:
        """The layer by the volumes in which it was found last."""
        return {side: kept.found for side, kept in self._layers.items() if kept.found is not None}

    def find(self, side: str, progress: Tell | None = None) -> xr.Dataset:
        """Find the layer in a volume; after a correction, anew only what that changes.

        Parameters
        ----------
        side
            ``unloaded`` or ``loaded``.
        progress
            As for :func:`~optical_palpation.study.run_study`.

        Returns
        -------
        xarray.Dataset
            As from :func:`~optical_palpation.study.find_boundaries`.

        Raises
        ------
        InputError
            If there is no such volume, it cannot be read, or a boundary cannot be seen in it.
        """
        source = self._volume_input(side)

        def tell(share: float) -> None:
            if progress:
                progress(Progress(f"boundaries of the {side} layer", share))

        tell(0.0)
        kept = self._layers.get(side)
        state = file_state(Path(source.volume))
        settings = source.model_dump(exclude={"corrections"})
        if kept is None or kept.settings != settings or kept.state != state:
            if kept is not None:
                kept.volume.close()
                del self._layers[side]
            volume = open_volume(source.volume, **reading(source))
            try:
                finder = LayerFinder(volume, progress=lambda s: tell(0.4 * s), **finding(source))
            except BaseException:
                volume.close()
                raise
            kept = self._layers[side] = _Kept(settings, state, volume, finder)
        corrections = self.corrections.get(side)  # they may be changed meanwhile
        file = self._write_corrections(side, self._folder)
        kept.found = find_boundaries(
            kept.volume,
            finding(source),
            file,
            lambda s: tell(0.4 + 0.6 * s),
            finder=kept.finder,
        )
        kept.corrections = corrections
        return kept.found

    def thickness(self, progress: Tell | None = None) -> xr.Dataset:
        """Thickness of the layer, loaded and unloaded, as the stress needs it.

        What has not been found yet is found first.

        Returns
        -------
        xarray.Dataset
            As from :func:`~optical_palpation.study.compute.thickness_of`.

        Raises
        ------
        InputError
            If the study lacks something, or an input cannot be used.
        """
        study = self.study()
        found = {}
        for side, source in by_side(study).items():
            kept = self._layers.get(side)
            up_to_date = (
                kept is not None
                and kept.found is not None
                and kept.settings == source.model_dump(exclude={"corrections"})
                and kept.corrections == self.corrections.get(side)
                and kept.state == file_state(Path(source.volume))
            )
            if kept is None or kept.found is None or not up_to_date:
                self.find(side, progress)
                kept = self._layers[side]
            assert kept.found is not None
            found[side] = kept.found
        check_study(study, {side: {"metadata": self._described(side)} for side in found})
        maps = [file_state(study.path(it.map)) for it in study.inputs.values()
                if isinstance(it, MapInput)]  # fmt: skip
        tables = study.model_dump(include={"layer", "loaded", "unloaded"})
        made_from = tables, maps, {side: _Same(it) for side, it in found.items()}
        if self._thickness is None or self._thickness[0] != made_from:
            if progress:
                progress(Progress("thickness", 0.0))
            self._thickness = made_from, thickness_of(study, found)
        return self._thickness[1]

    def solve(self, progress: Tell | None = None, *, live: bool = False) -> StressResult:
        """Compute the stress of the study as it stands, from the unloaded layer.

        Parameters
        ----------
        progress
            As for :func:`~optical_palpation.study.run_study`.
        live
            Quickly, after a small change: guided by the layer solved before
            (:class:`~optical_palpation.palpation.Similar`), and without the errors by the mesh, the
            sides and the inputs.

        Raises
        ------
        InputError, MaterialError
            If the study lacks something, or an input cannot be used.
        ConvergenceError
            If the full load is not reached.
        """
        study = self.study()
        thickness = self.thickness(progress)
        algebraic_of(study, thickness)  # refuses what no layer can take, in no time
        similar = self._similar if live else Similar()
        estimates = False if live else None
        result = stress_of(study, thickness, progress, estimates=estimates, similar=similar)
        self._similar = similar
        return result

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a study file that ``optical-palpation run`` repeats, corrections beside it.

        Raises
        ------
        InputError, MaterialError
            If the study lacks something.
        OutputError
            If a file cannot be written.
        """
        path = Path(path).resolve()
        if path.suffix.lower() != ".toml":
            raise OutputError(f"{path}: the name of a study file ends in .toml")
        self.study()
        tables = self._with_corrections(self.tables, path.parent, f"{path.stem}-")
        for side in SIDES:
            given = dict(tables[side])
            for key in _PATHS:
                if key in given:
                    source = Path(given[key])
                    inside = source.is_relative_to(path.parent)
                    given[key] = str(source.relative_to(path.parent) if inside else source)
            tables[side] = given
        if path != self._opened and "outputs" in tables:
            # the result folder is that of the study that was opened
            outputs = {key: v for key, v in tables["outputs"].items() if key != "folder"}
            tables["outputs"] = outputs
        with replacing(path) as temporary:
            temporary.write_text(tomli_w.dumps(tables), encoding="utf-8")
        read_study(path)

    def close(self) -> None:
        """Close the volumes."""
        for kept in self._layers.values():
            kept.volume.close()
        self._layers.clear()

    @property
    def _folder(self) -> Path:
        return Path(self._temporary.name)

    @property
    def _file(self) -> Path:
        return self._folder / "study.toml"

    def _described(self, side: str) -> Mapping[str, Any]:
        return described(self._layers[side].volume)

    def _volume_input(self, side: str) -> VolumeInput:
        """The volume of a side, checked as a study's is, though the rest may still be missing."""
        if "volume" not in self.tables.get(side, {}):
            raise InputError(f"{side}: is no volume in which the layer could be found")
        whole = {
            "unloaded": {"thickness": 1.0},
            "material": {"c10": 1.0},
            "friction": {"window": 0.0, "sample": 0.0},
            "grid": {"element_size": 1.0},
            "volumes": self.tables.get("volumes", {}),
            "loaded": self.tables[side],
        } | {side: self.tables[side]}
        source = getattr(make_study(whole, self._file, in_memory=True), side)
        assert isinstance(source, VolumeInput)
        return source

    def _with_corrections(
        self, tables: Mapping[str, Any], folder: Path, prefix: str = ""
    ) -> dict[str, Any]:
        """Tables with the files of the corrections, which are written to a folder."""
        result = dict(tables)
        for side in SIDES:
            file = self._write_corrections(side, folder, prefix)
            if file is not None and "volume" in result.get(side, {}):
                result[side] = {**result[side], "corrections": str(file)}
        return result

    def _write_corrections(self, side: str, folder: Path, prefix: str = "") -> Path | None:
        given = self.corrections.get(side)
        if not given or not (given.anchors or given.exclusions):
            return None
        file = folder / f"{prefix}corrections-{side}.txt"
        write_corrections(given, file)
        return file


class _Same:
    """Equal to itself alone: what was found anew is something else."""

    def __init__(self, found: xr.Dataset) -> None:
        self._found = found

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self._found is other._found

    __hash__ = None  # type: ignore[assignment]


class _Kept:
    """An open volume and the layer in it."""

    def __init__(
        self, settings: Mapping[str, Any], state: object, volume: Volume, finder: LayerFinder
    ) -> None:
        self.settings, self.state = settings, state
        self.volume, self.finder = volume, finder
        self.found: xr.Dataset | None = None
        self.corrections: Corrections | None = None
