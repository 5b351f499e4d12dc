"""Reading a study file, and saying in its own words what is wrong with it."""

from __future__ import annotations

import difflib
import hashlib
import json
import os
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from optical_palpation.arguments import check_instance, in_words, toml_fault
from optical_palpation.errors import InputError, MaterialError, OutputError
from optical_palpation.files import replacing
from optical_palpation.palpation.input_errors import OF_SAMPLE
from optical_palpation.study.schema import (
    MapInput,
    NumberInput,
    Study,
    Table,
    VolumeInput,
    kind_of_input,
)

#: Keys of a table of which one stands in for the others.
_ALTERNATIVES = {
    "unloaded": ("volume", "map", "thickness"),
    "loaded": ("volume", "map"),
    "grid": ("element_size", "accuracy"),
}
#: What the template holds in place of values that only the user knows.
PLACEHOLDER = "FILL IN"


def write_template(path: str | Path) -> None:
    """Write a commented study file to begin with.

    Raises
    ------
    OutputError
        If there is such a file already, or it cannot be written.
    """
    if os.path.exists(path):
        raise OutputError(f"{path}: exists already and is left as it is; give another name")
    text = files("optical_palpation.study").joinpath("template.toml").read_text(encoding="utf-8")
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_study(path: str | Path, changes: Mapping[str, object] | None = None) -> Study:
    """Read and check a study file.

    Keys of ``[volumes]`` hold for both volumes; those of ``[unloaded]`` and ``[loaded]`` go first.

    Parameters
    ----------
    path
        TOML, as :func:`write_template` makes it. Files that it names are sought from its folder.
    changes
        Values to put in place of those of the file, by table and key, ``"friction.window"``.

    Raises
    ------
    InputError
        If the file cannot be read, or naming everything in it that cannot be used: table, key,
        value, and what would be right.
    """
    path = Path(path)
    if os.path.isdir(path):
        inside = sorted(path.glob("*.toml"))
        hint = f", such as {inside[0]}" if inside else ""
        raise InputError(f"{path}: is a folder; give a study file{hint}")
    kind = (
        ""
        if path.suffix.lower() == ".toml"
        else (
            "; a study file is text that names the volumes, and 'optical-palpation new study.toml' "
            "writes one to fill in"
        )
    )
    try:
        content = path.read_bytes()
        given = tomllib.loads(content.decode("utf-8-sig"))
    except FileNotFoundError:
        raise InputError(
            f"{path}: no such file; 'optical-palpation new {path}' writes one to begin with"
        ) from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        fault = toml_fault(error, content.decode("utf-8-sig"))
        raise InputError(f"{path}: is no valid TOML: {fault}{kind}") from error
    except UnicodeDecodeError as error:
        number = content[: error.start].count(b"\n") + 1
        raise InputError(
            f"{path}: line {number} is not UTF-8{kind or '; save the file as text in UTF-8'}"
        ) from error
    except OSError as error:
        raise InputError(f"{path}: the study file cannot be read ({error.strerror})") from error
    given = changed(given, changes or {})
    if unfilled := list(_unfilled(given)):
        raise InputError(f"{path}: these have still to be filled in:\n" + "\n".join(unfilled))
    study = make_study(given, path)
    if not changes:
        study._sha256 = hashlib.sha256(content).hexdigest()
    return study


def plain(value: Any) -> Any:
    """Return NumPy's numbers and arrays, and tuples, as TOML takes them."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, tuple):
        return list(value)
    return value


def changed(given: Mapping[str, Any], changes: Mapping[str, object]) -> dict[str, Any]:
    """Return tables with some values replaced; those that a change leaves alone stay.

    Parameters
    ----------
    given
        Tables of a study file.
    changes
        New values by table and key, ``"friction.window"``; ``None`` takes the key away. One that
        stands in for another, as a map for a volume, or ``grid.accuracy`` for
        ``grid.element_size``, replaces that.

    Raises
    ------
    InputError
        If a change goes into something that is no table.
    """
    result = dict(given)
    for name, value in changes.items():
        check_instance(name, str, "changes", "a name such as 'friction.window'")
        *tables, key = name.split(".")
        place = result
        for table in tables:
            inner = place.get(table, {})
            if not isinstance(inner, Mapping):
                raise InputError(f"{name}: {table} is {as_toml(inner)}, no table that has keys")
            place[table] = dict(inner)
            place = place[table]
        if value is None:
            place.pop(key, None)
            continue
        alternatives = _ALTERNATIVES.get(".".join(tables), ())
        for other in alternatives if key in alternatives else ():
            if ".".join((*tables, other)) not in changes:
                place.pop(other, None)
        place[key] = value
    return result


def relocated(sample: Mapping[str, Any], name: Callable[[str, str], str]) -> dict[str, Any]:
    """Return the table of a sample with other names of the files in it.

    Parameters
    ----------
    sample
        The table ``[sample]``.
    name
        Function of what a file is ("motion", "relief", "earlier-1") and its name, returns another.
    """
    whole = dict(sample)
    for key in ("motion", "relief"):
        of = whole.get(key)
        if isinstance(of, str | os.PathLike) and not (key == "relief" and of == "flat"):
            whole[key] = name(key, str(of))
    loads = whole.get("earlier")
    if isinstance(loads, list | tuple):
        whole["earlier"] = [
            {**load, "map": name(f"earlier-{n}", str(load["map"]))}
            if isinstance(load, Mapping) and isinstance(load.get("map"), str | os.PathLike)
            else load
            for n, load in enumerate(loads, start=1)
        ]
    return whole


def as_toml(value: Any) -> str:
    """Return a value as a study file writes it, on one line."""
    if isinstance(value, Mapping):
        inner = ", ".join(f"{key} = {as_toml(v)}" for key, v in value.items())
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(as_toml, value))}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if value is None:
        return "nothing"
    return str(value) if isinstance(value, int | float) else in_words(value)


def make_study(given: Mapping[str, Any], file: Path, *, in_memory: bool = False) -> Study:
    """Check the tables of a study.

    Parameters
    ----------
    given
        What the file says, as :mod:`tomllib` reads it.
    file
        The study file, from whose folder paths count.
    in_memory
        There is no such file, and errors name what was given.

    Raises
    ------
    InputError
        As :func:`read_study`.
    """
    common = given.get("volumes", {})
    merged = dict(given)
    for side in ("unloaded", "loaded"):
        own = given.get(side)
        if isinstance(own, dict) and isinstance(common, dict) and "volume" in own:
            merged[side] = common | own
    try:
        study = Study.model_validate(merged)
    except ValidationError as error:
        problems = "\n".join(dict.fromkeys(f"  {line}" for line in _problems(error, given)))
        raise InputError(f"{'study' if in_memory else file}: cannot be used:\n{problems}") from None
    study._file, study._in_memory = file, in_memory
    said = json.dumps(given, sort_keys=True, default=str)
    study._sha256 = hashlib.sha256(said.encode("utf-8", "surrogatepass")).hexdigest()
    _check(study)
    return study


def _unfilled(given: Mapping[str, Any], tables: tuple[str, ...] = ()) -> Iterator[str]:
    """Keys that still hold what the template holds in place of a value."""
    for key, value in given.items():
        if isinstance(value, Mapping):
            yield from _unfilled(value, (*tables, key))
        elif value == PLACEHOLDER:
            yield f"  {'.'.join((*tables, key))}{_hint([*tables, key])}"


def _check(study: Study) -> None:
    """Refuse what is wrong with more than a single value, before anything is computed."""
    try:
        study.material.make()
    except MaterialError as error:
        raise MaterialError(f"{study.where('[material]')}: {error}") from None
    if study.layer.registration and isinstance(study.unloaded, NumberInput):
        raise InputError(
            f"{study.where()}: layer.registration = true needs an unloaded volume or map, not a "
            "number"
        )
    earlier = [
        (f"sample.earlier[{n}]", load) for n, load in enumerate(study.sample.earlier, start=1)
    ]
    for table, values in (*study.inputs.items(), ("sample", study.sample), *earlier):
        for key in ("volume", "map", "corrections", "motion", "relief"):
            name = getattr(values, key, None)
            if key == "relief" and name == "flat":
                continue
            if not isinstance(name, str):
                continue
            path = study.path(name)
            if not os.path.exists(path):
                whence = "; paths count from the folder of the study file"
                raise InputError(
                    f"{study.where()}: {table}.{key} = {as_toml(name)}: there is no {path}"
                    + ("" if os.path.isabs(name) else whence)
                )
            if key != "volume" and os.path.isdir(path):  # volumes can be folders
                raise InputError(
                    f"{study.where()}: {table}.{key} = {as_toml(name)}: is a folder; name a file "
                    "in it"
                )
    _check_sample(study)


def _check_sample(study: Study) -> None:
    """Refuse a sample that is half given, or does not go with the rest of the study."""
    given = study.sample.model_dump(exclude_defaults=True)
    needed = {
        "thickness": "mm",
        "compression": "mm, or total_force, mN",
        "plate_friction": "Coulomb coefficient",
    }
    of_model = sorted(given.keys() - {"motion"})
    if not of_model:
        of_sample = [name for name in OF_SAMPLE if name in study.errors.model_fields_set]
        if of_sample:
            raise InputError(
                f"{study.where('[errors]')}: {', '.join(of_sample)}: only with the sample in the "
                "model ([sample] with its thickness); leave it out"
            )
        return
    where = study.where("[sample]")
    known = given.keys() | ({"compression"} if "total_force" in given else set())
    if absent := [f"{key} ({unit})" for key, unit in needed.items() if key not in known]:
        raise InputError(
            f"{where}: {', '.join(absent)}: missing; a sample that goes into the model, as "
            f"{of_model[0]} says, needs {', '.join(needed)}"
        )
    of_loads = {
        name: [getattr(load, name) is not None for load in (*study.sample.earlier, study.sample)]
        for name in ("compression", "total_force")
    }
    if half := [name for name, there in of_loads.items() if any(there) and not all(there)]:
        raise InputError(
            f"{where}: {', '.join(half)}: given for some of the {len(study.sample.earlier) + 1} "
            "loads; each of [[sample.earlier]] and [sample] itself must have it, or none"
        )
    if "motion" in given:
        raise InputError(
            f"{where}: motion and thickness exclude each other: with the sample in the model its "
            "motion is found, and need not be given"
        )
    try:
        study.sample.make_law(study.material.make())
    except MaterialError as error:
        raise MaterialError(f"{study.where()}: sample.law: {error}") from None
    friction, grid = study.friction, study.grid
    refused = {
        'friction.window = "glued"': friction.window == "glued",
        'friction.sample = "glued"': friction.sample == "glued",
        "friction.slip_length": friction.slip_length is not None,
        f"grid.edges = {as_toml(grid.edges)}": grid.edges != "free",
        "grid.imprint_smoothing": grid.imprint_smoothing is not None,
        f"grid.solver = {as_toml(grid.solver)}": grid.solver != "auto",
        "grid.element_size of three numbers": isinstance(grid.element_size, tuple),
        "grid.accuracy": grid.accuracy is not None,
    }
    if found := [what for what, there in refused.items() if there]:
        raise InputError(
            f"{study.where()}: {', '.join(found)}: not with the sample in the model ([sample]), "
            "where the layer's sides are free, both of its faces slip, no imprint is smoothed and "
            "the elements have one size: leave it out"
        )


_HINTS = {
    "c10": "kPa",
    "c01": "kPa",
    "c20": "kPa",
    "c30": "kPa",
    "thickness": "mm",
    "motion": "the strain by which the sample spreads, 0.1 for 10 %, or a file",
    "compression": "mm, how far the plate moves after layer and sample have met",
    "plate_friction": "Coulomb coefficient between sample and plate, 0 to 2",
    "total_force": "mN, on the window",
    "relief": 'a file of the heights of the unloaded surface, or "flat"',
    "earlier": "loads before that of [loaded], each with its map and compression",
    "size": "mm, x and y",
    "law": "how stress grows with strain",
    "stiffness_smoothing": "about 0.001, next to none, to 10, next to uniform",
    "slip_length": "mm",
    "element_size": "mm, one number or three for x, y and z",
    "accuracy": "error of the force by the mesh, 0.02 for 2 %",
    "extent": "mm, x0, x1, y0, y1",
    "window_range": "mm, shallow and deep",
    "sample_range": "mm, shallow and deep",
    "field_of_view": "mm, x and y",
    "pixel_spacing": "mm, x and y",
    "spacing": "mm by axis, such as { z = 0.0035, y = 0.01, x = 0.01 }",
    "origin": "mm by axis, such as { z = 0.0, y = 0.0, x = 0.0 }",
}


def _problems(error: ValidationError, given: Mapping[str, Any]) -> Iterator[str]:
    """Say each problem in the words of the file."""
    wrong: dict[str, list[str]] = {}  # a value of several possible types has a problem with each
    for problem in error.errors(include_url=False):
        keys = [key for key in problem["loc"] if isinstance(key, str)]
        if keys[0] in ("unloaded", "loaded"):
            del keys[1:2]  # the kind of input that pydantic puts there
            if len(keys) > 1 and _in(given, "volumes", keys[1]) and not _in(given, *keys[:2]):
                continue  # inherited; it is reported where it stands
        elif keys[:2] == ["sample", "law"]:
            del keys[2:3]
        known = known_keys(keys[:-1], given)
        if problem["type"] == "extra_forbidden":
            yield f"{'.'.join(keys)} = {as_toml(problem['input'])}: {_unknown(keys, known)}"
            continue
        while len(keys) > 1 and keys[-1] not in known:  # one of several types, such as "float"
            keys.pop()
            known = known_keys(keys[:-1], given)
        key = ".".join(keys)
        if problem["type"] == "one_of_two":
            yield f"{key}: takes {problem['msg']}{_hint([key, 'accuracy'])}, one of them"
        elif problem["type"] == "missing" and isinstance(problem["loc"][-1], str):
            yield f"{key}: is missing{_hint(keys)}"
        elif problem["type"] in ("model_type", "dict_type", "model_attributes_type"):
            yield f"{key} = {as_toml(problem['input'])}: must be a table{_hint(keys)}"
        else:
            text = _length(problem, error) or _WORDS.get(problem["type"])
            text = text or re.sub("(Input|Value) should be ", "", problem["msg"])
            texts = wrong.setdefault(f"{key} = {as_toml(_value(given, keys))}{_hint(keys)}", [])
            texts.append(text)
    for start, texts in wrong.items():
        yield f"{start}: must be {', or '.join(dict.fromkeys(texts))}"


def _in(given: Mapping[str, Any], table: str, key: str) -> bool:
    return isinstance(given.get(table), dict) and key in given[table]


def _value(given: Any, keys: list[str]) -> Any:
    for key in keys:
        given = given.get(key) if isinstance(given, dict) else None
    return given


def _length(problem: Any, error: ValidationError) -> str:
    """Say how long an array must be, where that is the problem; else ""."""
    if problem["type"] == "too_long":
        return f"an array of {problem['ctx']['max_length']}"
    if problem["type"] != "missing":
        return ""
    *array, _ = problem["loc"]
    absent = [e["loc"] for e in error.errors(include_url=False) if e["type"] == "missing"]
    return f"an array of {1 + max(int(last) for *of, last in absent if of == array)}"


_WORDS = {
    "tuple_type": "an array",
    "bool_type": "true or false",
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "text in quotes",
    "string_too_short": "text that is not empty",
}
_OR_NUMBER = {"loaded": "", "unloaded": " or the thickness in mm"}
_TABLES = {
    "material": "takes law, and its coefficients in kPa, such as c10 and c01",
    "friction": "takes window and sample, coefficients of friction or 'glued'",
    "grid": "takes element_size in mm, or accuracy",
}


def _hint(keys: list[str]) -> str:
    if keys in (["unloaded"], ["loaded"], ["loaded", "volume"], ["unloaded", "volume"]):
        return f"; [{keys[0]}] takes a volume or a map{_OR_NUMBER[keys[0]]}"
    if keys[0] in ("title", "outputs"):
        return ""
    if len(keys) == 1 and keys[0] in _TABLES:
        return f"; [{keys[0]}] {_TABLES[keys[0]]}"
    return f" ({_HINTS[keys[-1]]})" if keys[-1] in _HINTS else ""


def _unknown(keys: list[str], known: list[str]) -> str:
    """Say that a key is unknown, and which one may have been meant."""
    where = f"[{'.'.join(keys[:-1])}]" if len(keys) > 1 else "the study"
    if keys[0] in ("unloaded", "loaded") and keys[-1] in ("volume", "map", "thickness"):
        return f"{where} takes a volume or a map{_OR_NUMBER[keys[0]]}, and one of them"
    near = difflib.get_close_matches(keys[-1], known, 1) if len(keys) > 1 else meant_by(keys[0])
    meant = f"did you mean {' or '.join(near)}?" if near else f"known there are {', '.join(known)}"
    return f"{where} has no such key; {meant}"


def meant_by(name: str) -> list[str]:
    """Return the table whose name comes near, or else the keys of tables, ``friction.window``."""
    tables = list(Study.model_fields)
    if near := difflib.get_close_matches(name, tables, 1):
        return near
    keys = {table: all_keys([table]) for table in tables}
    for side in ("unloaded", "loaded"):  # what both have in common stands in [volumes]
        keys[side] = [key for key in keys[side] if key not in keys["volumes"]]
    near = difflib.get_close_matches(name, {key for of in keys.values() for key in of}, 1)
    return [f"{table}.{key}" for key in near for table in tables if key in keys[table]]


def fault_of_name(name: str) -> str:
    """Say why no study has a value of this name, such as ``friction.windw``; "" if one has it."""
    *tables, key = name.split(".")
    known = all_keys(tables)
    if not known:
        return fault_of_name(".".join(tables)) or f"{'.'.join(tables)} is no table that has keys"
    if key not in known:
        return _unknown([*tables, key], known)
    if not tables and (inner := all_keys([key])):
        such = [f"{key}.{one}" for one in _ALTERNATIVES.get(key, inner[:2])]
        return f"{key} is a table; did you mean {' or '.join(such)}?"
    return ""


def all_keys(tables: list[str]) -> list[str]:
    """Keys that the table at `tables` may hold, whatever kind of input it is."""
    side = tables[0] if tables else ""
    if side not in ("unloaded", "loaded"):
        return known_keys(tables, {})
    kinds = [known_keys(tables, {side: {kind: None}}) for kind in _ALTERNATIVES[side]]
    return list(dict.fromkeys(key for keys in kinds for key in keys))


def known_keys(keys: list[str], given: Mapping[str, Any]) -> list[str]:
    """Keys that the table at `keys` may hold."""
    model: Any = Study
    for key in keys:
        if key in ("unloaded", "loaded"):
            kinds = {"volume": VolumeInput, "map": MapInput, "thickness": NumberInput}
            model = kinds[kind_of_input(given.get(key))]
        else:
            field = model.model_fields.get(key) if model else None
            types = [field.annotation, *getattr(field.annotation, "__args__", ())] if field else []
            bare = [getattr(t, "__origin__", t) for t in types]  # without Annotated
            model = next((t for t in bare if isinstance(t, type) and issubclass(t, Table)), None)
    return list(model.model_fields) if model else []
