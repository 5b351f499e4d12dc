"""Stress and stiffness of samples that nobody tracked, against virtual experiments.

python benchmarks/soft_sample.py [SCENE ...] [--element-size 0.125] [--truth 0.0833] [--flat]
    [--columns]
python benchmarks/soft_sample.py --random 20

The truth is computed on other, finer elements, and gets 1 um of noise on each pixel; frictions,
travel and thickness are known, the motion is not. Printed are the relative errors of the axial
stress (root mean square, one thickness of the layer and more from its sides) by the algebraic
method, on an imprint at rest and with the sample in the model; those of the force; how much of the
map its 95 % band contains, with the errors of the inputs that are taken by default or, with
``--exact``, with none; misfit and time. ``--flat`` withholds the relief; ``--columns`` gives the
true sample the mean stiffness of each column, as the model has it; with ``--loads`` the stress
comes from that many loads up to the full one, and of a relief that is withheld it is then found.
With ``--off`` the frictions, the travel, the thicknesses and the modulus that are stated are off at
random, by the errors that the bands are for.
"""

import argparse
import time
from dataclasses import replace

import numpy as np
import xarray as xr

from optical_palpation.errors import ConvergenceError
from optical_palpation.experiment import ExperimentResult, Scene, read_scene, run_experiment
from optical_palpation.experiment.recovery import recovered_with_sample
from optical_palpation.experiment.scene import with_compression, with_element_size
from optical_palpation.palpation import InputErrors, computational_stress
from optical_palpation.thickness import clean_thickness

SCENES = ("sinusoid", "soft_stiff_columns", "random_tissue", "nodule")
NOISE = 1e-3


def random_scene(seed: int) -> Scene:
    """A tissue with relief, a random stiffness and inclusions 0.2 to 5 times as stiff."""
    rng = np.random.default_rng(seed)
    below = float(rng.uniform(1.0, 2.0))
    base = float(10 ** rng.uniform(-0.5, 0.7))
    features: list[dict] = [
        {"kind": "box", "factor": base},
        {
            "kind": "random",
            "spread": float(rng.uniform(0.0, 0.3)) + 1e-3,
            "correlation_length": float(rng.uniform(0.6, 1.2)),
            "seed": seed,
        },
    ]
    for _ in range(rng.integers(0, 3)):
        features.append(
            {
                "kind": "ellipsoid",
                "factor": base * float(5 ** rng.uniform(-1, 1)),
                "centre": [*rng.uniform(0.8, 3.2, 2), float(rng.uniform(0.2, 0.5)) * below],
                "radii": [*rng.uniform(0.4, 0.8, 2), float(rng.uniform(0.2, 0.35))],
            }
        )
    relief = {
        "kind": "random",
        "rms": float(rng.uniform(0.005, 0.025)),
        "correlation_length": float(rng.uniform(0.6, 1.2)),
        "seed": seed + 1000,
    }
    return Scene.model_validate(
        {
            "title": f"random {seed}",
            "compression": float(rng.uniform(0.12, 0.2)) * (0.5 + below / max(base, 1.0)),
            "layer": {"size": (4.0, 4.0), "thickness": 0.5},
            "sample": {
                "size": (4.0, 4.0),
                "thickness": below,
                "relief": [relief],
                "stiffness": features,
            },
            "friction": dict(
                zip(("window", "sample", "plate"), rng.uniform(0.05, 0.4, 3), strict=True)
            ),
            "mesh": {"element_size": 0.1},
        }
    )


def even_columns(scene: Scene) -> tuple[Scene, xr.DataArray]:
    """The scene without stiffness, and the means of that over the depth."""
    (width, height), below = scene.sample.size, scene.sample.thickness
    x, y = (np.arange(0.0, size + 0.01, 0.02) for size in (width, height))
    points = np.meshgrid(np.linspace(0, below, 40), y, x, indexing="ij")
    factor = np.ones(points[0].shape)
    for feature in scene.sample.stiffness:
        factor = feature.apply(factor, points[2], points[1], points[0])
    even = scene.sample.model_copy(update={"stiffness": ()})
    mean = xr.DataArray(factor.mean(0), {"y": y, "x": x}, ("y", "x"), attrs={"units": "1"})
    return scene.model_copy(update={"sample": even}), mean


def error(stress: xr.DataArray, truth: ExperimentResult) -> float:
    """Relative error of an axial stress map, root mean square over the interior."""
    margin, (width, height) = truth.scene.layer.thickness, truth.scene.layer.size
    inside = {"x": slice(margin, width - margin), "y": slice(margin, height - margin)}
    true = truth.maps["axial_stress"].interp(x=stress["x"], y=stress["y"]).sel(inside)
    return float(np.sqrt(((stress.sel(inside) - true) ** 2).mean() / (true**2).mean()))


def covered(maps: xr.Dataset, truth: ExperimentResult) -> float:
    """Share of the interior where the band of the axial stress contains the truth."""
    margin, (width, height) = truth.scene.layer.thickness, truth.scene.layer.size
    inside = {"x": slice(margin, width - margin), "y": slice(margin, height - margin)}
    here = maps.sel(inside)
    true = truth.maps["axial_stress"].interp(x=here["x"], y=here["y"])
    return float((np.abs(here["axial_stress"] - true) < here["axial_stress_error"]).mean())


def misstated(truth: ExperimentResult, errors: InputErrors, seed: int) -> ExperimentResult:
    """The experiment as one would describe it whose inputs are off by their errors, at random."""
    scene, rng = truth.scene, np.random.default_rng(seed)

    def off(error: float) -> float:
        return float(error / 1.96 * rng.normal())

    frictions = {
        name: max(0.0, getattr(scene.friction, name) + off(getattr(errors, f"{name}_friction")))
        for name in ("window", "sample", "plate")
    }
    law, stiffer = scene.layer.material, 1 + off(errors.modulus)
    layer = {
        "thickness": scene.layer.thickness + off(errors.initial_thickness),
        "c10": stiffer * law.values["c10"],
        "c01": stiffer * law.values["c01"],
    }
    sample = {"thickness": scene.sample.thickness * (1 + off(errors.sample_thickness))}
    told = scene.model_copy(
        update={
            "friction": scene.friction.model_copy(update=frictions),
            "layer": scene.layer.model_copy(update=layer),
            "sample": scene.sample.model_copy(update=sample),
            "compression": scene.compression * (1 + off(errors.compression)),
        }
    )
    loaded = truth.maps["loaded_thickness"]
    maps = truth.maps.assign(
        loaded_thickness=(loaded + off(errors.thickness)).assign_attrs(loaded.attrs)
    )
    return replace(truth, scene=told, maps=maps)


def compared(scene: Scene, asked: argparse.Namespace) -> dict[str, float]:
    """Compute the truth of a scene and recover it, from one load or several."""
    size, count = asked.element_size, asked.loads
    inputs = None if asked.exact else InputErrors()
    mesh = scene.mesh.model_copy(update={"edge_size": None})
    scene = scene.model_copy(update={"mesh": mesh, "pixel_spacing": 0.025})
    scene, columns = even_columns(scene) if asked.columns else (scene, None)
    fine = with_element_size(scene, asked.truth)
    travels = [scene.compression * (n + 1) / (count + 1) for n in range(1, count)]
    travels.append(scene.compression)
    truths = [
        run_experiment(with_compression(fine, travel), stiffness=columns) for travel in travels
    ]
    truth, friction = truths[-1], scene.friction
    exact = truth.maps["loaded_thickness"]
    noise = NOISE * np.random.default_rng(count - 1).normal(size=exact.shape)
    loaded = (exact + noise).assign_attrs(exact.attrs)
    options = {
        "window_friction": friction.window,
        "sample_friction": friction.sample,
        "element_size": size,
    }
    layer = scene.layer.thickness, scene.layer.material
    cleaned = clean_thickness(loaded)["thickness"]
    imprint = computational_stress(cleaned, *layer, **options, edge_check=False, input_errors=None)
    start, used = time.perf_counter(), time.process_time()
    told = [misstated(each, InputErrors(), asked.off) for each in truths] if asked.off else truths
    result = recovered_with_sample(
        told, element_size=size, noise=NOISE, relief_known=not asked.flat, input_errors=inputs
    )
    maps = result.maps
    row = {"time / s": time.perf_counter() - start, "cpu / s": time.process_time() - used}
    attrs = maps.attrs
    return {
        "algebraic": error(maps["algebraic_axial_stress"], truth),
        "imprint": error(imprint.maps["axial_stress"], truth),
        "sample": error(maps["axial_stress"], truth),
        "force": attrs["window_force_mN"] / truth.maps.attrs["window_force_mN"] - 1,
        "in band": covered(maps, truth),
        "misfit / um": 1e3 * attrs.get("thickness_misfit_mm", np.nan),
        "over tolerance": attrs.get("misfit_over_tolerance", np.nan),
        "solutions": attrs.get("forward_solutions", 0),
        **row,
        **({} if result.series is None else of_series(result.series, truths)),
    }


def of_series(series: xr.Dataset, truths: list[ExperimentResult]) -> dict[str, float]:
    """Errors at the earlier loads."""
    return {
        f"load {n}": error(series["axial_stress"].sel(load=n), truth)
        for n, truth in enumerate(truths[:-1], start=1)
    }


def main() -> None:
    """Print a line for each scene, and what the middle and the worst of them are."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--random", type=int, default=0, metavar="COUNT")
    parser.add_argument("--element-size", type=float, default=0.125, metavar="MM")
    parser.add_argument("--truth", type=float, default=0.0833333, metavar="MM")
    parser.add_argument("--flat", action="store_true")
    parser.add_argument("--columns", action="store_true")
    parser.add_argument("--loads", type=int, default=1, metavar="COUNT")
    parser.add_argument("--exact", action="store_true")
    parser.add_argument("--off", type=int, default=0, metavar="SEED")
    asked = parser.parse_args()
    scenes = [random_scene(seed) for seed in range(asked.random)]
    if not scenes:
        scenes = [read_scene(name) for name in asked.scenes or SCENES]
    rows = []
    for scene in scenes:
        try:
            row = compared(scene, asked)
        except ConvergenceError as failure:
            print(f"{scene.title}: {failure}", flush=True)
            continue
        rows.append(row)
        numbers = ", ".join(f"{name} {value:.3g}" for name, value in row.items())
        print(f"{scene.title}: {numbers}", flush=True)
    if len(rows) > 1:
        for name, middle in (("median", np.median), ("worst", np.max)):
            of = {key: middle([abs(row[key]) for row in rows]) for key in ("sample", "force")}
            print(f"{name}: " + ", ".join(f"{key} {value:.1%}" for key, value in of.items()))
        print(f"arrived: {len(rows)} of {len(scenes)}")


if __name__ == "__main__":
    main()
