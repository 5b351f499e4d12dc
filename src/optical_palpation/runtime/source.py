"""A digest of the source that a result, or a compiled kernel, depends on."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection
from functools import cache
from pathlib import Path

#: Folder of the package.
PACKAGE = Path(__file__).resolve().parents[1]
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+(?P<module>[\w.]+)[ \t]+import[ \t]+(?P<names>\([^)]*\)|[^\n#]*)"
    r"|import[ \t]+(?P<modules>[^\n#]*))",
    re.M,
)


@cache
def source_digest(*parts: str) -> str:
    """SHA-256 of the source of parts of the package, and of all parts that these import.

    Parameters
    ----------
    parts
        Names of subpackages or modules, such as ``"palpation"``, or of files, such as
        ``"study/stages.py"``; of a file what it imports does not count.

    Returns
    -------
    str
        Hex. Every file of a subpackage counts, templates included, so that it changes with
        anything that could change what the parts do. Comments count, too.

    Raises
    ------
    ValueError
        If there is no such part.
    """
    found: set[Path] = set()
    waiting, known = list(parts), set(parts)
    while waiting:
        files, whole = _of_part(waiting.pop())
        found.update(files)
        if whole:
            modules = {m for file in files if file.suffix == ".py" for m in _imported(file)}
            new = {m.relative_to(PACKAGE).parts[0].removesuffix(".py") for m in modules} - known
            new.discard("__init__")
            waiting += new
            known |= new
    return _digest(found)


@cache
def modules_digest(file: Path) -> str:
    """SHA-256 of the source of a module of the package, and of all modules that it imports; hex.

    Modules in which there can be nothing to compile do not count.
    """
    found, waiting = {file}, [file]
    while waiting:
        new = _imported(waiting.pop()) - found
        found |= new
        waiting += new
    compiled = [f for f in found if f.name != "errors.py" and f.parent.name != "runtime"]
    return _digest(compiled)


def _digest(files: Collection[Path]) -> str:
    total = hashlib.sha256()
    for file in sorted(files):
        content = hashlib.sha256(file.read_bytes().replace(b"\r\n", b"\n")).hexdigest()
        total.update(f"{file.relative_to(PACKAGE).as_posix()}\0{content}\n".encode())
    return total.hexdigest()


def _of_part(name: str) -> tuple[list[Path], bool]:
    """Files of a part, and whether its imports count."""
    if (folder := PACKAGE / name).is_dir():
        listed = folder.rglob("*")
        return [f for f in listed if f.is_file() and "__pycache__" not in f.parts], True
    if (module := PACKAGE / f"{name}.py").is_file():
        return [module], True
    if (file := PACKAGE / name).is_file():
        return [file], False
    raise ValueError(f"the package has no part {name!r}")


@cache
def _imported(file: Path) -> set[Path]:
    """Modules of the package that a source file imports, wherever it does so."""
    found = set()
    for match in _IMPORT.finditer(file.read_text(encoding="utf-8")):
        if match["module"]:
            module = _absolute(match["module"], file)
            names = [module]
            names += [f"{module}.{n.split()[0]}" for n in _listed(match["names"]) if n]
        else:
            names = [n.split()[0] for n in _listed(match["modules"]) if n]
        for name in names:
            first, *rest = name.split(".")
            if first == PACKAGE.name and (module_file := _module_file(rest)):
                found.add(module_file)
    return found


def _listed(names: str) -> list[str]:
    return [name.strip() for name in names.strip("() \n").split(",")]


def _absolute(module: str, file: Path) -> str:
    """Name of a module that may be given relative to the file that imports it."""
    name = module.lstrip(".")
    level = len(module) - len(name)
    if not level:
        return module
    folder = file.parents[level - 1].relative_to(PACKAGE).parts
    return ".".join([PACKAGE.name, *folder, *([name] if name else [])])


def _module_file(parts: list[str]) -> Path | None:
    path = PACKAGE.joinpath(*parts)
    if (whole := path / "__init__.py").is_file():
        return whole
    return module if parts and (module := path.with_suffix(".py")).is_file() else None
