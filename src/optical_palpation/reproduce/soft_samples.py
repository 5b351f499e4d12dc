"""Stress and stiffness of samples whose motion nobody knows, from virtual experiments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from optical_palpation.experiment import ExperimentResult, Scene, read_scene, run_experiment
from optical_palpation.experiment.recovery import recovered_with_sample, recovery_errors
from optical_palpation.experiment.scene import Box, with_compression, with_element_size
from optical_palpation.palpation import Progress, StressResult
from optical_palpation.palpation.input_errors import INPUT_ERRORS
from optical_palpation.reproduce.record import Part, Row, Setting


@dataclass(frozen=True)
class _Case:
    """A scene, its loads as shares of its compression, and whether its relief is given.

    ``quick`` are those of a quick run, whose elements cannot follow every scene.
    """

    scene: str
    words: str
    loads: tuple[float, ...] = (1.0,)
    relief_known: bool = True
    quick: bool = False


_CASES = (
    _Case("sinusoid", "five ridges, relief known"),
    _Case("soft_stiff_columns", "a soft and a stiff column", quick=True),
    _Case("random_tissue", "random tissue with a nodule, relief known"),
    _Case("random_tissue", "the same, relief unknown and taken as flat", relief_known=False),
    _Case("random_tissue", "the same, relief unknown, three loads", (0.5, 0.75, 1.0), False, True),
)
#: Elements of the truth and of what is recovered, mm; and in a quick run.
_SIZES, _QUICK = (1 / 12, 0.125), (0.4, 0.3)


def soft_samples(setting: Setting) -> Part:
    """The sample in the model, against virtual experiments."""
    finer, size = _QUICK if setting.quick else _SIZES
    part = Part(
        f"The scenes are computed on elements of {1e3 * finer:.0f} um, and their loaded thickness "
        f"gets 1 um of noise on each pixel. Stress and stiffness are recovered on elements of "
        f"{1e3 * size:.0f} um with the sample in the model: its thickness, the travel of the plate "
        "and the frictions are known. Its motion is not, and its law is taken for neo-Hookean "
        "although it stiffens as the layer does. Errors are those of the interior, 0.5 mm and more "
        "off the sides; bands are those of the default errors of the inputs."
    )
    cases = [case for case in _CASES if case.quick or not setting.quick]
    share = 1 / len(cases)
    known: dict[tuple[str, float], ExperimentResult] = {}
    for number, case in enumerate(cases):
        scene = with_element_size(read_scene(case.scene), finer)
        mesh = scene.mesh.model_copy(update={"edge_size": None})
        scene = scene.model_copy(update={"mesh": mesh, "pixel_spacing": 0.1 * size + 0.0125})
        truths = []
        for load in case.loads:
            key = case.scene, load
            if key not in known:
                travel = load * scene.compression
                report = _reporter(setting, number * share, 0.5 * share, "experiment")
                known[key] = run_experiment(
                    with_compression(scene, travel),
                    threads=setting.threads,
                    progress=report,
                )
            truths.append(known[key])
        found = recovered_with_sample(
            truths,
            element_size=size,
            relief_known=case.relief_known,
            input_errors=INPUT_ERRORS,
            threads=setting.threads,
            progress=_reporter(setting, (number + 0.5) * share, 0.5 * share, "stress"),
        )
        part.rows += _rows(case, scene, truths[-1], found)
    return part


def _rows(case: _Case, scene: Scene, truth: ExperimentResult, found: StressResult) -> list[Row]:
    errors = recovery_errors(truth, found).sel(zone="interior")
    ours, algebraic = (errors.sel(approach=name) for name in ("computational", "algebraic"))
    force = found.maps.attrs["window_force_mN"] / truth.maps.attrs["window_force_mN"] - 1
    rows = [
        Row(
            "Sample in the model",
            f"axial stress against the true one, relative RMS: {case.words}",
            "0",
            f"{float(ours['relative_rms']):.1%} (force {force:+.1%}); algebraic "
            f"{float(algebraic['relative_rms']):.0%}",
            f"{_covered(truth, found):.0%} of the map within its 95 % band, "
            f"{found.maps.attrs['forward_solutions']} forward solutions",
        )
    ]
    modulus = found.maps["sample_shear_modulus"] / scene.sample.material.shear_modulus
    if case.scene == "soft_stiff_columns":
        rows += _of_columns(modulus, scene)
    elif case.scene == "sinusoid":
        inside = modulus.sel(x=slice(0.5, 4.5), y=slice(0.5, 4.5))
        rows.append(
            Row(
                "Sample in the model",
                "shear modulus of a uniform sample over the true one, median",
                "1",
                f"{float(inside.median()):.3f} (standard deviation {float(inside.std()):.3f})",
            )
        )
    if "sample_relief" in found.maps:
        relief, (width, height) = found.maps["sample_relief"], scene.layer.size
        # a random relief depends on what all of the points are: here, all of the sample
        there = np.meshgrid(relief["x"], relief["y"])
        true = relief.copy(data=sum(part.height(*there) for part in scene.sample.relief))
        interior = {"x": slice(0.5, width - 0.5), "y": slice(0.5, height - 0.5)}
        off, true = (relief - true).sel(interior), true.sel(interior)
        rows.append(
            Row(
                "Sample in the model",
                "relief found from three loads, standard deviation of its error",
                "0",
                f"{1e3 * float(off.std()):.1f} um of {1e3 * float(true.std()):.1f} um",
            )
        )
    return rows


def _covered(truth: ExperimentResult, found: StressResult) -> float:
    """Share of the interior where the band of the axial stress contains the truth."""
    margin, (width, height) = truth.scene.layer.thickness, truth.scene.layer.size
    here = found.maps.sel(x=slice(margin, width - margin), y=slice(margin, height - margin))
    off = here["axial_stress"] - truth.maps["axial_stress"].interp(x=here["x"], y=here["y"])
    return float((np.abs(off) < here["axial_stress_error"]).mean())


def _of_columns(modulus: xr.DataArray, scene: Scene) -> list[Row]:
    """Ratio of the columns, and where the modulus passes the middle between them."""
    (stiff_one,) = scene.sample.stiffness
    assert isinstance(stiff_one, Box)
    middle, x = stiff_one.x[0], modulus["x"].values
    line = modulus.sel(y=slice(0.5, scene.layer.size[1] - 0.5)).mean("y")
    ends = (0.5, middle - 0.5), (middle + 0.5, scene.layer.size[0] - 0.5)
    soft, stiff = (float(line.sel(x=slice(*range_)).median()) for range_ in ends)
    above = line.values - np.sqrt(soft * stiff)
    passing = np.flatnonzero(above[:-1] * above[1:] < 0)
    places = x[passing] - above[passing] * (x[passing + 1] - x[passing]) / (
        above[passing + 1] - above[passing]
    )
    edge = places[np.abs(places - middle).argmin()] - middle
    return [
        Row(
            "Sample in the model",
            "shear modulus of the soft and the stiff column over that of the layer",
            f"1 and {stiff_one.factor:g}",
            f"{soft:.3f} and {stiff:.3f}, ratio {stiff / soft:.2f}",
        ),
        Row(
            "Sample in the model",
            "place of the edge between the columns, off the true one, um",
            "0",
            f"{1e3 * edge:+.0f}",
        ),
    ]


def _reporter(
    setting: Setting, start: float, share: float, what: str
) -> Callable[[Progress], None]:
    def report(now: Progress) -> None:
        setting.tell(start + share * now.load, f"{what}: {now.stage}")

    return report
