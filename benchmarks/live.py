"""Live use: the map after a change of one parameter, and maps that arrive in a folder.

    python benchmarks/live.py              a table, and docs/live.md with it
    python benchmarks/live.py --changes 5  quicker; writes nothing

Parameters of a coin's map (``../shared/data`` where it is, else one that is made) change one after
the other, 50 times: both frictions, the material, the thickness of the unloaded layer. Each is
first set to anywhere in its range, then dragged to such places in ten steps. Each map is compared
with that from scratch. Then as many maps arrive in a watched folder.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

import performance
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import Similar, computational_stress
from optical_palpation.thickness import thickness_map, write_thickness_map

PAGE = Path(__file__).resolve().parents[1] / "docs" / "live.md"
BEGIN, END = "<!-- measured by benchmarks/live.py -->", "<!-- end -->"
SIZES = 0.25, 0.125  # mm
START = {"window": 0.15, "sample": 0.1, "c10": 2.23, "thickness": performance.THICKNESS}
STEPS = 10  # in which a parameter is dragged

STUDY = """
[unloaded]
thickness = {thickness}
[loaded]
map = "none.nc"
[material]
c10 = 2.23
c01 = 0.703
[friction]
window = 0.15
sample = 0.1
[grid]
element_size = {size}
"""


def coin():
    """Loaded thickness of the coin at the resolution at which it is solved, 5 x 5 mm."""
    return performance.loaded_thickness(performance.FIELD)


def changes(count):
    """Parameters after each of `count` changes of one of them to anywhere in its range."""
    random = np.random.default_rng(7)
    now = dict(START)
    ranges = {
        "window": (0.05, 0.4),
        "sample": (0.02, 0.3),
        "c10": (1.5, 3.5),
        "thickness": (0.5, 0.52),
    }
    for _ in range(count):
        key = random.choice(list(ranges))
        now[key] = round(float(random.uniform(*ranges[key])), 4)
        yield dict(now)


def dragged(count):
    """Parameters after each of `count` small changes: as above, but in steps."""
    before = START
    for after in changes(-(-count // STEPS)):
        for part in np.linspace(0, 1, STEPS + 1)[1:]:
            yield {key: (1 - part) * before[key] + part * after[key] for key in after}
        before = after


def solve(loaded, size, given, threads, similar=None):
    """The map of these parameters, guided by the layer solved before or not."""
    return computational_stress(
        loaded,
        given["thickness"],
        MooneyRivlin(given["c10"], 0.703),
        window_friction=given["window"],
        sample_friction=given["sample"],
        element_size=size,
        threads=threads,
        mesh_check=False,  # as the plugin does
        edge_check=False,
        input_errors=None,
        similar=similar,
    )


def chain(loaded, size, changed, threads):
    """Seconds of each change, guided and from scratch in turns; largest difference; elements."""
    solve(loaded, size, START, threads, similar := Similar())  # kernels
    guided, scratch, off = [], [], []
    for given in changed:
        results = []
        for seconds, by in (guided, similar), (scratch, None):
            start = time.perf_counter()
            results.append(solve(loaded, size, given, threads, by))
            seconds.append(time.perf_counter() - start)
        live, alone = (result.maps["axial_stress"].values for result in results)
        off.append(np.sqrt(np.nanmean((live - alone) ** 2) / np.nanmean(alone**2)))
    elements = int(np.prod(results[0].maps.attrs["elements"]))
    return np.array(guided), np.array(scratch), max(off), elements


def arriving(loaded, size, count, threads, workers=1):
    """Seconds from a map in a folder to its result and the table.

    The median of maps that arrive one after the other or, with several workers, the time for all of
    them, which are there at once, by their number.
    """
    from optical_palpation.study.crew import Crew
    from optical_palpation.study.watch import Watch

    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        (here / "in").mkdir()
        (here / "study.toml").write_text(STUDY.format(size=size, thickness=performance.THICKNESS))
        watch = Watch(here / "study.toml", here / "in", settle=0.0, threads=threads)
        watch.prepare()
        random = np.random.default_rng(1)
        paths = []
        for number in range(count + workers):
            noisy = loaded.values + 5e-4 * random.standard_normal(loaded.shape)
            field = thickness_map(noisy, x=loaded["x"].values, y=loaded["y"].values)
            paths.append(here / "in" / f"{number}.nc")
            write_thickness_map(field.to_dataset(name="thickness"), paths[-1])
        first, rest = paths[:workers], paths[workers:]
        with Crew(watch, workers) as crew:
            _solved(crew, first)  # they load the kernels
            if workers == 1:
                return float(np.median([_solved(crew, [path])[0] for path in rest]))
            start = time.perf_counter()
            _solved(crew, rest)
            return (time.perf_counter() - start) / count


def _solved(crew, paths):
    """Solve files; the seconds that each took."""
    for path in paths:
        crew.solve(path)
    arrivals = []
    while len(arrivals) < len(paths):
        arrivals += crew.solved()
        time.sleep(0.001)
    if wrong := [arrival.message for arrival in arrivals if arrival.status != "done"]:
        raise RuntimeError(wrong[0])
    return [arrival.seconds for arrival in arrivals]


def table(count, threads):
    """The table of the page, in Markdown."""
    loaded = coin()
    load, workers = psutil.getloadavg()[0], len(psutil.Process().cpu_affinity())
    lines = _header(
        "elements",
        "a parameter is",
        "guided: median (s)",
        "90 % below (s)",
        "from scratch: median (s)",
        "largest difference",
    )
    in_folder = _header(
        "elements", "map in a folder: median (s)", f"maps a second, {workers} workers"
    )
    coins = [_coin_of_50_um(loaded, threads)]
    for size in SIZES:
        for how, changed in ("set anywhere", changes), ("dragged", dragged):
            guided, scratch, off, elements = chain(loaded, size, changed(count), threads)
            name = f"{1000 * size:.0f} um ({elements:,})"
            numbers = np.median(guided), np.percentile(guided, 90), np.median(scratch)
            lines.append(_row([name, how, *(f"{n:.2f}" for n in numbers), f"{100 * off:.2g} %"]))
            print(lines[-1], flush=True)
            coins.append(_coin_of_50_um(loaded, threads))
        one = arriving(loaded, size, max(count // 2, 2), threads)
        beside = 1 / arriving(loaded, size, max(count, 2 * workers), threads, workers)
        in_folder.append(_row([name, f"{one:.2f}", f"{beside:.1f}"]))
        print(in_folder[-1], flush=True)
    used = threads or workers
    with_others = ", so others ran beside it" if load > 0.5 else ""
    lines += [
        "",
        *in_folder,
        "",
        f"{used} thread{'s' if used > 1 else ''} of {psutil.cpu_count()} cores, load {load:.1f} "
        f"before the measurement{with_others}. The coin at 50 um, the measure of a machine, took "
        f"{np.median(coins):.1f} s from scratch in the same run.",
    ]
    return "\n".join(lines)


def _coin_of_50_um(loaded, threads):
    """Seconds of a large layer, by which times of different machines are compared."""
    start = time.perf_counter()
    performance.solve(loaded, 0.05, threads=threads)
    return time.perf_counter() - start


def _header(*columns):
    return [_row(columns), _row("---" for _ in columns)]


def _row(cells):
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--changes", type=int, default=50)
    parser.add_argument("--threads", type=int)
    asked = parser.parse_args()
    found = table(asked.changes, asked.threads)
    print(found)
    if asked.changes >= 50:
        text = PAGE.read_text(encoding="utf-8")
        before, after = text.split(BEGIN)[0], text.split(END)[1]
        PAGE.write_text(f"{before}{BEGIN}\n\n{found}\n\n{END}{after}", encoding="utf-8")
