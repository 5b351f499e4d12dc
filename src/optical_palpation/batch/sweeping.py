"""A study for all combinations of some parameters, one after another or on Dask."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.analysis.maps import at_points_of
from optical_palpation.arguments import check_instance, explained
from optical_palpation.batch.dispatch import BatchProgress
from optical_palpation.batch.reading import Batch, Scan
from optical_palpation.batch.run import run_batch
from optical_palpation.batch.table import check_folder
from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.palpation.result import StressResult
from optical_palpation.present import read_result
from optical_palpation.present.summary import force_error, without_inputs
from optical_palpation.study import Progress, warnings_about
from optical_palpation.study.python import Study
from optical_palpation.study.reading import plain
from optical_palpation.study.stages import STRESS

Tell = Callable[[Any], None]
Point = Mapping[str, Any]
#: The maps of a point, or why it has none.
Solved = xr.Dataset | InputError | ConvergenceError


@explained
def sweep(
    study: Study,
    parameters: Mapping[str, Sequence[Any]],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    folder: str | os.PathLike[str] | None = None,
    progress: Tell | None = None,
) -> xr.Dataset:
    """Solve a study for all combinations of some parameters.

    Every point is solved from the unloaded layer, since friction remembers the path of loading.

    Parameters
    ----------
    study
        The study to vary.
    parameters
        Values by table and key: ``{"friction.window": [0.1, 0.2], "material.c10": [2.0, 2.5]}``.
        Names of files count from the folder of the study, if it was read from a file.
    workers
        Number of workers on this machine that compute points side by side (Dask, the extra
        ``batch``); with `folder` alone, as many as cores and memory allow. By default points are
        computed here, one after another.
    scheduler
        Address of a running Dask scheduler (``tcp://host:8786``) or path of its scheduler file, to
        compute points on its workers; needs `folder`.
    folder
        Where workers leave the results of the points; all of them must see it by this path. What is
        there already is not computed again. By default a temporary folder on this machine.
    progress
        As for :func:`~optical_palpation.study.run_study`; the stage also counts the points.

    Returns
    -------
    xarray.Dataset
        The maps of the result with the parameters as further dimensions, named with ``_`` for the
        dot, ``friction_window``; over these alone ``window_force`` and ``sample_force`` (mN),
        ``force_error`` (mN) where errors were estimated, ``warnings``, what casts doubt on a point,
        and ``failure``, empty, or why it has no solution: it was refused, or not found; its maps
        have no value. Where the element size is one of the parameters, maps are interpolated to
        the points of the first.

    Raises
    ------
    InputError
        If a parameter or value cannot be used, before anything is computed; if the scheduler
        cannot; or if no point has a solution and the first was refused.
    ConvergenceError
        If no point has a solution and that of the first was not found.
    OutputError
        If `folder` cannot be made or written.
    """
    check_instance(study, Study, "study", "an optical_palpation.Study")
    kind = "a mapping of table and key to values, {'friction.window': [0.1, 0.2]}"
    check_instance(parameters, Mapping, "parameters", kind)
    check_instance(workers, int | None, "workers", "a whole number")
    values: dict[str, list[Any]] = {}
    for name, given in parameters.items():
        if isinstance(given, str) or not isinstance(given, Sequence | np.ndarray) or not len(given):
            raise InputError(f"{name}: a list of values, at least one, not {given!r}")
        values[name] = [plain(value) for value in given]
    if not values:
        raise InputError("parameters: name at least one, such as {'friction.window': [0.1, 0.2]}")
    if scheduler is not None and folder is None:
        raise InputError(
            "folder: where the workers of the scheduler leave their results, which all of them "
            "and this process see by the same path"
        )
    points = [dict(zip(values, point, strict=True)) for point in product(*values.values())]
    studies = [study.with_(point) for point in points]  # refuses all that is wrong, at once
    if workers is None and scheduler is None and folder is None:
        solved = _one_after_another(studies, progress)
    else:
        chosen = [
            {name: _value_of(variant, name) for name in values} for variant in studies
        ]  # as the study has them: names of files complete
        solved = _on_workers(study, chosen, workers, scheduler, folder, progress)
    base = next((maps for maps in solved if isinstance(maps, xr.Dataset)), None)
    if base is None:
        first = solved[0]
        assert isinstance(first, InputError | ConvergenceError)
        which = "" if isinstance(first, ConvergenceError) else f", {points[0]}"
        raise type(first)(f"no point has a solution; the first{which}: {first}")
    found = [_on(maps, base) if isinstance(maps, xr.Dataset) else None for maps in solved]
    failures = ["" if isinstance(point, xr.Dataset) else str(point) for point in solved]
    return _gathered(values, found, failures, base)


def _value_of(study: Study, name: str) -> Any:
    """The value of a study by table and key; None if it says nothing of it."""
    found: Any = study.given
    for key in name.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def _one_after_another(studies: Sequence[Study], progress: Tell | None) -> list[Solved]:
    """Return the maps of each study, or why there are none."""
    solved: list[Solved] = []
    for count, variant in enumerate(studies, 1):

        def tell(report: Any, count: int = count) -> None:
            if progress:
                stage = f"{count} of {len(studies)}: {report.stage}"
                newton, message = report.newton, getattr(report, "message", "")
                progress(Progress(stage, report.load, newton, message))

        try:
            solved.append(variant.run(tell).maps)
        except (InputError, ConvergenceError) as error:
            solved.append(error)
    return solved


def _on_workers(
    study: Study,
    points: Sequence[Point],
    workers: int | None,
    scheduler: str | None,
    folder: str | os.PathLike[str] | None,
    progress: Tell | None,
) -> list[Solved]:
    """Return the same from a batch of the points."""

    def tell(report: BatchProgress) -> None:
        if progress:
            ended = report.done + report.failed
            stage = f"{ended} of {report.total}: {', '.join(report.running) or 'starting workers'}"
            progress(Progress(stage, ended / report.total, 0, report.message))

    with tempfile.TemporaryDirectory(prefix="optical-palpation-") as temporary:
        place = Path(temporary if folder is None else folder).resolve()
        check_folder(place)
        file = place / "study.toml"
        study.with_({"outputs.write": []}).save(file)
        scans = tuple(Scan(f"point-{n:04d}", file, point) for n, point in enumerate(points))
        batch = Batch(file, scans, place / "points")
        done = run_batch(batch, scheduler=scheduler, workers=workers, progress=tell)
        solved: list[Solved] = []
        for outcome in done.outcomes:
            if outcome.status != "failed":
                solved.append(read_result(batch.folder / outcome.name / STRESS).maps)
            elif outcome.error == ConvergenceError.__name__:
                solved.append(ConvergenceError(outcome.message))
            else:
                solved.append(InputError(outcome.message))
    return solved


def _on(maps: xr.Dataset, base: xr.Dataset) -> xr.Dataset:
    """Maps on the points of other ones."""
    if all(maps[axis].equals(base[axis]) for axis in "yx"):
        return maps
    parts = {}
    for name, field in maps.data_vars.items():
        if set(field.dims) == {"y", "x"}:
            method: Any = "linear" if field.dtype.kind == "f" else "nearest"
            read = at_points_of(field.astype(float), base, method)
            # whole numbers have no NaN: a point beyond the layer would be open, or worse
            parts[name] = read if read.isnull().any() else read.astype(field.dtype)
    return xr.Dataset(parts, attrs=maps.attrs)


def _gathered(
    values: Mapping[str, Sequence[Any]],
    found: Sequence[xr.Dataset | None],
    failures: Sequence[str],
    base: xr.Dataset,
) -> xr.Dataset:
    dims = [name.replace(".", "_") for name in values]
    shape = [len(v) for v in values.values()]
    result = xr.Dataset(coords={axis: base[axis] for axis in "yx"})
    for dim, (name, given) in zip(dims, values.items(), strict=True):
        scalar = all(isinstance(v, int | float | str) for v in given)
        labels = list(given) if scalar else [str(v) for v in given]
        result = result.assign_coords({dim: (dim, labels, {"parameter": name})})
    for key, field in base.data_vars.items():
        if set(field.dims) != {"y", "x"}:
            continue
        field = field.transpose("y", "x")
        stack = []
        for maps in found:
            if maps is None or key not in maps:
                stack.append(np.full(field.shape, np.nan))
            else:
                stack.append(maps[key].transpose("y", "x").values)
        data = np.array(stack).reshape(*shape, *field.shape)
        result[key] = ((*dims, "y", "x"), data, field.attrs)
    for side in ("window", "sample"):
        force = f"{side}_force_mN"
        forces = [np.nan if m is None else float(m.attrs.get(force, np.nan)) for m in found]
        text = {"units": "mN", "long_name": f"force on the {side}"}
        result[f"{side}_force"] = (dims, np.reshape(forces, shape), text)
    attrs = [{} if m is None else m.attrs for m in found]
    # the error by the mesh is a part of the error
    errors = np.array([None if without_inputs(a) else force_error(a) for a in attrs], dtype=float)
    if np.isfinite(errors).any():
        text = {"units": "mN", "long_name": "error of the force"}
        result["force_error"] = (dims, errors.reshape(shape), text)
    doubts = ["" if m is None else "; ".join(warnings_about(StressResult(m))) for m in found]
    for name, said, meaning in (
        ("warnings", doubts, "what casts doubt on a point"),
        ("failure", failures, "why a point has no solution"),
    ):
        texts = np.array(said, dtype=object).reshape(shape).astype(str)
        result[name] = (dims, texts, {"long_name": meaning})
    result.attrs = {k: v for k, v in base.attrs.items() if k in _COMMON}
    return result


_COMMON = ("input", "input_sha256", "source", "source_sha256", "method", "software_version")
