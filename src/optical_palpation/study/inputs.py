"""The files that a study starts from: opened, described, and the layer found in them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from optical_palpation.errors import InputError
from optical_palpation.files import readable_name
from optical_palpation.palpation import read_sample_motion, uniform_motion
from optical_palpation.palpation.input_errors import OF_SAMPLE
from optical_palpation.stiffness import Sample
from optical_palpation.study.record import sha256
from optical_palpation.study.schema import MapInput, Study, VolumeInput, Volumes
from optical_palpation.thickness import (
    LayerFinder,
    clean_thickness,
    find_layer,
    read_height_map,
    read_thickness_map,
)
from optical_palpation.volume import Volume, open_volume

_READING = ("variable", "axes", "spacing", "scale", "refractive_index", "origin", "untrusted")
_FINDING = ("window", "sample", "window_range", "sample_range", "method")


def reading(settings: Volumes) -> dict[str, Any]:
    """Return the arguments of :func:`open_volume` that the settings give."""
    given = settings.model_dump(exclude_none=True)
    return {key: given[key] for key in _READING if key in given}


def finding(settings: Volumes) -> dict[str, Any]:
    """Return the arguments of :func:`find_layer` that the settings give."""
    given = settings.model_dump(exclude_none=True)
    return {key: given[key] for key in _FINDING if key in given}


def find_boundaries(
    volume: Volume,
    parameters: Mapping[str, Any],
    corrections: Path | None = None,
    progress: Callable[[float], None] | None = None,
    finder: LayerFinder | None = None,
) -> xr.Dataset:
    """Find the layer in a volume: the dataset of :func:`find_layer`, which says where it is from.

    Attributes are added: ``source`` and ``source_sha256`` (file and hash), ``volume`` (its
    metadata) and ``parameters``, the last two as JSON. `parameters`, `corrections` and `progress`
    are those of :func:`find_layer`; `finder`, one that was made of this volume and these
    parameters, finds anew only what corrections have changed.
    """
    if finder is None:
        found = find_layer(volume, corrections=corrections, progress=progress, **parameters)
    else:
        found = finder.find(corrections, progress=progress)
    used = {key: value for key, value in parameters.items() if value is not None}
    if corrections is not None:
        used["corrections_sha256"] = sha256(corrections)
    return found.assign_attrs(
        source=readable_name(volume.metadata.path),
        source_sha256=volume.sha256,
        volume=json.dumps(described(volume)),
        parameters=json.dumps(used),
    )


def described(volume: Volume) -> dict[str, Any]:
    """Metadata of a volume as JSON takes them."""
    metadata = vars(volume.metadata) | {"path": readable_name(volume.metadata.path)}
    return {key: list(v) if isinstance(v, tuple) else v for key, v in metadata.items()}


def open_input(study: Study, source: VolumeInput) -> Volume:
    """Open the volume of an input."""
    return open_volume(study.path(source.volume), **reading(source))


def facts(study: Study, source: VolumeInput | MapInput) -> dict[str, Any]:
    """Everything about an input on which a result depends, and its file's name for the record."""
    if isinstance(source, MapInput):
        path = study.path(source.map)
        return {"sha256": sha256(path), **source.model_dump(mode="json", exclude_none=True)}
    corrections = study.path(source.corrections) if source.corrections else None
    with open_input(study, source) as volume:
        return {
            "volume": source.volume,
            "sha256": volume.sha256,
            "metadata": described(volume),
            "corrections_sha256": sha256(corrections) if corrections else None,
            **finding(source),
        }


def sample_motion(study: Study, loaded: xr.DataArray) -> xr.Dataset | None:
    """Motion of the sample as the study gives it; of a strain, on the pixels of `loaded`."""
    motion = study.sample.motion
    if isinstance(motion, float):
        return uniform_motion(loaded, motion)
    return read_motion(study)


def read_motion(study: Study) -> xr.Dataset | None:
    """Read the file of the sample's motion, if the study names one."""
    motion = study.sample.motion
    if not isinstance(motion, str):
        return None
    try:
        return read_sample_motion(study.path(motion))
    except InputError as error:
        raise InputError(f"{study.where('[sample]')}: {error}") from error


def modelled_sample(study: Study) -> Sample | None:
    """The sample as the inversion takes it, if the study gives it.

    Raises
    ------
    InputError
        If the file of its relief cannot be used.
    """
    given = study.sample
    if given.thickness is None or given.plate_friction is None:
        return None
    relief: Any = given.relief
    try:
        if "relief" in given.files:
            relief = read_height_map(study.path(given.files["relief"]))
    except InputError as error:
        raise InputError(f"{study.where('[sample]')}: {error}") from error
    return Sample(
        thickness=given.thickness,
        compression=_of_loads(study, "compression"),
        total_force=_of_loads(study, "total_force"),
        plate_friction=given.plate_friction,
        relief=relief,
        size=given.size,
        law=given.make_law(study.material.make()),
    )


def _of_loads(study: Study, name: str) -> float | list[float] | None:
    """Travel or force of every load, or of the only one; None where it is not given."""
    sample = study.sample
    given = [getattr(load, name) for load in (*sample.earlier, sample)]
    if None in given:
        return None
    return given if sample.earlier else given[0]


def earlier_loads(study: Study) -> list[xr.DataArray]:
    """The loaded thickness at the earlier loads of a series, mm; what was filled is missing.

    Raises
    ------
    InputError
        If a file cannot be used.
    """
    maps = []
    for number, load in enumerate(study.sample.earlier, start=1):
        try:
            path, extent = study.path(load.map), study.layer.extent
            cleaned = clean_thickness(read_thickness_map(path, layer_extent=extent, **load.reading))
        except InputError as error:
            raise InputError(f"{study.where(f'sample.earlier[{number}]')}: {error}") from error
        maps.append(cleaned["thickness"].where(~cleaned["filled"]))
    return maps


def read_sample(study: Study) -> None:
    """Read the files of the sample that the study names; raises InputError where they are useless.

    Their content is checked with the layer's.
    """
    read_motion(study)
    modelled_sample(study)
    earlier_loads(study)


def sample_input(study: Study) -> dict[str, dict[str, str]]:
    """The files that the sample's table names and their hashes, for the record."""
    found = {}
    for key, name in study.sample.files.items():
        title = "sample" if key in ("motion", "relief") else f"sample-{key}"
        kind = "map" if title != "sample" else key
        found[title] = {kind: name, "sha256": sha256(study.path(name))}
    return found


def sample_facts(study: Study) -> dict[str, Any]:
    """What the sample adds to the facts on which the stress depends: its keys, of files hashes."""
    given = study.sample.model_dump(mode="json", exclude_none=True)
    for load in given.get("earlier", []):
        del load["map"]  # what it holds counts, not its name
    given |= {key: sha256(study.path(name)) for key, name in study.sample.files.items()}
    return {"sample": given} if given else {}


class Unchanged:
    """Sees to it that the files of a study stay what they were when they were hashed.

    Make it before the hashes are taken, and call it afterwards: now and then while they are used,
    and at last.

    Parameters
    ----------
    study
        The study whose files it watches.
    """

    def __init__(self, study: Study) -> None:
        self._study = study
        self._before = {path: file_state(path) for path in _paths(study)}

    def __call__(self) -> None:
        """Raise if a file has changed.

        Raises
        ------
        InputError
            With the name of the file.
        """
        for path, before in self._before.items():
            if file_state(path) != before:
                raise InputError(
                    f"{path} has changed while the study was worked on: the results would mix what "
                    "it was with what it is. Nothing made of the change was kept; run the study "
                    "again once the file stays as it is"
                )


def _paths(study: Study) -> Iterator[Path]:
    """Every file or folder that the study reads, itself excepted."""
    for source in study.inputs.values():
        yield study.path(source.map if isinstance(source, MapInput) else source.volume)
        if isinstance(source, VolumeInput) and source.corrections:
            yield study.path(source.corrections)
    yield from map(study.path, study.sample.files.values())


def file_state(path: Path) -> list[tuple[str, int, int, int]] | None:
    """What tells that a file, or one in a folder, was written to or replaced; None: it is gone."""
    try:
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        stats = [(str(file), file.stat()) for file in files]
    except OSError:
        return None
    return [(name, s.st_ino, s.st_size, s.st_mtime_ns) for name, s in stats]


def parameters(study: Study) -> dict[str, Any]:
    """Return all parameters with their defaults; those of both volumes stand with each of them.

    What has no meaning in this study is left out: defaults of a sample that is not in the model,
    and coefficients that the law of the layer does not have.
    """
    given = study.model_dump(mode="json", exclude_none=True, exclude={"volumes"})
    for name in unused_errors(study):
        del given["errors"][name]
    if not study.sample.modelled:
        del given["sample"]
        if study.sample.motion is not None:
            given["sample"] = {"motion": study.sample.motion}
    given["material"] = {
        name: value
        for name, value in given["material"].items()
        if value != 0 or name in study.material.model_fields_set
    }
    return given


def unused_errors(study: Study) -> set[str]:
    """Keys of ``[errors]`` that change nothing: inputs that the study does not have, or all."""
    if not study.errors.estimates:
        return set(type(study.errors).model_fields) - {"estimates"}
    return set() if study.sample.modelled else set(OF_SAMPLE)


def by_side(study: Study) -> Mapping[str, VolumeInput]:
    """The volumes of a study, by ``unloaded`` and ``loaded``."""
    return {side: it for side, it in study.inputs.items() if isinstance(it, VolumeInput)}
