"""Thickness and stress of a study from what is in memory.

The stages do the same between files, and whoever keeps the layer at hand does it without.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import xarray as xr

from optical_palpation.palpation import Similar, algebraic_result, computational_stress
from optical_palpation.palpation.plausibility import check_stress
from optical_palpation.palpation.result import StressResult
from optical_palpation.stiffness import sample_stress
from optical_palpation.study.inputs import by_side, earlier_loads, modelled_sample, sample_motion
from optical_palpation.study.schema import MapInput, NumberInput, Study, VolumeInput
from optical_palpation.thickness import (
    clean_thickness,
    lateral_shift,
    match_initial_thickness,
    read_thickness_map,
    shift_map,
    thickness_map,
)
from optical_palpation.thickness.frames import inside_layer
from optical_palpation.thickness.initial import filled_there


def thickness_of(study: Study, found: Mapping[str, xr.Dataset]) -> xr.Dataset:
    """Loaded and initial thickness on the pixels of the loaded map, without gaps.

    Parameters
    ----------
    study
        Its maps are read, its numbers taken.
    found
        Boundaries in its volumes, by ``unloaded`` and ``loaded``
        (:func:`~optical_palpation.study.find_boundaries`).

    Returns
    -------
    xarray.Dataset
        ``loaded_thickness`` and ``initial_thickness`` in mm on ``(y, x)``, what of them was
        ``filled`` and ``initial_filled``, and of a volume the ``quality``.

    Raises
    ------
    InputError
        If a map cannot be used, or the two do not fit together.
    """
    loaded, quality = _measured(study, "loaded", study.loaded, found, study.layer.extent)
    cleaned = clean_thickness(loaded)
    how = {
        side: {key: json.loads(found[side].attrs[key]) for key in ("volume", "parameters")}
        for side in by_side(study)
    }
    attrs = cleaned.attrs | {"boundaries": json.dumps(how)}
    if isinstance(study.unloaded, NumberInput):
        initial: Any = study.unloaded.thickness
        made_up = xr.zeros_like(cleaned["filled"])
        source = {}
    else:
        unloaded, _ = _measured(study, "unloaded", study.unloaded, found, None)
        source = {k: v for k, v in unloaded.attrs.items() if k.startswith("source")}
        if study.layer.registration:
            shift = lateral_shift(loaded, unloaded)
            unloaded = shift_map(unloaded, shift)
            attrs["registration_shift_mm"] = list(shift)  # y, x
        whole = clean_thickness(unloaded)
        initial = whole["thickness"]
        made_up = filled_there(whole["filled"], loaded)
    matched = match_initial_thickness(
        initial, cleaned["thickness"], glued=study.friction.sample_glued
    )
    own = {key: v for key, v in matched.attrs.items() if not key.startswith("source")}
    matched.attrs = own | source  # and not the file of the loaded thickness
    for side in by_side(study):
        of = "" if side == "loaded" else "initial_"
        attrs[f"{of}specular_share"] = found[side].attrs["specular_share"]
        attrs[f"{of}doubts"] = found[side].attrs["doubts"]
    result = xr.Dataset(
        {
            "loaded_thickness": cleaned["thickness"],
            "filled": cleaned["filled"],
            "initial_thickness": matched,
            "initial_filled": made_up,
        },
        attrs=attrs | {"initial_filled_share": float(made_up.values[inside_layer(loaded)].mean())},
    )
    if quality is not None:
        result["quality"] = quality.where(~cleaned["filled"].values, 0.0)
    return result


def algebraic_of(study: Study, thickness: xr.Dataset) -> StressResult:
    """Tactile stress by the algebraic method, on the pixels of the loaded thickness.

    Parameters
    ----------
    study
        Its material counts, and whether the sample is glued.
    thickness
        As from :func:`thickness_of`.

    Raises
    ------
    MaterialError, InputError
        If the layer cannot be compressed so far, or the stress cannot be that of a soft layer.
    """
    result = algebraic_result(
        thickness["loaded_thickness"],
        thickness["initial_thickness"],
        study.material.make(),
        glued=study.friction.sample_glued,
    )
    check_stress(result.maps["axial_stress"])
    return _with_thickness(result, thickness)


def stress_of(
    study: Study,
    thickness: xr.Dataset,
    progress: Callable[[Any], None] | None = None,
    *,
    estimates: bool | None = None,
    similar: Similar | None = None,
) -> StressResult:
    """Tactile stress by the computational method, with the sample in the model if it is given.

    Parameters
    ----------
    study
        Material, friction, grid and the sample.
    thickness
        As from :func:`thickness_of`.
    progress
        As for :func:`~optical_palpation.palpation.computational_stress`.
    estimates
        Whether to estimate the errors by the mesh, the sides and the inputs, which takes longer
        than the stress of a small grid itself; by default as the study says. With the sample in
        the model those by noise and mesh are always estimated.
    similar
        As for that function; a sample in the model is not guided by it.

    Raises
    ------
    InputError, MaterialError, ConvergenceError
        As that function or :func:`~optical_palpation.stiffness.sample_stress` does.
    """
    loaded = thickness["loaded_thickness"]
    if estimates is None:
        estimates = study.errors.estimates
    input_errors = study.errors.of_inputs if estimates else None
    if (sample := modelled_sample(study)) is not None:
        friction, size = study.friction, study.grid.element_size
        # all else was refused when the study was read
        assert isinstance(friction.window, float)
        assert isinstance(friction.sample, float)
        assert isinstance(size, float)
        # What was filled says nothing of the sample.
        last = loaded.where(~thickness["filled"].astype(bool))
        result = sample_stress(
            [*earlier_loads(study), last],
            thickness["initial_thickness"],
            study.material.make(),
            sample,
            window_friction=friction.window,
            sample_friction=friction.sample,
            element_size=size,
            smoothing=study.sample.stiffness_smoothing,
            input_errors=input_errors,
            threads=study.grid.threads,
            progress=progress,
        )
        return _with_thickness(result, thickness)
    result = computational_stress(
        loaded,
        thickness["initial_thickness"],
        study.material.make(),
        mesh_check=estimates,
        edge_check=estimates,
        progress=progress,
        input_errors=input_errors,
        similar=similar,
        **solver_settings(study, loaded),
    )
    return _with_thickness(result, thickness)


def solver_settings(study: Study, loaded: xr.DataArray) -> dict[str, Any]:
    """Friction, motion of the sample and grid of a study, as ``computational_stress`` takes them.

    Parameters
    ----------
    study
        The study.
    loaded
        Loaded thickness, mm, on whose pixels the motion of the sample is wanted.

    Raises
    ------
    InputError
        If the motion of the sample cannot be used.
    """
    return {
        "window_friction": study.friction.window,
        "sample_friction": study.friction.sample,
        "slip_length": study.friction.slip_length,
        "sample_motion": sample_motion(study, loaded),
        **study.grid.model_dump(),
    }


def _with_thickness(result: StressResult, thickness: xr.Dataset) -> StressResult:
    """Let what is known about the thickness go with the stress."""
    maps = result.maps
    here = {axis: maps[axis] for axis in "yx"}
    for name in ("filled", "quality"):
        if name in thickness:
            maps[name] = thickness[name].reindex(here, method="nearest")
    of_file = ("software", "software_version", "axis_order")  # a result says these itself
    maps.attrs |= {key: v for key, v in thickness.attrs.items() if key not in of_file}
    for key, value in thickness["initial_thickness"].attrs.items():
        if key.startswith("source"):
            maps.attrs[key.replace("source", "initial_thickness_input")] = value
    return result


def _measured(
    study: Study,
    side: str,
    source: VolumeInput | MapInput,
    found: Mapping[str, xr.Dataset],
    extent: Any,
) -> tuple[xr.DataArray, xr.DataArray | None]:
    """Thickness as measured, NaN where it was not, and its quality where there is one."""
    if isinstance(source, MapInput):
        given = source.model_dump(exclude={"map"})
        return read_thickness_map(study.path(source.map), layer_extent=extent, **given), None
    layer = found[side]
    seen = layer["thickness"].where(~layer["filled"])
    measured = thickness_map(seen, x=layer["x"], y=layer["y"], layer_extent=extent)
    measured.attrs |= {key: layer.attrs[key] for key in ("source", "source_sha256")}
    return measured, layer["quality"]
