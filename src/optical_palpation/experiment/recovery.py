"""The stress of a virtual experiment, computed back from what OCT would see of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr

from optical_palpation.analysis import compare_maps
from optical_palpation.errors import InputError
from optical_palpation.experiment.virtual import ExperimentResult
from optical_palpation.palpation import (
    Progress,
    StressResult,
    computational_stress,
    uniform_motion,
)
from optical_palpation.palpation.input_errors import InputErrors
from optical_palpation.stiffness import Sample, sample_stress
from optical_palpation.thickness import clean_thickness
from optical_palpation.thickness.frames import inside_layer


def recovered_stress(
    result: ExperimentResult,
    *,
    element_size: float | Sequence[float],
    noise: float = 1e-3,
    seed: int = 0,
    sample_friction: float | None = None,
    sample_motion: xr.Dataset | None = None,
    bulk_to_shear: float | None = None,
    threads: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> StressResult:
    """Apply both methods to the loaded thickness of a virtual experiment (figures 3b and 3d).

    Parameters
    ----------
    element_size
        Elements of the computational method, mm; not those of the experiment, or its errors of
        discretisation cancel.
    noise
        Standard deviation of the error added to each pixel of the thickness, mm.
    seed
        Of the random numbers.
    sample_friction
        Coefficient between layer and sample; by default that of the scene.
    sample_motion
        Known motion of the sample's surface, ``result.maps`` for the true one; by default it is
        taken as fixed laterally, for which the scene's friction is too much where the sample
        spreads (section 4 of the paper).
    bulk_to_shear
        Of the layer; by default that of the scene.

    Returns
    -------
    StressResult
        Of the computational method, without error bands and the influence of mesh and sides: the
        truth is known. Its ``algebraic_axial_stress`` is that of the same noisy thickness.

    Raises
    ------
    InputError, ConvergenceError
        As :func:`~optical_palpation.palpation.computational_stress`.
    """
    if not (np.isfinite(noise) and noise >= 0):
        raise InputError(f"noise must be at least 0 mm, not {noise!r}")
    exact = result.maps["loaded_thickness"]
    error = np.random.default_rng(seed).normal(0.0, 1.0, exact.shape)
    loaded = clean_thickness((exact + noise * error).assign_attrs(exact.attrs))["thickness"]
    scene = result.scene
    material = scene.layer.material
    if bulk_to_shear is not None:
        material = material.of(material.values, bulk_to_shear)
    return computational_stress(
        loaded,
        scene.layer.thickness,
        material,
        window_friction=scene.friction.window,
        sample_friction=scene.friction.sample if sample_friction is None else sample_friction,
        element_size=element_size,
        sample_motion=sample_motion,
        mesh_check=False,
        edge_check=False,
        input_errors=None,
        threads=threads,
        progress=progress,
    )


def recovered_with_sample(
    results: Sequence[ExperimentResult],
    *,
    element_size: float,
    noise: float = 1e-3,
    relief_known: bool = True,
    input_errors: InputErrors | None = None,
    threads: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> StressResult:
    """Find stress and stiffness with the sample in the model, of whose motion nothing is known.

    Parameters
    ----------
    results
        Virtual experiments of one sample, one for each load, in the order of loading.
    element_size
        Elements, mm; not those of the experiments.
    noise
        Standard deviation of the error added to each pixel of the thickness, mm.
    relief_known
        Whether the relief of the sample is given; else it is taken as flat with one load, and
        found from several.
    input_errors, threads, progress
        As for :func:`~optical_palpation.stiffness.sample_stress`.

    Raises
    ------
    InputError, ConvergenceError
        As that function.
    """
    scene = results[-1].scene
    loads = []
    for seed, result in enumerate(results):
        exact = result.maps["loaded_thickness"]
        error = np.random.default_rng(seed).normal(0.0, 1.0, exact.shape)
        loads.append((exact + noise * error).assign_attrs(exact.attrs))
    relief: xr.DataArray | None = None
    if relief_known and scene.sample.relief:
        x, y = (np.linspace(0, width, 201) for width in scene.sample.size)
        height = sum(part.height(*np.meshgrid(x, y)) for part in scene.sample.relief)
        relief = xr.DataArray(height, {"y": y, "x": x}, ("y", "x"))
    sample = Sample(
        thickness=scene.sample.thickness,
        compression=[result.scene.compression for result in results],
        plate_friction=scene.friction.plate,
        relief=relief,
        size=scene.sample.size,
    )
    return sample_stress(
        loads,
        scene.layer.thickness,
        scene.layer.material,
        sample,
        window_friction=scene.friction.window,
        sample_friction=scene.friction.sample,
        element_size=element_size,
        input_errors=input_errors,
        threads=threads,
        progress=progress,
    )


def spreading_sample(result: ExperimentResult) -> xr.Dataset:
    """Estimate the motion of the sample from the travel of the plate and the sample's thickness.

    The sample is taken to be compressed evenly, by what the layer does not take of the travel, and
    to spread without change of volume.

    Returns
    -------
    xarray.Dataset
        As of :func:`~optical_palpation.palpation.uniform_motion`.
    """
    scene, loaded = result.scene, result.maps["loaded_thickness"]
    layer = scene.layer.thickness - float(loaded.where(inside_layer(loaded)).mean())
    compression = (scene.compression - layer) / scene.sample.thickness
    return uniform_motion(loaded, (1 - compression) ** -0.5 - 1)


def recovery_errors(result: ExperimentResult, recovered: StressResult) -> xr.Dataset:
    """Errors of both methods against the true axial stress, as of ``compare_maps``.

    Returns
    -------
    xarray.Dataset
        The variables of :func:`~optical_palpation.analysis.compare_maps` over ``approach``
        (algebraic, computational) and ``zone``, on the pixels of the recovered maps; the interior
        is 0.5 mm and more from the sides.
    """
    maps = recovered.maps
    true = result.maps["axial_stress"].interp(x=maps["x"], y=maps["y"])
    names = {"algebraic": "algebraic_axial_stress", "computational": "axial_stress"}
    errors = [compare_maps(maps[name], true) for name in names.values()]
    return xr.concat(errors, xr.DataArray(list(names), dims="approach", name="approach"))
