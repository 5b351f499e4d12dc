"""Stress on a deformable sample that nobody tracked, and the sample's stiffness.

The computational method takes the sample's surface as a rigid imprint. A soft sample spreads under
the load and drags the layer along, which the thickness does not say. Here the sample is in the
model: layer and sample are pressed between window and plate, and the sample is given the stiffness,
column by column, with which the layer gets as thick as it was measured (``inversion``). Several
loads also tell the relief of its unloaded surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.arguments import explained
from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.material import Law, NeoHookean
from optical_palpation.mechanics.grid import node_positions
from optical_palpation.mechanics.path import LoadNotReached
from optical_palpation.mechanics.stack.assembly import Blocks, Mesh, count_elements
from optical_palpation.palpation.computational import computational_stress
from optical_palpation.palpation.input_errors import INPUT_ERRORS, InputErrors
from optical_palpation.palpation.memory import check_stack_memory
from optical_palpation.palpation.plausibility import check_elements
from optical_palpation.palpation.progress import Progress
from optical_palpation.palpation.result import StressResult
from optical_palpation.palpation.threads import limited_threads
from optical_palpation.stiffness.errors import propagated
from optical_palpation.stiffness.forward import Columns, Model, Sought, meshes_of
from optical_palpation.stiffness.inversion import FORCE, Estimate, invert
from optical_palpation.stiffness.maps import as_rigid, sample_result
from optical_palpation.stiffness.measurement import ThicknessSurface, without_noise
from optical_palpation.stiffness.sample import (
    COARSER,
    RIGID,
    Sample,
    as_loads,
    check_sample,
    check_sample_elements,
)
from optical_palpation.thickness.cleaning import clean_thickness
from optical_palpation.thickness.frames import (
    layer_extent_of,
    on_grid,
    smooth_map,
    typical_thickness,
)
from optical_palpation.thickness.initial import match_initial_thickness

Array = NDArray[np.float64]

#: Elements of the mesh on which sensitivities are computed, at most.
_COARSE_ELEMENTS = 5000
#: Misfit, as a multiple of noise and mesh error, above which the model does not fit.
_NO_FIT = 5.0
#: The same as a share of the indentation, where the mesh is too coarse to tell.
_FAR_OFF = 0.1
#: By so many standard deviations of its surface a layer is thinner where something touches it.
_TOUCHING = 5.0
#: Share of the sample's thickness that the travel has more than the layer takes, to begin with
#: where a force is given. It is less than it mostly has: with the travel the force that goes with
#: the measured thickness falls at first, but rises again with one that is far too large.
_GUESS = 0.05
#: Error of a total force that is only checked.
_FORCE_READING = 0.05


@explained
def sample_stress(
    loaded: xr.DataArray | Sequence[xr.DataArray],
    initial_thickness: float | xr.DataArray,
    material: Law,
    sample: Sample,
    *,
    window_friction: float,
    sample_friction: float,
    element_size: float,
    smoothing: float | None = None,
    noise: float | None = None,
    input_errors: InputErrors | None = INPUT_ERRORS,
    threads: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> StressResult:
    """Compute the stress on a deformable sample and its stiffness.

    Parameters
    ----------
    loaded
        Loaded thickness, mm, on ``(y, x)``, as for
        :func:`~optical_palpation.palpation.computational_stress`; missing values need not be
        filled. Of a series of loads, without unloading between them, one map for each, in the order
        of loading: then the relief is found, too, unless it is given.
    initial_thickness, material, window_friction, sample_friction
        As for that function.
    sample
        What is known of the sample.
    element_size
        Of the layer's elements, mm.
    smoothing
        Regularisation of stiffness and relief, about 1e-3 (next to none) to 10 (next to uniform);
        by default what the noise demands.
    noise
        Standard deviation of a pixel of the loaded thickness, mm; by default from each map itself.
    input_errors
        Errors of the inputs, for the error bands; with None these are of noise and mesh alone.
    threads
        Number of threads; by default one for each core that the process may use.
    progress
        Called with a :class:`~optical_palpation.palpation.Progress` now and then.

    Returns
    -------
    StressResult
        Maps as of ``computational_stress``, and on ``(y, x)``: ``sample_shear_modulus`` and
        ``sample_youngs_modulus``, kPa, of the column of the sample that is there under load (NaN
        where nothing is known of it), ``sample_displacement_x`` and ``sample_displacement_y``, mm,
        ``thickness_misfit``, computed less measured, mm (NaN where it was not measured; from the
        attributes half the estimated error of the mesh is taken off), and half the width of 95 %
        bands:
        ``axial_stress_error``, kPa, and ``sample_modulus_error``, as a share of the modulus. They
        are those of the last load; ``series`` has them for each ``load``. Where the relief was
        sought, ``sample_relief`` and ``sample_relief_error``, mm, on unloaded positions.

    Raises
    ------
    InputError
        For a parameter or map that cannot be used.
    ConvergenceError
        If no stiffness of the sample explains the thickness, or the load is not reached.
    """
    loads = as_loads(loaded)
    initial = match_initial_thickness(initial_thickness, loads[-1])
    check_sample(sample, loads, initial, material)
    if noise is not None and not (np.isfinite(noise) and noise > 0):
        raise InputError(f"noise must be a positive number of mm, not {noise!r}")
    if smoothing is not None and not (np.isfinite(smoothing) and smoothing > 0):
        raise InputError(f"smoothing must be a positive number, not {smoothing!r}")
    x0, x1, y0, y1 = extent = layer_extent_of(loads[-1])
    thickness = typical_thickness(initial)
    if input_errors is not None:
        input_errors.check_thickness(thickness)
    check_elements(element_size, (x1 - x0, y1 - y0), thickness, "the thickness of the layer")
    check_sample_elements(element_size, (x1 - x0, y1 - y0), sample.size)
    blocks = Blocks(
        extent=extent,
        thickness=smooth_map(without_noise(initial, element_size)),
        law=material,
        sample_size=sample.size or (x1 - x0, y1 - y0),
        sample_thickness=sample.thickness,
        sample_law=sample.law or NeoHookean(c10=0.5 * material.shear_modulus),
        relief=(
            smooth_map(without_noise(on_grid(sample.relief, "relief"), element_size))
            if isinstance(sample.relief, xr.DataArray)
            else _flat
        ),
        friction=(window_friction, sample_friction, sample.plate_friction),
        travel=0.0 if sample.travels is None else sample.travels[-1],
    )
    check_stack_memory(blocks, Mesh(element_size))
    columns = _columns(blocks, element_size)
    if progress:
        progress(Progress("preparing", 0.0, 0, "the first run compiles for up to a minute"))
    measured = [ThicknessSurface.fitted(each, element_size) for each in loads]
    if noise is not None:
        measured = [replace(each, noise=noise) for each in measured]
    start = _start(measured, blocks, columns, sample)
    if start is None:
        still = [
            _on_imprint(
                each, initial_thickness, blocks, element_size, input_errors, threads, progress
            )
            for each in loads
        ]
        of_each = [result.maps.attrs for result in still]
        parts = "force_error_mN", "force_mesh_error_mN"
        doubts = _check_force(
            sample,
            sample.travels or (),
            [attrs["window_force_mN"] for attrs in of_each],
            [float(np.hypot(*(attrs.get(name, 0.0) for name in parts))) for attrs in of_each],
        )
        return as_rigid(still, sample, blocks, doubts)
    blocks = replace(blocks, travel=start.travels[-1])
    fine, coarse = _models(blocks, Mesh(element_size), columns, thickness)
    solved = 0

    def report(stage: str, load: float) -> None:
        nonlocal solved
        solved += 1
        if progress:
            progress(Progress(stage, load, solved))

    try:
        with limited_threads(threads):
            estimate = invert(
                fine,
                coarse,
                measured,
                start,
                total_forces=sample.forces if sample.travels is None else None,
                smoothing=smoothing,
                progress=report,
            )
            _check_fit(estimate)
            errors = propagated(estimate, coarse, measured, input_errors, report)
    except LoadNotReached as failure:
        raise ConvergenceError(
            f"layer and sample were compressed {failure.how_far(f'{blocks.travel:.3g} mm')}: "
            f"{failure.reason}. Check the compression and the "
            "thickness of the sample, or try another element_size"
        ) from None
    doubts = _check_force(
        sample,
        estimate.sought.travels,
        [pressed.force for pressed in estimate.pressed],
        [band.force for band in errors.loads],
    )
    return sample_result(estimate, errors, loads, initial_thickness, sample, fine, measured, doubts)


def _flat(x: Array, _: Array) -> Array:
    return np.zeros_like(x)


def _columns(blocks: Blocks, size: float) -> Columns:
    """Columns as wide as elements, of the sample below the middle of the layer."""
    x0, x1, y0, y1 = blocks.extent
    borders = []
    for (low, high), width in zip(((y0, y1), (x0, x1)), blocks.sample_size[::-1], strict=True):
        middle = 0.5 * (low + high)
        borders.append(node_positions(width, size, middle - 0.5 * width))
    return Columns(*borders)


def _models(blocks: Blocks, mesh: Mesh, columns: Columns, thickness: float) -> tuple[Model, Model]:
    """The model on the finest mesh and on a coarse one, for sensitivities."""
    factor = COARSER
    while count_elements(blocks, mesh.coarser(factor, thickness)) > _COARSE_ELEMENTS:
        factor *= 1.1
    coarser = mesh.coarser(factor, thickness)
    fine, coarse = (Model(blocks, meshes_of(blocks, each), columns) for each in (mesh, coarser))
    return fine, coarse


def _start(
    measured: Sequence[ThicknessSurface], blocks: Blocks, columns: Columns, sample: Sample
) -> Sought | None:
    """What to begin with: columns of layer and sample as springs; None if the sample is rigid.

    Raises
    ------
    InputError
        If nothing touches, or the plate moved less than the layer gave way.
    """
    law, forces = blocks.sample_law, sample.travels is None
    travels = sample.travels or (0.0,) * len(measured)
    springs = [_springs(m, blocks, columns, t) for m, t in zip(measured, travels, strict=True)]
    if forces:
        # to begin with; the force decides
        last = springs[-1]
        travels = tuple(s.taken * (1 + _GUESS * sample.thickness / last.taken) for s in springs)
        springs = [_springs(m, blocks, columns, t) for m, t in zip(measured, travels, strict=True)]
    last = springs[-1]
    if not sample.relief_is_sought:
        if not forces and _is_rigid(last.shorter, travels[-1]):
            return None
        level = np.log(last.stress / (3 * last.strain * law.shear_modulus))
        return Sought(np.full(columns.shape, level), travels)
    # The relief takes none of what is added from load to load.
    first = springs[0]
    shorter = last.shorter - first.shorter
    if _is_rigid(shorter, travels[-1] - travels[0]):
        return None
    stress, strain = max(last.stress - first.stress, 0.1 * last.stress), shorter / sample.thickness
    level = np.log(stress / (3 * strain * law.shear_modulus))
    # Flat, and touched at each load: springs of their own would take much of the stiffness for it.
    gap = min(last.shorter - last.stress * shorter / stress, 0.5 * travels[0])
    return Sought(np.full(columns.shape, level), travels, np.full(columns.corners, -gap))


def _is_rigid(shorter: float, travel: float) -> bool:
    """Whether a sample that gets so much shorter takes next to nothing of a travel.

    Raises
    ------
    InputError
        If it would get longer.
    """
    if shorter < -RIGID * travel:
        raise InputError(
            f"sample: where it touches, the layer gave way by {-shorter:.3g} mm more than a "
            f"compression of {travel:.3g} mm and the relief leave it: the plate cannot have moved "
            "so little. Check the compression, the relief and the unloaded thickness"
        )
    return shorter < RIGID * travel


@dataclass(frozen=True)
class _Springs:
    """Layer and sample as if their columns were springs.

    Medians, over the corners of the columns that touch, of the ``stress``, kPa, of how much
    ``shorter`` the sample's columns are, mm and as a ``strain``, and of the travel that the layer
    takes, ``taken``, mm.
    """

    stress: float
    shorter: float
    strain: float
    taken: float


def _springs(
    measured: ThicknessSurface, blocks: Blocks, columns: Columns, travel: float
) -> _Springs:
    x, y = np.meshgrid(columns.x, columns.y)
    unloaded, height = blocks.thickness(x, y), blocks.relief(x, y)
    inside = measured.covers(x, y)
    loaded = measured(x.ravel(), y.ravel()).reshape(x.shape)
    stretch = np.clip(np.where(inside, loaded, np.nan) / unloaded, 0.05, 1.0)
    apart = blocks.reach(columns.x, columns.y) - unloaded - height
    thinner = unloaded * (1 - stretch)
    shorter = travel - apart - thinner
    pressure = blocks.law.strain_adjusted_modulus(stretch - 1) * (1 - stretch)
    # Noise makes half of what nothing touches thinner, too.
    touching = thinner > _TOUCHING * measured.noise / np.sqrt(measured.pixels)
    if travel:
        touching &= apart < travel
    if not touching.any():
        raise InputError(
            "the sample does not touch the layer: where the two could meet, that is nowhere "
            f"thinner than unloaded by more than its noise, {1e3 * measured.noise:.2g} um a pixel"
        )
    strain = shorter / (blocks.sample_thickness + height)
    each = (pressure, shorter, strain, travel - shorter)
    return _Springs(*(float(np.median(values[touching])) for values in each))


def _on_imprint(
    loaded: xr.DataArray,
    initial_thickness: float | xr.DataArray,
    blocks: Blocks,
    element_size: float,
    input_errors: InputErrors | None,
    threads: int | None,
    progress: Callable[[Progress], None] | None,
) -> StressResult:
    """The layer on a rigid imprint."""
    if bool(loaded.isnull().any()):
        loaded = clean_thickness(loaded)["thickness"]
    return computational_stress(
        loaded,
        initial_thickness,
        blocks.law,
        window_friction=blocks.friction[0],
        sample_friction=blocks.friction[1],
        element_size=element_size,
        input_errors=input_errors,
        threads=threads,
        progress=progress,
    )


def _check_force(
    sample: Sample, travels: Sequence[float], forces: Sequence[float], bands: Sequence[float]
) -> list[str]:
    """Refuse a total force that contradicts the travel; say which lies beyond its error.

    Raises
    ------
    ConvergenceError
    """
    said = []
    for given, travel, force, band in zip(
        sample.forces or (), travels, forces, bands, strict=False
    ):
        # A force that was sought is met to a tolerance, and the band has its error already.
        reading = given * (_FORCE_READING if sample.travels else FORCE)
        found = f"{force:.4g} +- {band:.2g} mN"
        if abs(force - given) > band + _FORCE_READING * given:
            raise ConvergenceError(
                f"sample: compression and total force contradict each other: with a travel of "
                f"{travel:.3g} mm the force would be {found}, not {given:g} mN. Give the one that "
                "is known better"
                if sample.travels
                else f"sample: no travel makes the total force of {given:g} mN; the nearest, "
                f"{travel:.3g} mm, makes {found}. Check the force and the thickness of the sample"
            )
        if abs(force - given) > np.hypot(band, reading):
            said.append(
                f"the total force found, {found}, and the one given, {given:g} mN, differ by more "
                "than their errors: check the force, the travel and the frictions"
            )
    return said


def _check_fit(estimate: Estimate) -> None:
    """Refuse an estimate that does not explain the thickness.

    Raises
    ------
    ConvergenceError
        Saying where it does not.
    """
    grid = estimate.pressed[-1].layer
    thickness = grid.typical_thickness
    y, x = (
        np.minimum(nodes - nodes[0], nodes[-1] - nodes) >= thickness for nodes in (grid.y, grid.x)
    )
    interior = y[:, None] & x  # the rim rolls, which the mesh decides
    # that of the last load counts: an early one of little contact tells little
    indentation = grid.thickness - estimate.pressed[-1].surface[2]
    count = len(estimate.pressed)
    for n, (pressed, all_misfit, measured) in enumerate(
        zip(estimate.pressed, estimate.misfit, estimate.measured, strict=True), start=1
    ):
        inside = interior & measured
        if not inside.any():
            inside = measured

        def mean(values: Array, inside: NDArray[np.bool_] = inside) -> float:
            return float(np.sqrt(np.mean(values[inside] ** 2)))

        misfit = np.where(inside, all_misfit, 0.0)
        left, off = mean(misfit / estimate.tolerance[n - 1]), mean(misfit)
        share = off / mean(indentation)
        if left <= _NO_FIT and share <= _FAR_OFF:
            continue
        worst = np.unravel_index(int(np.abs(misfit).argmax()), misfit.shape)
        at_x, at_y, _ = pressed.surface[:, worst[0], worst[1]]
        here = "" if count == 1 else f" of load {n}"
        coarse = ", or use smaller elements: those may be what is off" if left <= _NO_FIT else ""
        raise ConvergenceError(
            f"no stiffness of the sample explains the loaded thickness{here}: it stays off by "
            f"{1e3 * off:.3g} um ({share:.0%} of the indentation, {left:.1f} times "
            f"what noise and mesh explain), most at x = {at_x:.2f}, y = {at_y:.2f} mm. Check the "
            "compression, the thickness and the relief of the sample, the unloaded thickness, and "
            "that pixels beside the layer are missing" + coarse
        )
