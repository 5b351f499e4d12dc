"""The paper's virtual experiments (figures 3, 5): time, published thickness, recovered stress.

python benchmarks/virtual_experiment.py [SCENE ...] [--threads N] [--element-size MM]
python benchmarks/virtual_experiment.py --random 40 [--increment 0.1]

The second computes random scenes and tells how many arrive at the full compression: bodies of
equal and other sizes, samples a tenth to ten times as stiff as the layer, with inclusions that are
as much softer or stiffer again, reliefs, friction 0 to 0.5, and the softer body compressed by 10 to
35 %. With ``--increment`` each that arrives is loaded again in increments of at most so much of its
load, and how the force of the usual ones differs is told.

The published loaded thickness of the sinusoid is read from ../shared/data if it is there. The
stress is recovered on elements 0.8 times as large as those of the experiment: on an imprint that is
fixed laterally, with the scene's friction and none; and with the motion of the sample, taken as
uniform spreading without change of volume, known but for a factor, or known, without and with 1 um
of noise per pixel of the thickness.
"""

import argparse
import time
from pathlib import Path
from unittest import mock

import numpy as np
import xarray as xr
from scipy.ndimage import convolve1d

from optical_palpation.errors import ConvergenceError
from optical_palpation.experiment import (
    ExperimentResult,
    Scene,
    read_scene,
    run_experiment,
)
from optical_palpation.experiment.recovery import (
    recovered_stress,
    recovery_errors,
    spreading_sample,
)
from optical_palpation.experiment.scene import with_element_size
from optical_palpation.mechanics.path import StepControl
from optical_palpation.present.experiment import write_experiment, write_experiment_figure

PUBLISHED = Path(__file__).parents[1] / "../shared/data/layers/sinusoid_simulated_L1.npz"


def against_published(result: ExperimentResult, element: float = 0.0) -> dict[str, float]:
    """Loaded thickness less the published one at its points, um, 0.5 mm and more from the sides.

    Where a thickness is linear between nodes ``element`` apart, wherever those are, it is on
    average its convolution with a hat of that half-width.
    """
    thickness = result.maps["loaded_thickness"]
    if element:
        reach = round(element / float(thickness["x"][1] - thickness["x"][0]))
        hat = np.convolve(np.ones(reach), np.ones(reach)) / reach**2
        smooth = convolve1d(np.nan_to_num(thickness.values), hat, 0)
        thickness = thickness.copy(data=convolve1d(smooth, hat, 1))
    data = np.load(PUBLISHED)
    x, y = (axis[(axis >= 0.5) & (axis <= 4.5)] for axis in (data["x_mm"], data["y_mm"]))
    published = xr.DataArray(data["L1_mm"], {"y": data["y_mm"], "x": data["x_mm"]}, ("y", "x"))
    theirs = 1e3 * published.sel(x=x, y=y).values
    difference = 1e3 * thickness.interp(x=x, y=y).values - theirs
    turns = np.flatnonzero(np.diff(np.sign(np.diff(theirs.mean(0))))) + 1
    return {
        "rms": float(np.sqrt(np.mean(difference**2))),
        "bias": float(difference.mean()),
        "largest": float(np.abs(difference).max()),
        "peaks and valleys": float(np.abs(difference[:, turns]).max()),
    }


def random_scene(seed: int) -> Scene:
    """Draw a scene of 2,000 to 6,000 elements."""
    rng = np.random.default_rng(seed)
    thickness, below = rng.uniform(0.3, 0.7), rng.uniform(0.8, 2.0)
    size = float(rng.uniform(2.0, 4.0))
    base = float(10 ** rng.uniform(-1, 1))
    strain, softer = rng.uniform(0.1, 0.35), min(1.0, base)
    features = [{"kind": "box", "factor": base}]
    for _ in range(rng.integers(0, 4)):
        features.append(
            {
                "kind": "ellipsoid",
                "factor": base * float(10 ** rng.uniform(-1, 1)),
                "centre": [*rng.uniform(0.1 * size, 0.9 * size, 2), rng.uniform(0.1, 0.6) * below],
                "radii": [*rng.uniform(0.15, 0.6, 2), rng.uniform(0.1, 0.4)],
            }
        )
    height = float(rng.uniform(0, 0.25) * thickness)
    relief: list[dict] = []
    if rng.random() < 0.5:
        direction, wavelength = rng.uniform(0, 180), rng.uniform(0.8, 2.0)
        relief.append(
            {
                "kind": "sinusoid",
                "amplitude": height,
                "wavelength": wavelength,
                "direction": direction,
            }
        )
    elif rng.random() < 0.7:
        relief.append(
            {
                "kind": "random",
                "rms": 0.4 * height + 1e-3,
                "correlation_length": rng.uniform(0.4, 1.0),
                "seed": seed,
            }
        )
    friction = dict(zip(("window", "sample", "plate"), rng.uniform(0, 0.5, 3), strict=True))
    for name in friction:
        friction[name] *= float(rng.random() > 0.15)
    return Scene.model_validate(
        {
            "title": f"random scene {seed}",
            "compression": strain * softer * (thickness + below / base) + 0.5 * height,
            "layer": {"size": (size, size), "thickness": thickness},
            "sample": {
                "size": (size * rng.choice([1.0, 1.0, 0.7, 1.3]),) * 2,
                "thickness": below,
                "relief": relief,
                "stiffness": features,
            },
            "friction": friction,
            "mesh": {"element_size": size / rng.integers(16, 25)},
        }
    )


def in_increments(scene: Scene, threads: int | None, increment: float) -> float:
    """Force at the window of a scene that is loaded in small increments, mN."""
    control = StepControl(first=min(StepControl.first, increment), largest=increment)
    with mock.patch("optical_palpation.mechanics.stack.cascade._CONTROL", control):
        return run_experiment(scene, threads=threads).maps.attrs["window_force_mN"]


def arrivals(count: int, threads: int | None, increment: float | None = None) -> None:
    """Compute random scenes and print how each went."""
    arrived, changes = 0, list[float]()
    for seed in range(count):
        scene = random_scene(seed)
        start, used = time.perf_counter(), time.process_time()
        try:
            attrs = run_experiment(scene, threads=threads).maps.attrs
        except ConvergenceError as failure:
            result = str(failure)
        else:
            arrived += 1
            result = (
                f"{sum(attrs['elements']):5} elements, {attrs['window_force_mN']:8.2f} mN, "
                f"balance {attrs['force_balance']:.0e}, {attrs['newton_iterations']} iterations"
            )
            if increment:
                small = in_increments(scene, threads, increment)
                changes.append(100 * abs(attrs["window_force_mN"] / small - 1))
                result += f", {changes[-1]:.2f} % from small increments"
        seconds = (
            f"{time.perf_counter() - start:.1f} s, {time.process_time() - used:.1f} s of cores"
        )
        print(f"{seed:3}: {result}, {seconds}", flush=True)
    print(f"{arrived} of {count} arrive")
    if changes:
        median, most = np.median(changes), max(changes)
        print(f"In increments of {increment:.0%}: {median:.2f} % of the force, {most:.2f} at most")


def main() -> None:
    """Run the scenes and print what they show."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=["sinusoid", "soft_stiff_columns"])
    parser.add_argument("--threads", type=int)
    parser.add_argument("--element-size", type=float)
    parser.add_argument("--output", type=Path, help="folder for results and figures")
    parser.add_argument("--random", type=int, help="compute so many random scenes instead")
    parser.add_argument("--increment", type=float, help="of the load, for random scenes")
    options = parser.parse_args()
    if options.random:
        arrivals(options.random, options.threads, options.increment)
        return
    for name in options.scenes:
        scene = read_scene(name)
        if options.element_size:
            scene = with_element_size(scene, options.element_size)
        start, used = time.perf_counter(), time.process_time()
        result = run_experiment(scene, threads=options.threads)
        attrs = result.maps.attrs
        print(f"{name}: elements {attrs['elements']}, {attrs['newton_iterations']} iterations")
        print(f"  {time.perf_counter() - start:.0f} s, {time.process_time() - used:.0f} s of cores")
        print(f"  force {attrs['window_force_mN']:.2f} mN, balance {attrs['force_balance']:.1e}")
        print(f"  {attrs['convergence']}", flush=True)
        if options.output:
            options.output.mkdir(parents=True, exist_ok=True)
            write_experiment(result, options.output / f"{name}.nc")
        if name == "sinusoid" and PUBLISHED.is_file():
            for what, element in (("", 0.0), (" through its elements", 0.125)):
                numbers = against_published(result, element)
                print(f"  against the published thickness{what}, um:", end=" ")
                print(", ".join(f"{key} {value:.2f}" for key, value in numbers.items()))
        recovered = None
        motion = result.maps[["sample_displacement_x", "sample_displacement_y"]]
        for what, known in (
            ("fixed imprint", {"noise": 0.0}),
            ("no friction at the sample", {"noise": 0.0, "sample_friction": 0.0}),
            ("uniform spreading", {"noise": 0.0, "sample_motion": spreading_sample(result)}),
            ("90 % of the motion", {"noise": 0.0, "sample_motion": 0.9 * motion}),
            ("110 % of the motion", {"noise": 0.0, "sample_motion": 1.1 * motion}),
            ("known motion", {"noise": 0.0, "sample_motion": motion}),
            ("known motion, noise of 1 um", {"noise": 1e-3, "sample_motion": motion}),
        ):
            start = time.perf_counter()
            try:
                recovered = recovered_stress(
                    result,
                    element_size=0.8 * scene.mesh.element_size,
                    threads=options.threads,
                    **known,
                )
            except ConvergenceError as failure:
                print(f"  recovery, {what}: {failure}")
                continue
            errors = recovery_errors(result, recovered)
            print(f"  recovered, {what}, {time.perf_counter() - start:.0f} s:")
            for method in ("algebraic", "computational"):
                row = errors.sel(approach=method)
                print(
                    f"    {method:14} relative rms "
                    + ", ".join(
                        f"{zone} {100 * float(row['relative_rms'].sel(zone=zone)):.1f} %"
                        for zone in ("interior", "edge", "all")
                    ),
                    flush=True,
                )
        if options.output:
            picture = options.output / f"{name}.png"
            write_experiment_figure(result, picture, recovered)


if __name__ == "__main__":
    main()
