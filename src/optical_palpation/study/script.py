"""The Python lines that do what a study does, without the study."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from optical_palpation.study.inputs import finding, reading
from optical_palpation.study.schema import MapInput, Material, NumberInput, Study, VolumeInput

_WIDTH = 88


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
    modelled = study.sample.modelled
    errors = study.errors.model_dump(exclude_defaults=True) if study.errors.estimates else {}
    packages = ["material", "stiffness" if modelled else "palpation", "thickness"]
    if errors and modelled:
        packages.insert(1, "palpation")
    yield f"from optical_palpation import {', '.join(packages)}"
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
    if modelled:
        yield "cleaned = thickness.clean_thickness(loaded)"
        yield 'loaded = cleaned["thickness"].where(~cleaned["filled"])'
    else:
        yield 'loaded = thickness.clean_thickness(loaded)["thickness"]'
    yield f"silicone = {_law(study.material)}"
    if errors:
        yield from _call("errors = palpation.InputErrors", _parts(errors))
    if modelled:
        yield from _with_sample(study, friction)
        return
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
    elif not study.errors.estimates:
        yield "    mesh_check=False, edge_check=False, input_errors=None,"
    yield ")"


def _with_sample(study: Study, friction: Mapping[str, object]) -> Iterator[str]:
    given, grid = study.sample, study.grid
    options = given.model_dump(include={"thickness", "plate_friction", "total_force", "size"})
    options = {"compression": given.compression} | options
    for name in ("compression", "total_force"):
        if given.earlier and options[name] is not None:
            options[name] = [getattr(load, name) for load in (*given.earlier, given)]
    options = {
        key: value for key, value in options.items() if value is not None or key == "compression"
    }
    parts = _parts(options)
    if given.earlier:
        yield "loads = []"
        layer = {} if study.layer.extent is None else {"layer_extent": study.layer.extent}
        for load in given.earlier:
            reading = {key: of for key, of in load.reading.items() if of is not None} | layer
            yield from _call("earlier = thickness.read_thickness_map", _parts(reading, load.map))
            yield "cleaned = thickness.clean_thickness(earlier)"
            yield 'loads.append(cleaned["thickness"].where(~cleaned["filled"]))'
        yield "loaded = [*loads, loaded]"
    if given.relief == "flat":
        parts.append('relief="flat"')
    elif given.relief is not None:
        yield f"relief = thickness.read_height_map({given.relief!r})"
        parts.append("relief=relief")
    if given.law == "layer":
        parts.append("law=silicone")
    elif isinstance(given.law, Material):
        parts.append(f"law={_law(given.law)}")
    yield from _call("sample = stiffness.Sample", parts)
    solving: dict[str, object] = {"element_size": grid.element_size}
    if given.stiffness_smoothing is not None:
        solving["smoothing"] = given.stiffness_smoothing
    if grid.threads is not None:
        solving["threads"] = grid.threads
    yield "result = stiffness.sample_stress("
    yield f"    loaded, unloaded, silicone, sample, {_arguments(friction)},"
    yield f"    {_arguments(solving)},"
    if not study.errors.estimates:
        yield "    input_errors=None,"
    elif study.errors.model_dump(exclude_defaults=True):
        yield "    input_errors=errors,"
    yield ")"


def _law(given: Material) -> str:
    law = given.make()
    values = law.values | {"bulk_to_shear": law.bulk_to_shear}
    return f"material.{type(law).__name__}({_arguments(values)})"


def _measured(side: str, source: VolumeInput | MapInput, extent: object) -> Iterator[str]:
    layer = {} if extent is None else {"layer_extent": extent}
    if isinstance(source, MapInput):
        options = source.model_dump(exclude={"map"}, exclude_none=True) | layer
        yield from _call(f"{side} = thickness.read_thickness_map", _parts(options, source.map))
        return
    options = finding(source)
    if source.corrections:
        options["corrections"] = source.corrections
    yield from _call("with open_volume", _parts(reading(source), source.volume), " as volume:")
    yield from _call("    found = thickness.find_layer", ["volume", *_parts(options)])
    yield f'{side} = found["thickness"].where(~found["filled"])'
    if layer:
        yield f"{side} = {side}.assign_attrs({_arguments(layer)})"


def _arguments(options: Mapping[str, object], first: str | None = None) -> str:
    return ", ".join(_parts(options, first))


def _parts(options: Mapping[str, object], first: str | None = None) -> list[str]:
    named = [f"{key}={value!r}" for key, value in options.items()]
    return ([] if first is None else [repr(first)]) + named


def _call(before: str, parts: Sequence[str], after: str = "") -> Iterator[str]:
    """A call on one line, or its arguments on lines of their own where it would be too long."""
    whole = f"{before}({', '.join(parts)}){after}"
    if len(whole) <= _WIDTH:
        yield whole
        return
    indent = before[: len(before) - len(before.lstrip())]
    yield f"{before}("
    line = ""
    for part in parts:
        if line and len(indent) + len(line) + len(part) + 6 > _WIDTH:
            yield f"{indent}    {line}"
            line = ""
        line = f"{line} {part},".lstrip()
    yield f"{indent}    {line}"
    yield f"{indent}){after}"
