"""A large field in tiles: time, memory of each process, and what the seams are off by.

    python benchmarks/field.py [--size 20] [--coarse 0.1] [--fine 0.025] [--tile 3] [--workers 2]
        [--whole] [--output field-benchmark]

A square field of a layer 0.5 mm thick on a random relief, solved by the commands as a user would
give them: ``stress`` for the coarse whole, ``submodel --tile`` for the field. Told are time by the
clock, processor time, the peak memory of the largest process of each command, the difference of
neighbouring tiles in their overlaps (before it is blended), and how rough the blended map is there
compared with elsewhere: second differences of the axial stress across seams over those in the same
direction away from them (root mean squares; 1 is no seam). With ``--whole`` the field is also
solved as one mesh, and the error is that against it, in the overlaps and elsewhere.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import xarray as xr
from scipy.ndimage import gaussian_filter

from optical_palpation.present import read_result, write_maps

PIXEL = 0.02  # mm
THICKNESS = 0.5
MATERIAL = ("--c10", "2.23", "--c01", "0.703")
FRICTION = ("--window-friction", "0.15", "--sample-friction", "0.1")


def make_map(path: Path, size: float) -> None:
    """Write the loaded thickness: relief of 0.15 and 1 mm correlation length on 84 % of 0.5 mm."""
    count = round(size / PIXEL) + 1
    random = np.random.default_rng(0)
    relief = np.zeros((count, count))
    for length, height in ((0.15, 0.008), (1.0, 0.015)):
        waves = gaussian_filter(random.normal(size=relief.shape), length / PIXEL, mode="reflect")
        relief += height * waves / waves.std()
    axis = PIXEL * np.arange(count)
    loaded = np.clip(0.42 - relief, 0.35, 0.49).astype(np.float32)
    np.savez(path, L1_mm=loaded, x_mm=axis, y_mm=axis)


def command(*arguments: object) -> tuple[float, float, float]:
    """Run a command; seconds by the clock, of processors, and peak bytes of its largest process."""
    code = "from optical_palpation.cli import main; main()"
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-c", code, *map(str, arguments)])
    peak, spent, over = 0.0, {}, threading.Event()

    def watch() -> None:
        nonlocal peak
        me = psutil.Process(process.pid)
        while not over.wait(0.2):
            with suppress(psutil.Error):
                for one in (me, *me.children(recursive=True)):
                    with suppress(psutil.Error):
                        peak = max(peak, float(one.memory_info().rss))
                        times = one.cpu_times()
                        spent[one.pid] = times.user + times.system

    watcher = threading.Thread(target=watch)
    watcher.start()
    status = process.wait()
    over.set()
    watcher.join()
    if status:
        raise SystemExit(f"the command {arguments[0]} ended with status {status}")
    return time.perf_counter() - start, sum(spent.values()), peak


def roughness(stress: xr.DataArray, shared: xr.DataArray) -> float:
    """Second differences of a map along x within overlaps over those elsewhere."""
    second = np.diff(stress.values, 2, axis=1)
    # strips that run along y, so that x leads across a seam; the rim of the layer may have moved in
    strip = np.broadcast_to(np.median(shared.values, axis=0)[1:-1] > 0.5, second.shape)
    inner = np.isfinite(second)
    return float(
        np.sqrt(np.mean(second[strip & inner] ** 2) / np.mean(second[~strip & inner] ** 2))
    )


def root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=float, default=20.0, help="width of the field, mm")
    parser.add_argument("--coarse", type=float, default=0.1, help="element size, mm")
    parser.add_argument("--fine", type=float, default=0.025, help="element size, mm")
    parser.add_argument("--tile", type=float, default=3.0, help="width of a tile, mm")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--whole", action="store_true", help="also as one mesh")
    parser.add_argument("--output", type=Path, default=Path("field-benchmark"))
    chosen = parser.parse_args()
    chosen.output.mkdir(exist_ok=True)
    loaded, coarse, field = (chosen.output / name for name in ("map.npz", "coarse.nc", "field.nc"))
    if not loaded.exists():
        make_map(loaded, chosen.size)
    layer = ("--initial-thickness", THICKNESS)

    def solve(size: float, path: Path) -> None:
        took = command(
            *("stress", loaded, *layer, *MATERIAL, *FRICTION, "--element-size", size),
            *("--no-estimates", "--output", path, "--quiet"),
        )
        elements = np.prod(read_result(path).maps.attrs["elements"])
        report(f"whole at {size:g} mm, {elements:,} elements", took)

    if not coarse.exists():  # an interrupted benchmark goes on
        solve(chosen.coarse, coarse)
    took = command(
        *("submodel", coarse, loaded, *layer, "--element-size", chosen.fine, "--tile", chosen.tile),
        *("--workers", chosen.workers, "--output", field),
    )
    result = read_result(field)
    maps, attrs = result.maps, result.maps.attrs
    report(f"tiles at {chosen.fine:g} mm, {np.prod(attrs['elements']):,} elements", took)
    stress, seams = maps["axial_stress"], maps["axial_stress_seam_error"]
    shared = seams.notnull()
    size = root_mean_square(stress.values)
    print(
        f"tiles {attrs['tiles']}; seams: {attrs['seam_error']:.2%} of the stress there, "
        f"{attrs['seam_error_largest_kPa']:.3f} kPa at most, of {size:.2f} kPa; roughness across "
        f"seams {roughness(stress, shared):.3f}; sides at most {attrs['submodel_sides_error']:.2%}"
    )
    write_maps(result, chosen.output / "field.png", ["axial_stress", "axial_stress_seam_error"])
    if chosen.whole:
        whole = chosen.output / "whole.nc"
        solve(chosen.fine, whole)
        off = stress - read_result(whole).maps["axial_stress"].interp(maps.coords)
        print(
            f"error against one mesh: {root_mean_square(off.values) / size:.2%}, "
            f"in overlaps {root_mean_square(off.where(shared).values) / size:.2%}, "
            f"elsewhere {root_mean_square(off.where(~shared).values) / size:.2%}"
        )


def report(what: str, took: tuple[float, float, float]) -> None:
    wall, processor, peak = took
    print(
        f"{what}: {wall:.0f} s, processors {processor:.0f} s, largest process {peak / 1e9:.2f} GB",
        flush=True,
    )


if __name__ == "__main__":
    main()
