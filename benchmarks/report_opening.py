"""How long a report takes to open in Chromium, and how large it is.

    python benchmarks/report_opening.py              maps of 500 x 500 points, both volumes
    python benchmarks/report_opening.py --pixels 250 --openings 3

A report of a study with volumes is written: relief and speckle, eleven maps, two times fifty
B-scans. It is opened again and again, each time in a browser context of its own, nothing cached.
Times run from the start of the navigation, as the browser counts them: until the stress is on the
screen, and until everything is. Needs Playwright and Chromium.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import tempfile
from pathlib import Path

import numpy as np
import xarray as xr

from optical_palpation.palpation.result import StressResult
from optical_palpation.present import write_report
from optical_palpation.volume import Volume, open_volume

FIELD = 5.0  # mm
DEPTH = 400  # samples of a volume
TIMES = """() => {
  const mark = (name) => performance.getEntriesByName(name)[0]?.startTime ?? NaN;
  return { parsed: performance.getEntriesByType("navigation")[0].domInteractive,
           stress: mark("first-map"), everything: mark("all-maps") };
}"""


def main() -> None:
    """Write a report, open it, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pixels", type=int, default=500, help="pixels of a map along a side")
    parser.add_argument("--openings", type=int, default=7)
    parser.add_argument("--report", type=Path, help="open this report instead")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = given.report or write_study(Path(folder), given.pixels)
        print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB")
        for name, times in opened(path, given.openings).items():
            low, high = min(times), max(times)
            print(f"{name:12s} {statistics.median(times):6.0f} ms  ({low:.0f} to {high:.0f})")


def write_study(folder: Path, n: int) -> Path:
    """Write the report of a study of `n` x `n` A-scans."""
    random = np.random.default_rng(3)
    axis = np.linspace(0.0, FIELD, n)
    relief = 0.04 * np.sin(3 * axis)[None, :] * np.cos(2 * axis)[:, None]
    grid = ("y", "x")
    layers, volumes = {}, {}
    for state, thickness in (("unloaded", 0.5 + 0 * relief), ("loaded", 0.42 + relief)):
        thickness = thickness + 0.001 * random.standard_normal((n, n))
        window = 0.3 + 0.02 * axis[None, :] + 0 * thickness
        layers[state] = xr.Dataset(
            {
                "window_depth": (grid, window),
                "sample_depth": (grid, window + thickness),
                "thickness": (grid, thickness, {"units": "mm"}),
                "quality": (grid, np.clip(random.normal(0.8, 0.05, (n, n)), 0, 1)),
                "filled": (grid, random.random((n, n)) < 0.02),
            },
            {"y": axis, "x": axis},
        )
        volumes[state] = speckle(folder, state, layers[state], random)
    stress = 120 * (relief - 0.08) + 0.1 * random.standard_normal((n, n))
    state = np.where(relief < -0.03, 0, np.where(relief < 0.01, 1, 2)).astype(np.int8)
    maps = {
        "axial_stress": stress,
        "algebraic_axial_stress": 0.7 * stress + 0.1 * random.standard_normal((n, n)),
        "axial_stress_error": 0.05 * abs(stress),
        "contact_pressure": -stress,
        "contact_state": state,
        "window_contact_state": np.minimum(state + 1, 2),
        "loaded_thickness": layers["loaded"]["thickness"].values,
    }
    attrs = {"window_force_mN": 101.5, "sample_force_mN": 101.0, "initial_thickness_mm": 0.5}
    path = folder / "study.html"
    write_report(
        path,
        StressResult(
            xr.Dataset(
                {name: (grid, field, {"units": "kPa"}) for name, field in maps.items()},
                {"y": axis, "x": axis},
                attrs,
            )
        ),
        **layers,
        volumes=volumes,
        parameters={},
        python="",
        title="Relief and speckle",
        warnings=[],
    )
    for volume in volumes.values():
        volume.close()
    return path


def speckle(folder: Path, state: str, layer: xr.Dataset, random: np.random.Generator) -> Volume:
    """Write a volume: speckle that decays below the sample side, a clear layer, a bright window."""
    n, step = layer.sizes["x"], FIELD / (layer.sizes["x"] - 1)
    depth = 0.004 * np.arange(DEPTH)
    path = folder / f"{state}.npy"
    content = np.lib.format.open_memmap(path, "w+", np.float32, (n, DEPTH, n))
    for row in range(n):
        below = depth[:, None] - layer["sample_depth"].values[row]
        light = 0.02 + 3 * (below > 0) * np.exp(-np.clip(2 * below, 0, None))
        light = light + 20 * np.exp(-(((below + layer["thickness"].values[row]) / 0.006) ** 2))
        content[row] = light * random.rayleigh(1.0, light.shape)
    content.flush()
    spacing = {"z": 0.004, "y": step, "x": step}
    return open_volume(path, axes="yzx", spacing=spacing, scale="linear", refractive_index=1.0)


def opened(path: Path, openings: int) -> dict[str, list[float]]:
    """Times of each opening in ms, by what they run to."""
    from playwright.sync_api import sync_playwright

    program = shutil.which("chromium") or shutil.which("chromium-browser")
    found: dict[str, list[float]] = {}
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        for _ in range(openings):
            context = browser.new_context(viewport={"width": 1366, "height": 768})
            page = context.new_page()
            page.goto(path.as_uri())
            page.wait_for_selector("html[data-ready]", state="attached")
            for name, time in page.evaluate(TIMES).items():
                found.setdefault(name, []).append(time)
            context.close()
        browser.close()
    return found


if __name__ == "__main__":
    main()
