"""Fuzz the readers with damaged files.

    python benchmarks/fuzz_readers.py --seconds 600 --seed 1
    python benchmarks/fuzz_readers.py --seconds 1800 --families map-nc4 volume-netcdf --untrusted

Small valid files of every format (those of the tests) are damaged at random: bits, bytes, integers,
truncation, splicing; and with knowledge of the format: numbers in XML, JSON, TOML and ``.npy``
headers, members within zip archives that are packed again, the content of gzip and MATLAB zlib
streams. Each is read whole, in a process of its own so that a crash is seen too. Anything
but success or an InputError is a finding, and so is a case above the limits of time and memory.
Findings are kept in ``--keep``. HDF5 files are opened directly, as by default, or with
``--untrusted`` tried out first in yet another process.
"""

from __future__ import annotations

import argparse
import collections
import gzip
import io
import json
import random
import re
import shutil
import sys
import tempfile
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import numpy as np
import tifffile
from PIL import Image

import map_files
import study_case
import volume_samples
from volume_sandbox import Sandbox

TIME_LIMIT, MEMORY_LIMIT = 5.0, 500 * 2**20
NUMBERS = [
    b"0",
    b"-1",
    b"1",
    b"2",
    b"7",
    b"65536",
    b"2147483648",
    b"99999999999",
    b"1e400",
    b"nan",
    b"-0.0",
    b"",
]
INTEGERS = [
    0,
    1,
    2,
    3,
    7,
    127,
    128,
    255,
    2**15,
    2**16 - 1,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**40,
    2**63,
    2**64 - 1,
]


def damaged(data: bytes, others: list[bytes], rng: random.Random, depth: int = 0) -> bytes:
    """One damaged version of a file's content."""
    if depth < 2 and rng.random() < 0.5:
        inner = _inside(data, others, rng, depth)
        if inner is not None:
            return inner
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        data = _damage_once(data, others, rng)
    return data


def _inside(data: bytes, others: list[bytes], rng: random.Random, depth: int) -> bytes | None:
    """Damage what a container holds, and pack it again so that the container is sound."""
    try:
        if data.startswith(b"PK\x03\x04"):
            return _repacked(data, others, rng, depth)
        if data.startswith(b"\x1f\x8b"):
            return gzip.compress(damaged(gzip.decompress(data), others, rng, depth + 1), 1)
        if data.startswith(b"MATLAB 5"):
            return _mat_repacked(data, others, rng, depth)
    except (zlib.error, zipfile.BadZipFile, OSError, EOFError, IndexError):
        pass
    return None


def _repacked(data: bytes, others: list[bytes], rng: random.Random, depth: int) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(info, archive.read(info)) for info in archive.infolist()]
    target = rng.randrange(len(members))
    out = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w") as archive:
        warnings.simplefilter("ignore")
        for number, (info, content) in enumerate(members):
            name, copies = info.filename, 1
            if number == target:
                action = rng.random()
                if action < 0.8:
                    content = damaged(content, others, rng, depth + 1)
                elif action < 0.9:
                    name = rng.choice(["../", "/", "C:\\", "data/", "x" * 300]) + name
                else:
                    copies = rng.choice((0, 2))
            member = zipfile.ZipInfo(name)
            member.compress_type = rng.choice(
                (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2)
            )
            for _ in range(copies):
                archive.writestr(member, content)
    return out.getvalue()


def _mat_repacked(data: bytes, others: list[bytes], rng: random.Random, depth: int) -> bytes:
    position, out = 128, [data[:128]]
    while position < len(data):
        kind, size = (
            int.from_bytes(data[position + o : position + o + 4], "little") for o in (0, 4)
        )
        body = data[position + 8 : position + 8 + size]
        if kind == 15 and rng.random() < 0.6:
            body = zlib.compress(damaged(zlib.decompress(body), others, rng, depth + 1))
        out += [kind.to_bytes(4, "little"), len(body).to_bytes(4, "little"), body]
        position += 8 + size
    return b"".join(out)


def _damage_once(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    if not data:
        return rng.randbytes(rng.randrange(64))
    buffer = bytearray(data)
    # Headers lie at the start more often than not.
    at = rng.randrange(min(len(data), rng.choice((64, 512, 4096, 10**9))))
    match rng.randrange(9):
        case 0:
            buffer[at] ^= 1 << rng.randrange(8)
        case 1:
            buffer[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        case 2 | 3:
            size, order = rng.choice((1, 2, 2, 4, 4, 4, 8)), rng.choice(("little", "big"))
            at -= at % rng.choice((1, 2, size))
            value = (
                rng.choice(INTEGERS)
                if rng.random() < 0.7
                else int.from_bytes(data[at : at + size], order) + rng.randint(-3, 3)
            )
            buffer[at : at + size] = (value % 256**size).to_bytes(size, order)
        case 4:
            del buffer[rng.choice((at, rng.randrange(len(data)))) :]
        case 5:
            del buffer[at : at + rng.choice((1, 2, 4, 8, 100))]
        case 6:
            piece = buffer[at : at + rng.choice((1, 4, 8, 100))]
            buffer[at:at] = piece * rng.choice((1, 2, 50))
        case 7:
            other = rng.choice(others)
            start = rng.randrange(max(1, len(other)))
            piece = other[start : start + rng.choice((4, 16, 200))]
            buffer[at : at + len(piece)] = piece
        case 8:
            found = list(re.finditer(rb"-?[0-9]+(\.[0-9]+)?", data[:100_000]))
            if found:
                number = rng.choice(found)
                buffer[number.start() : number.end()] = rng.choice(NUMBERS)
    return bytes(buffer)


class Sample(NamedTuple):
    """A valid file: its family, what reads it, the path and the options."""

    family: str
    what: str
    path: Path
    facts: dict[str, Any]


#: By family: what writes a file into a folder and returns what reads it, its path and options.
Write = Callable[[Path], tuple[str, Path, dict[str, Any]]]


def families() -> dict[str, list[Write]]:
    """Writers of all valid files, by family: ``map-`` or ``volume-`` and a format, or a name."""

    def of_volume(writer: Any) -> Write:
        return lambda folder: ("volume", *writer(folder, volume_samples.volume()))

    def of_map(case: map_files.Case) -> Write:
        return lambda folder: ("map", case.write(folder), case.options)

    found: dict[str, list[Write]] = {
        f"volume-{name}": [of_volume(writer)] for name, writer in volume_samples.WRITERS.items()
    }
    for name, case in map_files.CASES.items():
        if isinstance(case.answer, map_files.Read):
            found.setdefault(f"map-{name.split()[0]}", []).append(of_map(case))
    return found | {
        "motion": [_motion],
        "relief": [_relief],
        "stiffness": [_stiffness],
        "scene": [_scene],
        "uniaxial": [_uniaxial],
        "profile": [_profile],
        "corrections": [_corrections],
        "pair": [_pair],
        "study": [_study],
        "batch": [_batch_csv, _batch_toml],
        "regions": [_imagej, _napari, _outlines, *map(_labels, ("tif", "png", "npy"))],
    }


def _fields(folder: Path, what: str, names: tuple[str, ...]) -> tuple[str, Path, dict[str, Any]]:
    parts: map_files.Parts = {name: (("y", "x"), 0.01 * map_files.MAP, {}) for name in names}
    map_files.netcdf4(folder / "fields.nc", parts | map_files.COORDINATES)
    return what, folder / "fields.nc", {}


def _motion(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    return _fields(folder, "motion", ("sample_displacement_x", "sample_displacement_y"))


def _relief(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    return _fields(folder, "relief", ("height",))


def _stiffness(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    return _fields(folder, "stiffness", ("stiffness",))


def _scene(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    text = "compression = 0.1\n[layer]\nsize = [1, 1]\n[sample]\nsize = [1, 1]\nthickness = 1\n"
    text += "[[sample.relief]]\nkind = 'sinusoid'\namplitude = 0.1\nwavelength = 1.0\n"
    (folder / "scene.toml").write_text(text + "[mesh]\nelement_size = 0.1\n")
    return "scene", folder / "scene.toml", {}


def _table(folder: Path, header: str) -> Path:
    lines = [header, *(f"{-0.02 * n:g},{-0.5 * n:g}" for n in range(12))]
    (folder / "table.csv").write_text("\n".join(lines) + "\n")
    return folder / "table.csv"


def _uniaxial(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    return "uniaxial", _table(folder, "# test 1\nstrain (%),stress (kPa)"), {}


def _profile(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    path = _table(folder, "depth_mm,displacement_nm")
    path.write_text(path.read_text().replace("-", ""))
    return "profile", path, {"thickness": 0.4}


def _corrections(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    text = "anchor sample 1.20 3.40 0.512  # x y z\nexclude window 0.0 0.5 2.0 2.5\n"
    (folder / "corrections.txt").write_text(text)
    return "corrections", folder / "corrections.txt", {}


def _pair(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    volume = volume_samples.volume(dtype="complex64")
    for name in ("before.npz", "after.npz"):
        np.savez(folder / name, scan=volume, axes="zyx", spacing_mm=[0.004, 0.02, 0.01])
    return "pair", folder / "before.npz", {}


def _study(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    np.save(folder / "loaded.npy", map_files.MAP)
    loaded = 'map = "loaded.npy"\nfield_of_view = [2.0, 1.5]'
    (folder / "study.toml").write_text(study_case.map_study(loaded))
    return "study", folder / "study.toml", {}


def _batch_csv(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    rows = "name,study,friction.window\na,study.toml,0.1\nb,study.toml,0.2\n"
    (folder / "batch.csv").write_text(rows)
    return "batch", folder / "batch.csv", {}


def _batch_toml(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    text = 'study = "study.toml"\n[overrides]\n"grid.threads" = 1\n[sweep]\n'
    (folder / "batch.toml").write_text(text + '"friction.window" = [0.1, 0.2, 0.3]\n')
    return "batch", folder / "batch.toml", {}


def _imagej(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    import roifile

    outline = np.array([[1, 1], [6, 2], [4, 6]], float)
    roi = roifile.ImagejRoi.frompoints(outline, name="edge")
    roi.tofile(folder / "one.roi")
    with zipfile.ZipFile(folder / "regions.zip", "w") as archive:
        archive.writestr("one.roi", (folder / "one.roi").read_bytes())
    (folder / "one.roi").unlink()
    return "regions", folder / "regions.zip", {}


def _napari(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    rows = [f"0,polygon,{n},{y},{x}" for n, (y, x) in enumerate(((1, 1), (1, 6), (5, 4)))]
    text = "\n".join(["index,shape-type,vertex-index,axis-0,axis-1", *rows])
    (folder / "shapes.csv").write_text(text + "\n")
    return "regions", folder / "shapes.csv", {}


def _outlines(folder: Path) -> tuple[str, Path, dict[str, Any]]:
    text = "name,x_mm,y_mm\na,0.2,0.3\na,1.2,0.3\na,0.8,1.5\n"
    (folder / "outlines.csv").write_text(text)
    return "regions", folder / "outlines.csv", {}


def _labels(suffix: str) -> Write:
    labels = np.zeros((8, 9), np.uint8)
    labels[2:5, 3:7] = 1

    def write(folder: Path) -> tuple[str, Path, dict[str, Any]]:
        path = folder / f"labels.{suffix}"
        if suffix == "npy":
            np.save(path, labels)
        elif suffix == "tif":
            tifffile.imwrite(path, labels)
        else:
            Image.fromarray(labels).save(path)
        return "regions", path, {}

    return write


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--seed", type=int, default=0)
    everything = families()
    parser.add_argument("--families", nargs="*", default=[*everything], choices=[*everything])
    parser.add_argument("--untrusted", action="store_true", help="try HDF5 files out first")
    parser.add_argument("--keep", type=Path, default=None, help="folder for the files that failed")
    options = parser.parse_args()
    rng = random.Random(options.seed)
    counts: dict[str, collections.Counter[str]] = {}
    worst = {"seconds": 0.0, "MB": 0.0}
    seen: collections.Counter[str] = collections.Counter()
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        corpus: dict[str, list[Sample]] = {}
        for family in options.families:
            for number, write in enumerate(everything[family]):
                folder = root / f"{family}-{number}"
                folder.mkdir()
                what, path, facts = write(folder)
                if options.untrusted and what in ("volume", "map", "motion", "relief", "pair"):
                    facts = facts | {"untrusted": True}
                corpus.setdefault(family, []).append(Sample(family, what, path, facts))
        files = [p for p in root.rglob("*") if p.is_file()]
        others = [p.read_bytes() for p in files]
        sandbox = Sandbox()
        end = time.monotonic() + options.seconds
        cases = 0
        while time.monotonic() < end:
            kind, what, path, facts = rng.choice(corpus[rng.choice(options.families)])
            folder = root / path.relative_to(root).parts[0]
            target = rng.choice(sorted(p for p in folder.rglob("*") if p.is_file()))
            original = target.read_bytes()
            target.write_bytes(damaged(original, others, rng))
            outcome, seconds, memory = sandbox.open(path, facts, what)
            outcome = "InputError" if outcome.startswith("InputError: ") else outcome
            cases += 1
            if outcome in ("read", "InputError"):
                if seconds > TIME_LIMIT:
                    outcome = f"slow in {kind}"
                if memory > MEMORY_LIMIT:
                    outcome = f"memory in {kind}"
                worst["seconds"] = max(worst["seconds"], seconds)
                worst["MB"] = max(worst["MB"], memory / 1e6)
            counts.setdefault(kind, collections.Counter())[
                outcome if len(outcome) < 12 else "finding"
            ] += 1
            if outcome not in ("read", "InputError"):
                key = kind + " " + outcome.strip().splitlines()[-1]
                seen[key] += 1
                if seen[key] == 1:
                    print(
                        f"case {cases}: {kind}, {seconds:.1f} s, {memory / 1e6:.0f} MB\n{outcome}",
                        flush=True,
                    )
                if options.keep and seen[key] <= 3:
                    kept = options.keep / f"{kind}-{options.seed}-{cases}"
                    shutil.copytree(folder, kept)
                    (kept / "FINDING.json").write_text(
                        json.dumps(
                            {
                                "target": str(path.relative_to(folder)),
                                "what": what,
                                "facts": facts,
                                "outcome": outcome,
                            }
                        )
                    )
            target.write_bytes(original)
        sandbox.stop()
    print(f"{cases} cases in {options.seconds:.0f} s, seed {options.seed}")
    for kind, counter in sorted(counts.items()):
        print(f"  {kind:16s} " + ", ".join(f"{n} {name}" for name, n in counter.most_common()))
    print(f"slowest {worst['seconds']:.2f} s, most memory {worst['MB']:.0f} MB")
    for key, n in seen.most_common():
        print(f"FINDING x{n}: {key}")
    return 1 if seen else 0


if __name__ == "__main__":
    sys.exit(main())
