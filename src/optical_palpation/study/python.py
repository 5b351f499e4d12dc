"""A study in Python: what a study file says, as an object that can be varied and solved."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.arguments import check_instance, explained, file_path, in_words
from optical_palpation.errors import InputError, OutputError
from optical_palpation.files import replacing
from optical_palpation.material import Law
from optical_palpation.palpation.result import StressResult
from optical_palpation.stiffness import Sample
from optical_palpation.study.reading import (
    changed,
    make_study,
    meant_by,
    plain,
    read_study,
    relocated,
)
from optical_palpation.study.run import run_study
from optical_palpation.study.schema import Study as StudyFile
from optical_palpation.study.stages import THICKNESS
from optical_palpation.thickness import write_thickness_map

Tell = Callable[[Any], None]
_SIDES = ("unloaded", "loaded")
_PATHS = ("volume", "map", "corrections")
#: What stands for a table, by name.
_KINDS = {
    "material": "a law such as MooneyRivlin(c10=2.23, c01=0.703), or a mapping of keys to values",
    "friction": "a mapping such as {'window': 0.15, 'sample': 0.1}",
}


class Study:
    """A study: inputs, material, friction and grid, from which the tactile stress follows.

    It says what a study file says, table by table, and its results are the same to the last bit:
    they are made by the same stages, in a temporary folder that all variants of a study share, so
    that a boundary is found, and a thickness map is cleaned, once.

    Parameters
    ----------
    loaded
        The layer under load: ``{"volume": "loaded.oct"}``, ``{"map": "loaded.mat", ...}`` with the
        keys of a study file, or a thickness map (``DataArray`` over y and x, mm).
    unloaded
        The layer before; likewise, or its thickness in mm.
    material
        A law (:class:`~optical_palpation.material.MooneyRivlin`, ``NeoHookean``, ``Yeoh``), or the
        keys of a study file, ``{"c10": ..., "c01": ...}`` in kPa.
    friction
        ``{"window": ..., "sample": ...}``, Coulomb's coefficients or ``"glued"``.
    grid
        ``{"element_size": 0.125, ...}``, or the size alone, mm; or ``{"accuracy": 0.02, ...}``, the
        error of the total force that the mesh may leave.
    tables
        Further tables of a study file: ``volumes``, ``layer``, ``sample``, ``outputs``, and
        ``title``. As ``sample`` a :class:`~optical_palpation.stiffness.Sample`, too, which puts it
        into the model.
    folder
        Folder from which file names count; the working directory by default.

    Raises
    ------
    InputError
        Naming everything that cannot be used: table, key, value and what would be right.
    """

    @explained
    def __init__(
        self,
        *,
        loaded: Mapping[str, Any] | xr.DataArray,
        unloaded: Mapping[str, Any] | xr.DataArray | float,
        material: Law | Mapping[str, Any],
        friction: Mapping[str, float | str],
        grid: Mapping[str, Any] | float | Sequence[float],
        folder: str | os.PathLike[str] = ".",
        **tables: Any,
    ) -> None:
        _check_names(tables, "Study: there is no argument")
        given = {
            "loaded": loaded,
            "unloaded": unloaded,
            "material": material,
            "friction": friction,
            "grid": grid,
            **tables,
        }
        self._begin(_Workspace(), given, Path(folder))

    def _begin(
        self,
        workspace: _Workspace,
        given: Mapping[str, Any],
        folder: Path,
        file: Path | None = None,
    ) -> None:
        self._workspace, self._folder = workspace, folder.resolve()
        self._given = {
            name: _table(name, value, workspace, folder) for name, value in given.items()
        }
        self._file = file
        nowhere = workspace.folder / "study"
        self._checked = make_study(self._given, file or nowhere, in_memory=file is None)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Study:
        """Read a study file.

        Raises
        ------
        InputError
            As :func:`~optical_palpation.study.read_study`.
        """
        import tomllib

        path = file_path(path).resolve()
        read_study(path)  # its errors are those of the file
        study = cls.__new__(cls)
        given = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        study._begin(_Workspace(), given, path.parent, path)
        return study

    def with_(self, changes: Mapping[str, Any] | None = None, **tables: Any) -> Study:
        """Return a study that differs from this one.

        Names of files count from where those of this study do: the folder of its file, if it has
        one.

        Parameters
        ----------
        changes
            New values by table and key: ``{"friction.window": 0.2}``.
        tables
            Tables, of which only the keys that are named change: ``friction={"window": 0.2}``.

        Raises
        ------
        InputError
            If the result is no study that can be used.
        """
        if changes is not None:
            kind = "a mapping of table and key to value, {'friction.window': 0.2}"
            check_instance(changes, Mapping, "changes", kind)
        given: dict[str, Any] = dict(self._given)
        inner: dict[str, Any] = {}
        for name, value in tables.items():
            both = isinstance(value, Mapping) and isinstance(given.get(name), Mapping)
            # another input is no key of the one that is there
            if not both or (name in _SIDES and {"volume", "map", "thickness"} & set(value)):
                given[name] = value
            else:
                inner |= {f"{name}.{key}": of for key, of in value.items()}
        given = changed(given, {**inner, **(changes or {})})
        _check_names(given, "study: there is no table")
        study = type(self).__new__(type(self))
        study._begin(self._workspace, given, self._folder)
        return study

    def __repr__(self) -> str:
        said = []
        for side in _SIDES:
            it = getattr(self._checked, side)
            what = getattr(it, "volume", None) or getattr(it, "map", None)
            if what is None:
                said.append(f"{side} {it.thickness:g} mm")
            elif Path(what) in self._workspace.arguments:
                said.append(f"{side} a map in memory")
            else:
                said.append(f"{side} {Path(what).name}")
        m, f, g = self._checked.material, self._checked.friction, self._checked.grid
        said.append(f"{m.law}, {m.make().describe()}")
        window, sample = (h if h == "glued" else f"friction {h:g}" for h in (f.window, f.sample))
        said.append(f"{window} (window), {sample} (sample)")
        of = f"of {g.element_size} mm" if g.accuracy is None else f"for {100 * g.accuracy:g} %"
        said.append(f"elements {of}")
        return f"<Study: {'; '.join(said)}>"

    @property
    def parameters(self) -> dict[str, Any]:
        """All parameters with their defaults, by table."""
        return self._checked.model_dump(mode="json", exclude_none=True)

    @property
    def given(self) -> dict[str, Any]:
        """What was given, by table, without defaults; names of files are complete."""
        return dict(self._given)

    @explained
    def run(self, progress: Tell | None = None) -> StressResult:
        """Compute the stress.

        A study that was read from a file, or saved as one, fills its result folder, as
        ``optical-palpation run`` does; any other leaves no file. What an earlier run has made is
        not made again.

        Parameters
        ----------
        progress
            As for :func:`~optical_palpation.study.run_study`.

        Raises
        ------
        InputError, MaterialError
            If an input cannot be used.
        ConvergenceError
            If the full load is not reached.
        """
        with self._naming_arguments():
            return run_study(self._runnable(), progress=progress).stress()

    @explained
    def thickness(self, progress: Tell | None = None) -> xr.Dataset:
        """Find the layer and return its thickness, before any mechanics.

        Returns
        -------
        xarray.Dataset
            ``loaded_thickness`` and ``initial_thickness`` in mm on ``(y, x)`` without gaps, what of
            them was ``filled`` and ``initial_filled``, and of volumes the ``quality``.
        """
        with self._naming_arguments():
            done = run_study(self._runnable(), thickness_only=True, progress=progress)
        return xr.load_dataset(done.folder / THICKNESS, engine="h5netcdf")

    def save(self, path: str | os.PathLike[str]) -> Study:
        """Write the study as a file that ``optical-palpation run`` repeats, and return that study.

        Maps in memory are written beside it.

        Raises
        ------
        OutputError
            If the file cannot be written.
        """
        import tomli_w

        path = file_path(path).resolve()
        if path.suffix.lower() != ".toml":
            raise OutputError(f"{path}: the name of a study file ends in .toml")
        given = dict(self._given)
        for side in _SIDES:
            it = dict(given[side])
            for key in _PATHS:
                if key in it:
                    whole = self._checked.path(it[key])
                    it[key] = self._kept(whole, path.with_name(f"{path.stem}-{side}.nc"))
            given[side] = it

        def keep(key: str, name: str) -> str:
            return self._kept(self._checked.path(name), path.with_name(f"{path.stem}-{key}.nc"))

        if "sample" in given:
            given["sample"] = relocated(given["sample"], keep)
        with replacing(path) as temporary:
            temporary.write_text(tomli_w.dumps(given), encoding="utf-8")
        return type(self).read(path)

    def _kept(self, source: Path, beside: Path) -> str:
        """Name of a file as a study in the folder of `beside` says it, where a map is copied to."""
        source = source.resolve()
        if source.is_relative_to(self._workspace.folder):
            with replacing(beside) as temporary:
                temporary.write_bytes(source.read_bytes())
            source = beside
        inside = source.is_relative_to(beside.parent)
        return str(source.relative_to(beside.parent) if inside else source)

    @contextmanager
    def _naming_arguments(self) -> Iterator[None]:
        """Name in errors what was given in memory by its argument, not its temporary file."""
        try:
            yield
        except InputError as error:
            text = str(error)
            for file, argument in self._workspace.arguments.items():
                text = re.sub(
                    f"{re.escape(str(file))}(, variable (thickness|height))?", argument, text
                )
            raise type(error)(text) from None

    def _runnable(self) -> StudyFile:
        """The study as a file that can be run."""
        if self._file is not None:
            return self._checked
        import tomli_w

        file = self._workspace.folder / "study.toml"
        given = {**self._given, "outputs": {"folder": "results", "write": []}}
        with replacing(file) as temporary:
            temporary.write_text(tomli_w.dumps(given), encoding="utf-8")
        return make_study(given, file, in_memory=True)


class _Workspace:
    """A temporary folder that lives as long as a study that uses it."""

    def __init__(self) -> None:
        self._temporary = tempfile.TemporaryDirectory(prefix="optical-palpation-")
        self.folder = Path(self._temporary.name).resolve()
        #: Maps that were given in memory, and as what.
        self.arguments: dict[Path, str] = {}

    def keep(self, field: xr.DataArray, argument: str, name: str = "thickness") -> Path:
        """Write a map that was given in memory."""
        path = self.folder / f"map-{len(self.arguments) + 1}.nc"
        write_thickness_map(field.to_dataset(name=name), path)
        self.arguments[path] = argument
        return path

    def keep_thickness(self, field: xr.DataArray, argument: str) -> dict[str, str]:
        """Write a thickness map that was given in memory; how a study file names it."""
        from optical_palpation.thickness.frames import on_grid

        path = self.keep(on_grid(field, argument), argument)
        return {"map": str(path), "variable": "thickness"}


def _check_names(names: Iterable[str], refusal: str) -> None:
    """Refuse what is no table of a study, and say which table, or key of one, comes near."""
    tables = StudyFile.model_fields
    for name in names:
        if name in tables:
            continue
        meant = meant_by(name)
        hint = f"did you mean {' or '.join(meant)}?" if meant else f"it takes {', '.join(tables)}"
        raise InputError(f"{refusal} {name!r}; {hint}")


def _kept_load(load: Mapping[str, Any], number: int, workspace: _Workspace) -> dict[str, Any]:
    """An earlier load of a series, its map as a file."""
    if isinstance(field := load.get("map"), xr.DataArray):
        return {**load, **workspace.keep_thickness(field, f"sample.earlier[{number}].map")}
    return dict(load)


def _table(name: str, value: Any, workspace: _Workspace, folder: Path) -> Any:
    """What a study file would say, file names complete."""
    if name in _SIDES:
        if isinstance(value, xr.DataArray):
            return workspace.keep_thickness(value, name)
        value = plain(value) if isinstance(value, np.generic) else value
        if name == "unloaded" and isinstance(value, int | float) and not isinstance(value, bool):
            return {"thickness": float(value)}
        if not isinstance(value, Mapping) or isinstance(value, xr.Dataset):
            number = ", or a number of mm" if name == "unloaded" else ""
            make = "; thickness_map makes one of an array" if isinstance(value, np.ndarray) else ""
            raise InputError(
                f"{name}: {{'volume': file}}, {{'map': file}}, or a DataArray over y and x in mm"
                f"{number}; not {in_words(value)}{make}"
            )
        whole = dict(value)
        for key in _PATHS:
            if whole.get(key) is not None:
                kind = "the name of a file"
                if isinstance(whole[key], xr.DataArray | np.ndarray):
                    kind += f"; a map in memory is given as {name}=thickness_map(...) itself"
                check_instance(whole[key], (str, os.PathLike), f"{name}.{key}", kind)
                whole[key] = str((folder / whole[key]).resolve())
        return whole
    if name == "material" and isinstance(value, Law):
        return value.arguments
    if name == "grid" and not isinstance(value, Mapping):
        return {"element_size": plain(value)}
    if name == "sample" and isinstance(value, Sample):
        if len(value.travels or value.forces or ()) > 1:
            raise InputError(
                "sample: of a series of loads give a mapping, whose compression is that of loaded "
                'and "earlier" a list of {"map": ..., "compression": ...}'
            )
        value = {key: of for key, of in vars(value).items() if of is not None}
        for key in {"compression", "total_force"} & value.keys():
            value[key] = float(np.ravel(value[key])[0])
    if name == "sample" and isinstance(value, Mapping):
        whole = {key: plain(of) for key, of in value.items()}
        if loads := whole.get("earlier"):
            whole["earlier"] = [_kept_load(load, n, workspace) for n, load in enumerate(loads, 1)]
        whole = relocated(whole, lambda _, of: str((folder / of).resolve()))
        if isinstance(relief := whole.get("relief"), xr.DataArray):
            whole["relief"] = str(workspace.keep(relief, "sample.relief", "height"))
        for key, of in value.items():
            if isinstance(of, Law):
                whole[key] = of.arguments
        return whole
    if name == "title":
        return value
    if not isinstance(value, Mapping):
        kind = _KINDS.get(name, "a mapping of keys to values")
        raise InputError(f"{name}: {kind}, not {in_words(value)}")
    return {key: plain(of) for key, of in value.items()}
