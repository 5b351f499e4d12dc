"""The Python lines that do what a study does, without the study."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from optical_palpation.study.inputs import finding, reading
from optical_palpation.study.schema import MapInput, NumberInput, Study, VolumeInput


def reproducing_lines(study: Study) -> str:
    """Return Python lines that compute ``result``, the computational stress of the study.

    They are to be run in the folder of the study file.
    """
    return "\n".join(_lines(study)) + "\n"


def _lines(study: Study) -> Iterator[str]:
    grid = study.grid.model_dump(exclude_defaults=True)
    friction = {f"{side}_friction": getattr(study.friction, side) for side in ("window", "sample")}
    if study.friction.slip_length is not None:
        friction["slip_length"] = study.friction.slip_length
    yield "from optical_palpation import material, palpation, thickness"
    if any(isinstance(source, VolumeInput) for source in study.inputs.values()):
        yield "from optical_palpation.volume import open_volume"
    yield ""
    yield from _measured("loaded", study.loaded, study.layer.extent)
    if isinstance(study.unloaded, NumberInput):
        yield f"unloaded = {study.unloaded.thickness!r}"
    else:
        yield from _measured("unloaded", study.unloaded, None)
        if study.layer.registration:
            yield "shift = thickness.lateral_shift(loaded, unloaded)"
            yield "unloaded = thickness.shift_map(unloaded, shift)"
        yield 'unloaded = thickness.clean_thickness(unloaded)["thickness"]'
    yield 'loaded = thickness.clean_thickness(loaded)["thickness"]'
    law = study.material.make()
    values = law.values | {"bulk_to_shear": law.bulk_to_shear}
    yield f"silicone = material.{type(law).__name__}({_arguments(values)})"
    errors = study.errors.model_dump(exclude_defaults=True)
    if errors:
        yield f"errors = palpation.InputErrors({_arguments(errors)})"
    motion = study.sample.motion
    if isinstance(motion, str):
        yield f"motion = palpation.read_sample_motion({motion!r})"
    elif motion is not None:
        yield f"motion = palpation.uniform_motion(loaded, {motion!r})"
    yield "result = palpation.computational_stress("
    yield f"    loaded, unloaded, silicone, {_arguments(friction)},"
    yield f"    {_arguments(grid)}{'' if motion is None else ', sample_motion=motion'},"
    if errors:
        yield "    input_errors=errors,"
    yield ")"


def _measured(side: str, source: VolumeInput | MapInput, extent: object) -> Iterator[str]:
    layer = {} if extent is None else {"layer_extent": extent}
    if isinstance(source, MapInput):
        options = source.model_dump(exclude={"map"}, exclude_none=True) | layer
        yield f"{side} = thickness.read_thickness_map({_arguments(options, source.map)})"
        return
    options = finding(source)
    if source.corrections:
        options["corrections"] = source.corrections
    yield f"with open_volume({_arguments(reading(source), source.volume)}) as volume:"
    yield f"    found = thickness.find_layer({', '.join(['volume', _arguments(options)])})"
    yield f'{side} = found["thickness"].where(~found["filled"])'
    if layer:
        yield f"{side} = {side}.assign_attrs({_arguments(layer)})"


def _arguments(options: Mapping[str, object], first: str | None = None) -> str:
    named = [f"{key}={value!r}" for key, value in options.items()]
    return ", ".join(([] if first is None else [repr(first)]) + named)
