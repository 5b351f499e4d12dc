"""Calibration curves: how friction bends the displacement profile of a flat layer."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from optical_palpation.arguments import LARGEST_FRICTION, number, numbers
from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.files import netcdf, replacing
from optical_palpation.material import Law
from optical_palpation.mechanics.cascade import LoadNotReached, make_solver, solve
from optical_palpation.mechanics.contact import remember_slip
from optical_palpation.mechanics.grid import LayerGrid, graded_depths
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.iteration import NotConverged, Tolerances
from optical_palpation.mechanics.newton import equilibrate
from optical_palpation.mechanics.problem import SAMPLE, LayerProblem
from optical_palpation.runtime import software_version
from optical_palpation.volume import hdf5

Array = NDArray[np.float64]

# Slip over which friction builds up. Where the layer all but sticks it slips by a few micrometres
# under the preload: with 1 um the total profile is off by 0.02 there, with 0.3 um by 0.01 less.
_PRELOAD_SLIP = 3e-4
# Under the small step it slips by less than the step: as shares of the step, a half gives an
# incremental profile off by 0.05, a fiftieth by 0.005. Each share starts from the one before.
_STEP_SLIPS = (0.5, 0.1, 0.02)


def slab_profile(
    friction: float,
    *,
    layer_size: tuple[float, float],
    initial_thickness: float,
    loaded_thickness: float,
    material: Law,
    region: float,
    sample_friction: float = 0.1,
    step: float = 5e-4,
    elements: int = 6,
) -> xr.Dataset:
    """Displacement against depth in the middle of a flat layer pressed between flat plates.

    The layer is compressed to the loaded thickness and then by a small step more, as in section 4
    of the paper. Its sides are free, so that `layer_size` must be the whole layer's.

    About the centre, where the layer flows to neither side, it sticks to the window however small
    the friction, and more friction only widens the part that sticks: within it every profile is
    the same. So the profile depends on the region over which it is averaged, and only one that
    reaches well beyond the part that sticks tells coefficients apart.

    Parameters
    ----------
    friction, sample_friction
        Coefficients at the window and at the sample side.
    layer_size
        Unloaded size (x, y), mm.
    initial_thickness, loaded_thickness
        Before and after the preload, mm.
    material
        Law of the layer.
    step
        Additional compression, mm.
    region
        Width of the square around the centre over which displacement is averaged, mm: that of
        the measurement. 0 is the centre line.
    elements
        Through the depth. Across it they are a third of the loaded thickness or a sixteenth of
        the region wide at the centre and grow outwards.

    Returns
    -------
    xarray.Dataset
        Over ``unloaded_depth`` (fraction from the window, of material points): ``depth`` (fraction
        of the loaded layer), ``displacement`` under the preload and ``increment`` under the step
        (mm, positive away from the window as in OCT, hence negative here). Attribute ``force_mN``
        under the preload.

    Raises
    ------
    InputError
        If a number is impossible.
    ConvergenceError
        If the load cannot be reached.
    """
    friction, sample_friction = (
        number(value, name, "a coefficient of friction")
        for name, value in (("friction", friction), ("sample_friction", sample_friction))
    )
    size_x, size_y = numbers(layer_size, 2, "layer_size", "two lengths in mm, x and y")
    layer_size = size_x, size_y
    initial_thickness, loaded_thickness, step, region = (
        number(value, name, "a length in mm")
        for name, value in (
            ("initial_thickness", initial_thickness),
            ("loaded_thickness", loaded_thickness),
            ("step", step),
            ("region", region),
        )
    )
    compression = initial_thickness - loaded_thickness
    if not (0.0 < loaded_thickness < initial_thickness and step > 0.0):
        raise InputError(
            f"loaded thickness {loaded_thickness:g} mm must lie between 0 and the initial "
            f"{initial_thickness:g} mm, and the step {step:g} mm be positive"
        )
    if min(friction, sample_friction) < 0.0:
        raise InputError(f"friction {friction:g} and {sample_friction:g} must not be negative")
    if not 0.0 <= region < min(layer_size) or min(layer_size) < 2.0 * initial_thickness:
        raise InputError(
            f"layer of {layer_size[0]:g} x {layer_size[1]:g} mm: must be wider than the region of "
            f"{region:g} mm and than twice its thickness"
        )
    finest = max(loaded_thickness / 3.0, region / 16.0)
    x, y = (_nodes_about_centre(size, finest) for size in layer_size)
    grid = LayerGrid(x, y, graded_depths(elements), np.full((y.size, x.size), initial_thickness))
    px, py = (np.linspace(0.0, size, 4) for size in layer_size)
    flat = np.ones((4, 4))
    problem = LayerProblem(
        grid,
        Imprint(px, py, initial_thickness * flat, loaded_thickness * flat),
        material,
        (friction, sample_friction),
        slip_length=_PRELOAD_SLIP,
    )
    stress = -float(material.uniaxial_stress(-compression / initial_thickness, "true"))

    def bound(level: LayerProblem) -> Array:
        return 2.0 * stress * level.grid.areas

    try:
        state = solve(problem, bound, solver="multigrid", tolerances=Tolerances()).state
        loaded, force = state.u.copy(), float(state.normal_force[SAMPLE].sum())
        remember_slip(problem, state)
        state.load = 1.0 + step / compression
        for share in _STEP_SLIPS:
            fine = replace(problem, slip_length=share * step)
            linear = make_solver(fine, "multigrid")
            now, _ = equilibrate(fine, state, linear, Tolerances(iterations=60))
            state = now.state
    except (LoadNotReached, NotConverged) as failure:
        raise ConvergenceError(
            f"flat layer with friction {friction:g} at the window, compressed by "
            f"{100.0 * compression / initial_thickness:.3g} %: {failure}. Less compression or "
            "friction, or more elements through the depth, may help"
        ) from None

    weight = np.outer(*(_weights(nodes, region) for nodes in (y, x)))

    def mean(field: Array) -> Array:
        return np.asarray(np.sum(field * weight, axis=(1, 2)))

    return xr.Dataset(
        {
            "depth": ("unloaded_depth", mean(grid.nodes[2] + loaded[2]) / loaded_thickness),
            "displacement": ("unloaded_depth", mean(loaded[2]), {"units": "mm"}),
            "increment": ("unloaded_depth", mean(state.u[2] - loaded[2]), {"units": "mm"}),
        },
        coords={"unloaded_depth": grid.depth},
        attrs={"force_mN": force},
    )


def calibration_curves(
    friction: Sequence[float],
    *,
    layer_size: tuple[float, float],
    initial_thickness: float,
    loaded_thickness: float,
    material: Law,
    region: float,
    sample_friction: float = 0.1,
    step: float = 5e-4,
    elements: int = 6,
    on_curve: Callable[[float], None] | None = None,
    each: Callable[..., Iterable[xr.Dataset]] = map,
) -> xr.DataArray:
    """Normalised incremental displacement against depth for several coefficients (figure 2a).

    Parameters
    ----------
    friction
        Coefficients of friction at the window, at least two, increasing. Estimates are confined to
        their range; steps of 0.05 to 0.1 are fine enough.
    layer_size, initial_thickness, loaded_thickness, material, region
        As for :func:`slab_profile`; likewise `sample_friction`, `step` and `elements`.
    on_curve
        Called with each coefficient when its curve is done.
    each
        Applies a function to each coefficient and gives the results in order, as ``map`` does: that
        of :func:`~optical_palpation.batch.worker_map` computes curves side by side.

    Returns
    -------
    xarray.DataArray
        ``normalised_displacement`` over ``friction`` and ``depth`` (fraction of the loaded layer,
        0 at the window), 0 at the window and 1 at the sample.
    """
    values = [number(mu, "friction", "coefficients of friction") for mu in friction]
    if len(values) < 2 or any(b <= a for a, b in pairwise(values)):
        raise InputError(f"friction = {values}: give at least two coefficients, increasing")
    for mu in (*values, number(sample_friction, "sample_friction", "a coefficient of friction")):
        if not 0.0 <= mu <= LARGEST_FRICTION:
            raise InputError(
                f"friction = {mu:g}: coefficients lie between 0 and {LARGEST_FRICTION:g}, "
                "as in a study"
            )
    depth = np.linspace(0.0, 1.0, 41)
    profile = partial(
        slab_profile,
        layer_size=layer_size,
        initial_thickness=initial_thickness,
        loaded_thickness=loaded_thickness,
        material=material,
        region=region,
        sample_friction=sample_friction,
        step=step,
        elements=elements,
    )
    rows, forces = [], []
    for mu, slab in zip(values, each(profile, values), strict=True):
        increment = slab["increment"].values
        curve = PchipInterpolator(slab["depth"].values, increment / increment[-1])
        rows.append(curve(np.clip(depth, slab["depth"].values[0], slab["depth"].values[-1])))
        forces.append(slab.attrs["force_mN"])
        if on_curve is not None:
            on_curve(mu)
    return xr.DataArray(
        rows,
        dims=("friction", "depth"),
        coords={"friction": values, "depth": depth, "force": ("friction", forces, {"units": "mN"})},
        name="normalised_displacement",
        attrs={
            "units": "1",
            "initial_thickness_mm": initial_thickness,
            "loaded_thickness_mm": loaded_thickness,
            "layer_size_mm": list(layer_size),
            "sample_friction": sample_friction,
            "step_mm": step,
            "region_mm": region,
            **material.attributes,
            "bulk_to_shear": material.bulk_to_shear,
        },
    )


def write_calibration(calibration: xr.DataArray, path: str | Path) -> None:
    """Write calibration curves, with all they were made for, as NetCDF.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    dataset = calibration.to_dataset(name="normalised_displacement")
    dataset.attrs = {
        "software": "optical-palpation",
        "software_version": software_version(),
    }
    content = netcdf(dataset)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_calibration(
    path: str | Path, *, loaded_thickness: float | None = None, region: float | None = None
) -> xr.DataArray:
    """Read back what :func:`write_calibration` wrote.

    Parameters
    ----------
    path
        The file.
    loaded_thickness, region
        Those of the measurement, mm, if they are to be compared with the calibration's.

    Raises
    ------
    InputError
        The file is missing, holds no calibration curves, or they were made for another thickness
        or region (by more than 2 %).
    """
    path = Path(path)
    if not os.path.isfile(path):
        raise InputError(f"{path}: no such file")
    try:
        with hdf5.open_file(path):  # refuses what is no NetCDF-4 file, or damaged
            pass
        dataset = xr.load_dataset(path, engine="h5netcdf")
    except InputError:
        raise
    except Exception as error:  # whatever the libraries make of damaged data
        raise InputError(f"{path}: is a damaged calibration ({error})") from error
    if "normalised_displacement" not in dataset:
        found = ", ".join(map(str, dataset.data_vars)) or "nothing"
        raise InputError(f"{path}: holds no calibration curves, but {found}")
    calibration = dataset["normalised_displacement"]
    for name, measured in (("loaded_thickness", loaded_thickness), ("region", region)):
        made_for = calibration.attrs.get(f"{name}_mm", np.nan)
        if measured is not None and not abs(measured - made_for) <= 0.02 * made_for:
            raise InputError(
                f"{path}: was made for a {name.replace('_', ' ')} of {made_for:g} mm, and that of "
                f"the measurement is {measured:g} mm; make new curves"
            )
    return calibration


def _nodes_about_centre(size: float, finest: float) -> Array:
    """Node coordinates from 0 to `size`, `finest` apart at the centre and growing outwards."""
    half, distances, width = 0.5 * size, [0.0], finest
    while distances[-1] < half:
        distances.append(distances[-1] + width)
        width = min(1.2 * width, size / 12.0)
    outwards = np.array(distances[1:]) * half / distances[-1]
    return half + np.concatenate([-outwards[::-1], [0.0], outwards])


def _weights(nodes: Array, region: float) -> Array:
    """Weights of the mean, over `region` about the centre, of a function linear between nodes."""
    centre = 0.5 * (nodes[0] + nodes[-1])
    if region == 0.0:
        points = np.array([centre])
    else:
        points = centre + region * (np.arange(200) + 0.5 - 100.0) / 200.0
    hats = np.array([np.interp(points, nodes, row) for row in np.eye(nodes.size)])
    return np.asarray(hats.mean(axis=1))
