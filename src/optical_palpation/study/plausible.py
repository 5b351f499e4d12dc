"""A study's numbers against each other, once the files are open and before they are worked on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from optical_palpation.errors import InputError, InsufficientMemoryError, MaterialError
from optical_palpation.mechanics.stack.assembly import Blocks, Mesh
from optical_palpation.palpation.memory import check_grid_memory, check_stack_memory
from optical_palpation.palpation.meshing import SLIP_LENGTHS, layer_nodes
from optical_palpation.palpation.motion import check_motion
from optical_palpation.palpation.plausibility import (
    check_count,
    check_elements,
    check_field,
    check_layer,
)
from optical_palpation.stiffness import check_sample, check_sample_elements
from optical_palpation.study.compute import thickness_of
from optical_palpation.study.inputs import by_side, earlier_loads, modelled_sample, read_motion
from optical_palpation.study.schema import MapInput, NumberInput, Study, VolumeInput
from optical_palpation.thickness import read_corrections, read_thickness_map
from optical_palpation.thickness.frames import EXTENT_SLACK, layer_extent_of
from optical_palpation.thickness.initial import check_depth


def check_study(study: Study, inputs: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse numbers that cannot be those of a layer, or do not fit to the files or each other.

    Parameters
    ----------
    study
        The study.
    inputs
        Facts about its files, by ``unloaded`` and ``loaded``
        (:func:`~optical_palpation.study.inputs.facts`).

    Raises
    ------
    InputError, MaterialError
        With the table of the study, the number, what it contradicts and what may have happened.
    """
    where = study.where()
    try:
        check_layer(study.material.make())
    except MaterialError as error:
        raise MaterialError(f"{study.where('[material]')}: {error}") from error
    fields, depths = {}, []
    for side, source in study.inputs.items():
        fields[side] = _field(study, source, inputs.get(side, {}))
        if isinstance(source, VolumeInput):
            start, length = _extent_of_volume(inputs[side]["metadata"])
            depths.append((length[0], f"the depth of the {side} volume"))
            _check_ranges(source, start[0], start[0] + length[0], study.where(f"[{side}]"))
            _check_corrections(study, side, source, inputs[side]["metadata"])
        else:
            depths.append((_thickest(study, source), f"the {side} layer"))
        x0, x1, y0, y1 = fields[side]
        check_field(x1 - x0, y1 - y0, study.where(f"[{side}]"))
    for depth, what in depths:
        check_depth(depth, study.where(what))
    if isinstance(study.unloaded, NumberInput):
        given = study.unloaded.thickness
        check_depth(given, study.where("unloaded.thickness"))
        depth, what = depths[0]
        if isinstance(study.loaded, VolumeInput) and given > depth:
            raise InputError(
                f"{where}: unloaded.thickness = {given:g} mm is more than {what}, {depth:g} mm; "
                "lengths are in mm"
            )
        depths.append((given, "unloaded.thickness"))
    x0, x1, y0, y1 = _layer(study, fields["loaded"])
    depth, what = min(depths)
    if study.grid.element_size is not None:
        try:
            check_elements(study.grid.element_size, (x1 - x0, y1 - y0), depth, what)
            check_count(study.grid.element_size, (x1 - x0, y1 - y0), _unloaded(study))
        except InputError as error:
            raise InputError(f"{study.where('[grid]')}: {error}") from error
    try:
        study.errors.of_inputs.check_thickness(depth)
    except InputError as error:
        raise InputError(f"{study.where('[errors]')}: {error}") from error
    slip, longest = study.friction.slip_length, SLIP_LENGTHS[1] * depth
    if slip is not None and slip > longest:
        raise InputError(
            f"{where}: friction.slip_length = {slip:g} mm is more than {SLIP_LENGTHS[1]:g} of "
            f"{what}, {longest:g} mm, above which it is no friction any more (it is in mm)"
        )
    shortest = SLIP_LENGTHS[0] * (_unloaded(study) or 0.0)
    if slip is not None and slip < shortest:
        raise InputError(
            f"{where}: friction.slip_length = {slip:g} mm is less than {SLIP_LENGTHS[0]:g} of the "
            f"unloaded layer, {shortest:g} mm, below which friction flickers (it is in mm)"
        )
    motion = read_motion(study)
    if motion is not None:
        try:
            check_motion(motion, (x0, x1, y0, y1))
        except InputError as error:
            raise InputError(f"{study.where('[sample]')}: {error}") from error
    if study.sample.modelled:
        _check_sample(study)
    smoothing, widest = study.grid.imprint_smoothing, 0.25 * min(x1 - x0, y1 - y0)
    if smoothing is not None and smoothing > widest:
        raise InputError(
            f"{where}: grid.imprint_smoothing = {smoothing:g} mm is larger than a quarter of the "
            f"field of view, {widest:g} mm, and would leave no relief (it is in mm)"
        )


def check_study_memory(study: Study, inputs: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse elements that the memory of this machine cannot hold.

    A layer that has to be found in a volume is taken to be as thin as an element: it is no less.

    Raises
    ------
    InsufficientMemoryError
    """
    size = study.grid.element_size
    if size is None:
        return
    extent = _layer(study, _field(study, study.loaded, inputs["loaded"]))
    x, y, z = (float(v) for v in np.broadcast_to(size, 3))
    thickness = _unloaded(study) or z
    try:
        if study.sample.modelled:
            check_stack_memory(even_blocks(study, extent, thickness), Mesh(z))
            return
        edges = study.grid.edges
        depth, nodes_y, nodes_x = layer_nodes(extent, thickness, (x, y, z), edges)
        shape = len(depth) - 1, len(nodes_y) - 1, len(nodes_x) - 1
        check_grid_memory(shape, (x, y, z), study.grid.solver)
    except InsufficientMemoryError as error:
        raise InsufficientMemoryError(f"{study.where('[grid]')}: {error}") from error


def even_blocks(
    study: Study, extent: tuple[float, float, float, float], thickness: float
) -> Blocks:
    """Layer and sample of a study as if both were flat: as many elements as they will have, mm."""
    sample, law = study.sample, study.material.make()
    assert sample.thickness is not None
    x0, x1, y0, y1 = extent
    return Blocks(
        extent=extent,
        thickness=lambda x, _: np.full(np.shape(x), thickness),
        law=law,
        sample_size=sample.size or (x1 - x0, y1 - y0),
        sample_thickness=sample.thickness,
        sample_law=law,
        relief=lambda x, _: np.zeros(np.shape(x)),
        friction=(0.0, 0.0, 0.0),
        travel=0.0,
    )


def _check_sample(study: Study) -> None:
    """Refuse a sample that does not fit to the layer, whose thickness is known if it is a map."""
    where = study.where("[sample]")
    if study.sample.size is not None:
        check_field(*study.sample.size, f"{where}, size")
    sample = modelled_sample(study)
    if sample is None or by_side(study):
        return  # in volumes the layer has to be found first
    try:
        thickness = thickness_of(study, {})
    except InputError as error:
        raise InputError(f"{study.where()}: {error}") from error
    try:
        loads = [*earlier_loads(study), thickness["loaded_thickness"]]
        check_sample(sample, loads, thickness["initial_thickness"], study.material.make())
        x0, x1, y0, y1 = layer_extent_of(loads[-1])
        if isinstance(size := study.grid.element_size, float):
            check_sample_elements(size, (x1 - x0, y1 - y0), sample.size)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _extent_of_volume(metadata: Mapping[str, Any]) -> tuple[list[float], list[float]]:
    """First position and length along z, y and x, mm."""
    steps = zip(metadata["shape"], metadata["spacing"], strict=True)
    return list(metadata["origin"]), [(count - 1) * step for count, step in steps]


def _field(
    study: Study, source: VolumeInput | MapInput, facts: Mapping[str, Any]
) -> tuple[float, float, float, float]:
    """x0, x1, y0, y1 of a volume or map, mm."""
    if isinstance(source, VolumeInput):
        (_, y0, x0), (_, length_y, length_x) = _extent_of_volume(facts["metadata"])
        return x0, x0 + length_x, y0, y0 + length_y
    read = _read(study, source)
    x, y = read["x"].values, read["y"].values
    return float(x[0]), float(x[-1]), float(y[0]), float(y[-1])


def _thickest(study: Study, source: MapInput) -> float:
    return float(np.nanmax(_read(study, source).values))


def _unloaded(study: Study) -> float | None:
    """Thickness of the unloaded layer; None where it has to be found in a volume first."""
    if isinstance(study.unloaded, NumberInput):
        return study.unloaded.thickness
    if isinstance(study.unloaded, MapInput):
        return float(np.nanmedian(_read(study, study.unloaded).values))
    return None


def _read(study: Study, source: MapInput) -> Any:
    return read_thickness_map(study.path(source.map), **source.model_dump(exclude={"map"}))


def _check_ranges(source: VolumeInput, shallow: float, deep: float, where: str) -> None:
    for key in ("window_range", "sample_range"):
        given = getattr(source, key)
        if given is not None and (given[0] > deep or given[1] < shallow):
            raise InputError(
                f"{where}: {key} = {list(given)} mm lies outside the volume, which is {shallow:g} "
                f"to {deep:g} mm deep; the search range is in mm"
            )
    if isinstance(source.window, float) and not shallow <= source.window <= deep:
        raise InputError(
            f"{where}: window = {source.window:g} mm lies outside the volume, which is {shallow:g} "
            f"to {deep:g} mm deep"
        )


def _check_corrections(
    study: Study, side: str, source: VolumeInput, metadata: Mapping[str, Any]
) -> None:
    if source.corrections is None:
        return
    try:
        fixes = read_corrections(study.path(source.corrections))
        fixes.check_inside(metadata["origin"], metadata["spacing"], metadata["shape"])
    except InputError as error:
        raise InputError(f"{study.where(f'[{side}]')}: {error}") from error


def _layer(study: Study, field: tuple[float, ...]) -> tuple[float, float, float, float]:
    """x0, x1, y0, y1 of the part of the loaded map that the layer covers."""
    given = study.layer.extent or field
    x0, x1, y0, y1 = given
    slack = EXTENT_SLACK * max(field[1] - field[0], field[3] - field[2])
    beyond = max(field[0] - x0, x1 - field[1], field[2] - y0, y1 - field[3])
    if beyond > slack or not (x0 < x1 and y0 < y1):
        raise InputError(
            f"{study.where()}: layer.extent = {list(given)} mm (x0, x1, y0, y1) must lie within "
            f"the loaded map, x {field[0]:g} to {field[1]:g} mm, y {field[2]:g} to {field[3]:g} "
            'mm. Leave it out if the layer goes on beyond, and see to "edges" in [grid]'
        )
    return x0, x1, y0, y1
