"""Accuracy, speed and memory of the boundary detectors on synthetic OCT.

python benchmarks/boundaries.py                   the table of thickness errors
python benchmarks/boundaries.py --speed FOLDER    two volumes of 1 GB, written to FOLDER
"""

import argparse
import multiprocessing
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from optical_palpation.experiment.synthetic_oct import SyntheticOCT
from optical_palpation.thickness.boundaries import find_layer

SPACING = (0.0029, 0.01, 0.01)
SHAPE = (96, 160)


def maps() -> dict[str, np.ndarray]:
    """Thickness maps, mm: from flat to a slope of 0.7."""
    y, x = np.meshgrid(*(0.01 * np.arange(n) for n in SHAPE), indexing="ij")
    return {
        "flat": np.full(SHAPE, 0.4),
        "smooth": 0.4 + 0.06 * np.sin(2 * np.pi * x / 1.1) + 0.02 * np.cos(2 * np.pi * y / 0.5),
        "egg crate": 0.4 + 0.02 * np.sin(2 * np.pi * x / 0.3) * np.cos(2 * np.pi * y / 0.3),
        "steep": 0.4 + 0.125 * np.sin(2 * np.pi * x / 1.11),
    }


def accuracy() -> None:
    """Print the errors of thickness in axial pixels."""
    print("Thickness error, axial pixels of 2.9 um (tilt 2 and 3 %, one A-scan in 100 saturated)")
    print(f"{'':10}{'SNR':>5}{'surface: bias':>15}{'RMS':>7}{'max':>7}{'filled':>8}", end="")
    print(f"{'Canny: bias':>14}{'RMS':>8}{'filled':>8}")
    squares: dict[float, list[float]] = {}
    for name, thickness in maps().items():
        for snr in (30.0, 20.0, 10.0):
            of = SyntheticOCT(
                thickness, SPACING, 400, tilt=(0.02, 0.03), snr_db=snr, saturated=0.01
            )
            line = f"{name:10}{snr:5.0f}"
            for method in ("surface", "canny"):
                layer = find_layer(of, spacing=SPACING, scale="linear", method=method)
                error = (layer.thickness.values - thickness) / SPACING[0]
                rms, bias = np.sqrt(np.mean(error**2)), error.mean()
                if method == "surface":
                    squares.setdefault(snr, []).append(float(rms) ** 2)
                    line += f"{bias:+15.3f}{rms:7.3f}{np.abs(error).max():7.2f}"
                else:
                    line += f"{bias:+14.2f}{rms:8.2f}"
                line += f"{100 * layer.attrs['filled_share']:7.1f}%"
            print(line)
    for snr, values in squares.items():
        print(f"{'all maps':10}{snr:5.0f}{'':15}{np.sqrt(np.mean(values)):7.3f}")


def speed(folder: Path) -> None:
    """Print time and peak memory of the boundaries of two volumes of 500 x 500 x 1024 samples."""
    ny, nx, nz = 500, 500, 1024
    y, x = np.meshgrid(0.01 * np.arange(ny), 0.01 * np.arange(nx), indexing="ij")
    free = np.full((ny, nx), 0.5)
    pressed = 0.4 + 0.05 * np.sin(2 * np.pi * x / 1.3) * np.cos(2 * np.pi * y / 1.7)
    paths = [folder / "unloaded.f32", folder / "loaded.f32"]
    try:
        for path, thickness in zip(paths, (free, pressed), strict=True):
            of = SyntheticOCT(thickness, SPACING, nz, tilt=(0.01, 0.02), seed=len(path.name))
            disk = np.memmap(path, np.float32, "w+", shape=(nz, ny, nx))
            for i, image in enumerate(of):
                disk[:, i] = image
            disk.flush()
            del disk
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as fresh:
            fresh.submit(measure, paths, (free, pressed), nz).result()
    finally:
        for path in paths:
            path.unlink(missing_ok=True)


def measure(paths: list[Path], truths: tuple[np.ndarray, ...], nz: int) -> None:
    """Find the boundaries in both files and print time and peak memory of this process."""
    small = SyntheticOCT(truths[0][:16, :32], SPACING, 256)
    find_layer(small, spacing=SPACING, scale="linear")  # compiles the kernels
    start = time.perf_counter()
    for path, truth in zip(paths, truths, strict=True):
        ny, nx = truth.shape
        stack = np.memmap(path, np.float32, "r", shape=(nz, ny, nx))
        layer = find_layer(stack, spacing=SPACING, scale="linear")
        error = (layer.thickness.values - truth) / SPACING[0]
        rms = np.sqrt(np.mean(error**2))
        print(f"{path.stem}: done after {time.perf_counter() - start:.1f} s, RMS {rms:.3f} px")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory {peak:.2f} GiB", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--speed", type=Path, metavar="FOLDER")
    folder = parser.parse_args().speed
    sys.exit(accuracy() if folder is None else speed(folder))
