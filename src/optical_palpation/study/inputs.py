"""The files that a study starts from: opened, described, and the layer found in them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from optical_palpation.errors import InputError
from optical_palpation.palpation import read_sample_motion, uniform_motion
from optical_palpation.study.record import sha256
from optical_palpation.study.schema import MapInput, Study, VolumeInput, Volumes
from optical_palpation.thickness import find_layer
from optical_palpation.volume import Volume, open_volume

_READING = ("variable", "axes", "spacing", "scale", "refractive_index", "origin")
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
) -> xr.Dataset:
    """Find the layer in a volume: the dataset of :func:`find_layer`, which says where it is from.

    Attributes are added: ``source`` and ``source_sha256`` (file and hash), ``volume`` (its
    metadata) and ``parameters``, the last two as JSON. `parameters`, `corrections` and `progress`
    are those of :func:`find_layer`.
    """
    found = find_layer(volume, corrections=corrections, progress=progress, **parameters)
    used = {key: value for key, value in parameters.items() if value is not None}
    if corrections is not None:
        used["corrections_sha256"] = sha256(corrections)
    return found.assign_attrs(
        source=volume.metadata.path.name,
        source_sha256=volume.sha256,
        volume=json.dumps(described(volume)),
        parameters=json.dumps(used),
    )


def described(volume: Volume) -> dict[str, Any]:
    """Metadata of a volume as JSON takes them."""
    metadata = vars(volume.metadata) | {"path": volume.metadata.path.name}
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
        raise InputError(f"{study.file}, [sample]: {error}") from error


def motion_facts(study: Study) -> dict[str, Any]:
    """What the motion of the sample adds to the facts on which the stress depends."""
    motion = study.sample.motion
    if motion is None:
        return {}
    return {"sample": sha256(study.path(motion)) if isinstance(motion, str) else motion}


def parameters(study: Study) -> dict[str, Any]:
    """Return all parameters with their defaults; those of both volumes stand with each of them."""
    return study.model_dump(mode="json", exclude_none=True, exclude={"volumes"})


def by_side(study: Study) -> Mapping[str, VolumeInput]:
    """The volumes of a study, by ``unloaded`` and ``loaded``."""
    return {side: it for side, it in study.inputs.items() if isinstance(it, VolumeInput)}
