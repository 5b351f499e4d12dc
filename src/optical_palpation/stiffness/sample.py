"""Stress on a deformable sample that nobody tracked, and the sample's stiffness.

The computational method takes the sample's surface as a rigid imprint. A soft sample spreads under
the load and drags the layer along, which the thickness does not say. Here the sample is in the
model: layer and sample are pressed between window and plate, and the sample is given the stiffness,
column by column, with which the layer gets as thick as it was measured (``inversion``).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.arguments import check_instance
from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.material import Law, NeoHookean
from optical_palpation.mechanics.grid import node_positions
from optical_palpation.mechanics.path import LoadNotReached
from optical_palpation.mechanics.stack.assembly import Blocks, Mesh
from optical_palpation.mechanics.stack.newton import balance
from optical_palpation.mechanics.stack.problem import LAYER
from optical_palpation.palpation.algebraic import algebraic_stress
from optical_palpation.palpation.computational import computational_stress, residuals
from optical_palpation.palpation.plausibility import WIDEST_FIELD, check_elements
from optical_palpation.palpation.progress import Progress
from optical_palpation.palpation.result import StressResult
from optical_palpation.palpation.stack_maps import body_dataset, observed_maps
from optical_palpation.palpation.threads import limited_threads
from optical_palpation.stiffness.errors import Errors, InputErrors, propagated
from optical_palpation.stiffness.forward import Columns, Model
from optical_palpation.stiffness.inversion import Estimate, invert
from optical_palpation.stiffness.measurement import ThicknessSurface
from optical_palpation.thickness.cleaning import clean_thickness
from optical_palpation.thickness.frames import inside_layer, layer_extent_of, on_grid
from optical_palpation.thickness.initial import match_initial_thickness

Array = NDArray[np.float64]

#: Elements of the mesh on which sensitivities are computed, at most.
_COARSE_ELEMENTS = 5000
#: Misfit, as a multiple of noise and mesh error, above which the model does not fit.
_NO_FIT = 5.0
#: The same as a share of the indentation, where the mesh is too coarse to tell.
_FAR_OFF = 0.1
#: Standard deviation of the logarithm of a column's stiffness above which nothing is known of it.
_UNKNOWN = 0.5
#: Share of the travel that a sample must take, or it is as good as rigid: nobody knows the travel
#: much better.
_RIGID = 0.03
#: Share of the sample's thickness that the travel has more than the layer takes, to begin with.
_GUESS = 0.15
#: Error of a total force that is only checked.
_FORCE_READING = 0.05
#: Share of the sample's thickness by which it can be compressed at most.
_MOST_COMPRESSED = 0.7


#: Maps that a result with a sample has more than one without: units and meaning.
SAMPLE_MAPS = {
    "sample_displacement_x": ("mm", "lateral displacement of the sample's surface, x"),
    "sample_displacement_y": ("mm", "lateral displacement of the sample's surface, y"),
    "thickness_misfit": ("mm", "computed less measured loaded thickness"),
    "sample_shear_modulus": ("kPa", "initial shear modulus of the sample"),
    "sample_youngs_modulus": ("kPa", "initial Young's modulus of the sample"),
    "sample_modulus_error": ("1", "half the 95 % band of the modulus over the modulus"),
    "axial_stress_error": ("kPa", "half the 95 % band of the axial stress"),
}


@dataclass(frozen=True)
class Sample:
    """What is known of a deformable sample.

    Attributes
    ----------
    thickness
        Unloaded, mm; that below a relief of 0.
    compression
        Travel of the plate after layer and sample have met, mm; ``None`` if the force is given.
    plate_friction
        Coulomb coefficient between sample and plate.
    relief
        Height of the unloaded surface on ``(y, x)``, mm, towards the layer; flat by default.
    size
        Width along x and y, mm; by default that of the layer, below which it is centred.
    law
        Its law; only how stress grows with strain counts, the stiffness is what is sought. By
        default neo-Hookean and incompressible.
    total_force
        On the window, mN. In place of the travel of the plate, which is then found too, or beside
        it, as a check.
    """

    thickness: float
    compression: float | None
    plate_friction: float
    relief: xr.DataArray | None = None
    size: tuple[float, float] | None = None
    law: Law | None = None
    total_force: float | None = None


def sample_stress(
    loaded: xr.DataArray,
    initial_thickness: float | xr.DataArray,
    material: Law,
    sample: Sample,
    *,
    window_friction: float,
    sample_friction: float,
    element_size: float,
    smoothing: float | None = None,
    noise: float | None = None,
    input_errors: InputErrors | None = None,
    threads: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> StressResult:
    """Compute the stress on a deformable sample and its stiffness.

    Parameters
    ----------
    loaded, initial_thickness, material, window_friction, sample_friction
        As for :func:`~optical_palpation.palpation.computational_stress`; missing values of the
        loaded thickness need not be filled.
    sample
        What is known of the sample.
    element_size
        Of the layer's elements, mm.
    smoothing
        Regularisation of the stiffness, about 1e-3 (next to none) to 10 (next to uniform); by
        default what the noise demands.
    noise
        Standard deviation of a pixel of the loaded thickness, mm; by default from the map itself.
    input_errors
        Standard errors of the inputs, for the error bands.
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
        ``thickness_misfit``, computed less measured, mm, and half the width of 95 % bands:
        ``axial_stress_error``, kPa, and ``sample_modulus_error``, as a share of the modulus.

    Raises
    ------
    InputError
        For a parameter or map that cannot be used.
    ConvergenceError
        If no stiffness of the sample explains the thickness, or the load is not reached.
    """
    loaded = on_grid(loaded)
    initial = match_initial_thickness(initial_thickness, loaded)
    check_sample(sample, loaded, initial)
    if noise is not None and not (np.isfinite(noise) and noise > 0):
        raise InputError(f"noise must be a positive number of mm, not {noise!r}")
    if smoothing is not None and not (np.isfinite(smoothing) and smoothing > 0):
        raise InputError(f"smoothing must be a positive number, not {smoothing!r}")
    x0, x1, y0, y1 = extent = layer_extent_of(loaded)
    thickness = float(initial.median())
    check_elements(element_size, (x1 - x0, y1 - y0), thickness, "the thickness of the layer")
    law = sample.law or NeoHookean(c10=0.5 * material.shear_modulus)
    size = sample.size or (x1 - x0, y1 - y0)
    unloaded = _field(initial)
    blocks = Blocks(
        extent=extent,
        thickness=unloaded,
        law=material,
        sample_size=size,
        sample_thickness=sample.thickness,
        sample_law=law,
        relief=(lambda x, _: np.zeros_like(x)) if sample.relief is None else _field(sample.relief),
        friction=(window_friction, sample_friction, sample.plate_friction),
        travel=sample.compression or 0.0,
    )
    columns = _columns(blocks, element_size)
    if progress:
        progress(Progress("preparing", 0.0, 0, "the first run compiles for up to a minute"))
    measured = ThicknessSurface.fitted(loaded, element_size)
    if noise is not None:
        measured = replace(measured, noise=noise)
    springs = _springs(measured, blocks, columns)
    if sample.compression is None:
        # to begin with; the force decides
        travel = springs.indentation + _GUESS * sample.thickness
        blocks = replace(blocks, travel=travel)
        springs = _springs(measured, blocks, columns)
    elif springs.shorter < _RIGID * sample.compression:
        friction = window_friction, sample_friction
        return _as_imprint(
            loaded, initial, material, sample, size, friction, element_size, threads, progress
        )
    start = np.log(springs.stress / (3 * springs.strain * law.shear_modulus))
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
                np.full(columns.shape, start),
                noise=measured.noise / np.sqrt(measured.pixels),
                total_force=sample.total_force if sample.compression is None else None,
                smoothing=smoothing,
                progress=report,
            )
            _check_fit(estimate)
            errors = propagated(estimate, coarse, measured, input_errors or InputErrors(), report)
    except LoadNotReached as failure:
        raise ConvergenceError(
            f"layer and sample were compressed to {100 * failure.load:.1f} % of "
            f"{blocks.travel:.3g} mm only: {failure.reason}. Check the compression and the "
            "thickness of the sample, or try another element_size"
        ) from None
    _check_force(sample, estimate, errors)
    return _result(
        estimate, errors, loaded, initial, material, sample, blocks, columns, measured, element_size
    )


def check_sample(sample: Sample, loaded: xr.DataArray, initial: xr.DataArray) -> None:
    """Refuse a sample that cannot be, or cannot be pressed like that.

    Raises
    ------
    InputError
    """
    check_instance(sample, Sample, "sample", "an optical_palpation.Sample")
    if sample.compression is None and sample.total_force is None:
        raise InputError(
            "sample: give the compression (the travel of the plate, mm) or the total force (mN)"
        )
    for name in ("thickness", "compression", "plate_friction", "total_force"):
        value = getattr(sample, name)
        if value is None and name in ("compression", "total_force"):
            continue
        if not (isinstance(value, int | float | np.number) and np.isfinite(value)):
            raise InputError(f"sample: {name} must be a number, not {value!r}")
    if sample.thickness <= 0:
        raise InputError(f"sample: the thickness must be positive, not {sample.thickness:g} mm")
    if not 0 <= sample.plate_friction <= 2:
        raise InputError(f"sample: plate_friction must lie in 0 ... 2, not {sample.plate_friction}")
    if sample.total_force is not None and sample.total_force <= 0:
        raise InputError(f"sample: the total force must be positive, not {sample.total_force:g} mN")
    _check_shape(sample, loaded)
    inside = inside_layer(loaded)
    if not bool((initial - loaded).where(inside).max() > 0):
        raise InputError("the sample does not touch the layer: it is nowhere thinner than unloaded")
    if sample.compression is None:
        return
    if sample.compression <= 0:
        raise InputError(
            f"sample: the compression, {sample.compression:g} mm, must be positive: it is how far "
            "the plate moves after layer and sample have met"
        )
    together = float(initial.median()) + sample.thickness
    if sample.compression >= together:
        raise InputError(
            f"sample: the compression, {sample.compression:g} mm, is more than layer and sample "
            f"together are thick, {together:g} mm; lengths are in mm"
        )
    typical = float(np.nanmedian(np.where(inside, initial - loaded, np.nan)))
    if sample.relief is None and typical > sample.compression:
        raise InputError(
            f"sample: the layer is thinner by {typical:.3g} mm, more than the compression of "
            f"{sample.compression:g} mm: the plate cannot have moved less than the layer gave way"
        )
    left = sample.compression - typical
    if left > _MOST_COMPRESSED * sample.thickness:
        raise InputError(
            f"sample: of the compression of {sample.compression:g} mm the layer takes "
            f"{typical:.3g} mm, and the rest is more than {_MOST_COMPRESSED:.0%} of the sample's "
            f"thickness, {sample.thickness:g} mm"
        )


def _check_shape(sample: Sample, loaded: xr.DataArray) -> None:
    """Refuse a size or relief that no sample below this layer has."""
    x0, x1, y0, y1 = layer_extent_of(loaded)
    size = (x1 - x0, y1 - y0) if sample.size is None else sample.size
    if len(size) != 2 or not all(np.isfinite(width) and width > 0 for width in size):
        raise InputError(f"sample: size must be two positive numbers of mm, x and y, not {size!r}")
    if sample.thickness > WIDEST_FIELD:
        raise InputError(
            f"sample: a thickness of {sample.thickness:g} mm is more than {WIDEST_FIELD:g} mm; "
            "lengths are in mm: divide by 1000 if it is in um"
        )
    if sample.relief is None:
        return
    try:
        relief = on_grid(sample.relief)
    except InputError as error:
        raise InputError(f"sample: the relief is no map of heights in mm: {error}") from error
    if absent := int((~np.isfinite(relief.values)).sum()):
        raise InputError(
            f"sample: the relief has {absent} missing values: fill them first, smoothly"
        )
    height = float(np.ptp(relief.values))
    if height >= sample.thickness:
        raise InputError(
            f"sample: the relief is {height:.3g} mm from its lowest to its highest point, more "
            f"than the sample is thick, {sample.thickness:g} mm; lengths are in mm"
        )
    for axis, low, high, width in (("x", x0, x1, size[0]), ("y", y0, y1, size[1])):
        at = relief[axis].values
        half = 0.5 * min(high - low, width)
        first, last = 0.5 * (low + high) - half, 0.5 * (low + high) + half
        pixel = float(np.diff(at).max())
        if at[0] > first + pixel or at[-1] < last - pixel:
            raise InputError(
                f"sample: the relief spans {axis} {at[0]:g} to {at[-1]:g} mm and does not cover "
                f"what lies below the layer, {first:g} to {last:g} mm"
            )


def _field(values: xr.DataArray) -> Callable[[Array, Array], Array]:
    """A map as a function of x and y, mm, level beyond its ends."""
    from scipy.interpolate import RegularGridInterpolator

    axes = [values[axis].values for axis in "yx"]
    at = RegularGridInterpolator(axes, values.transpose("y", "x").values)

    def field(x: Array, y: Array) -> Array:
        points = [np.clip(p, axis[0], axis[-1]) for p, axis in zip((y, x), axes, strict=True)]
        return at(np.stack(points, axis=-1))

    return field


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
    fine, factor = Model(blocks, mesh, columns), 2.0
    coarse = Model(blocks, mesh.coarser(factor, thickness), columns)
    while coarse.levels[-1].n_elements > _COARSE_ELEMENTS:
        factor *= 2
        coarse = Model(blocks, mesh.coarser(factor, thickness), columns)
    return fine, coarse


@dataclass(frozen=True)
class _Springs:
    """Layer and sample as if their columns were springs: medians over the layer.

    ``stress``, kPa, how much ``shorter`` the sample's columns are, mm and as a ``strain``, and the
    travel, mm, that the layer takes, ``indentation``.
    """

    indentation: float
    stress: float
    shorter: float
    strain: float


def _springs(measured: ThicknessSurface, blocks: Blocks, columns: Columns) -> _Springs:
    y, x = (points.ravel() for points in np.meshgrid(*columns.middles, indexing="ij"))
    inside = measured.covers(x, y)
    x, y = x[inside], y[inside]
    unloaded, height = blocks.thickness(x, y), blocks.relief(x, y)
    stretch = np.clip(measured(x, y) / unloaded, 0.05, 1.0)
    apart = (unloaded + height).max() - unloaded - height
    touching = stretch < 1.0
    shorter = (blocks.travel - apart - unloaded * (1 - stretch))[touching]
    strain = shorter / (blocks.sample_thickness + height[touching])
    stress = (blocks.law.strain_adjusted_modulus(stretch - 1) * (1 - stretch))[touching]
    taken = blocks.travel - shorter
    return _Springs(*(float(np.median(values)) for values in (taken, stress, shorter, strain)))


def _as_imprint(
    loaded: xr.DataArray,
    initial: xr.DataArray,
    material: Law,
    sample: Sample,
    size: tuple[float, float],
    friction: tuple[float, float],
    element_size: float,
    threads: int | None,
    progress: Callable[[Progress], None] | None,
) -> StressResult:
    """The layer on a rigid imprint: nothing can be said of the stiffness."""
    if bool(loaded.isnull().any()):
        loaded = clean_thickness(loaded)["thickness"]
    result = computational_stress(
        loaded,
        initial,
        material,
        window_friction=friction[0],
        sample_friction=friction[1],
        element_size=element_size,
        threads=threads,
        progress=progress,
    )
    still = xr.zeros_like(result.maps["axial_stress"])
    for name, (units, text) in SAMPLE_MAPS.items():
        values = still if name.startswith("sample_displacement") else np.nan * still
        result.maps[name] = values.assign_attrs(units=units, long_name=text)
    result.maps.attrs |= _sample_attributes(sample, size)
    if sample.compression is not None:
        result.maps.attrs["compression_mm"] = float(sample.compression)
    result.maps.attrs["sample_rigid"] = "yes"
    return result


def _sample_attributes(sample: Sample, size: tuple[float, float]) -> dict[str, Any]:
    return {
        "plate_friction": float(sample.plate_friction),
        "sample_thickness_mm": float(sample.thickness),
        "sample_size_mm": [float(width) for width in size],
        "sample_relief": "flat" if sample.relief is None else "given",
        **{
            f"sample_relief_{key}": value
            for key, value in ({} if sample.relief is None else sample.relief.attrs).items()
            if key in ("source", "source_sha256")
        },
    }


def _check_force(sample: Sample, estimate: Estimate, errors: Errors) -> None:
    """Refuse a total force that the travel of the plate contradicts.

    Raises
    ------
    ConvergenceError
    """
    force = sample.total_force
    if (
        force is None
        or abs(estimate.pressed.force - force) <= errors.force + _FORCE_READING * force
    ):
        return
    raise ConvergenceError(
        f"sample: compression and total force contradict each other: with a travel of "
        f"{estimate.travel:.3g} mm the force would be {estimate.pressed.force:.4g} +- "
        f"{errors.force:.2g} mN, not {force:g} mN. Give the one that is known better"
    )


def _check_fit(estimate: Estimate) -> None:
    """Refuse an estimate that does not explain the thickness.

    Raises
    ------
    ConvergenceError
        Saying where it does not.
    """
    surface, grid = estimate.pressed.surface, estimate.pressed.layer
    thickness = float(np.median(grid.thickness))
    y, x = (
        np.minimum(nodes - nodes[0], nodes[-1] - nodes) >= thickness for nodes in (grid.y, grid.x)
    )
    inside = y[:, None] & x  # the rim rolls, which the mesh decides
    if not inside.any():
        inside[:] = True
    misfit = np.where(inside, estimate.misfit, 0.0)

    def mean(values: Array) -> float:
        return float(np.sqrt(np.mean(values[inside] ** 2)))

    left, off = mean(misfit / estimate.tolerance), mean(misfit)
    indentation = mean(grid.thickness - surface[2])
    if left <= _NO_FIT and off <= _FAR_OFF * indentation:
        return
    worst = np.unravel_index(int(np.abs(misfit).argmax()), misfit.shape)
    at_x, at_y, _ = surface[:, worst[0], worst[1]]
    raise ConvergenceError(
        f"no stiffness of the sample explains the loaded thickness: it stays off by "
        f"{1e3 * off:.3g} um ({off / indentation:.0%} of the indentation, {left:.1f} times what "
        f"noise and mesh explain), most at x = {at_x:.2f}, y = {at_y:.2f} mm. Check the "
        "compression, the thickness and the relief of the sample, and the unloaded thickness"
    )


def _result(
    estimate: Estimate,
    errors: Errors,
    loaded: xr.DataArray,
    initial: xr.DataArray,
    material: Law,
    sample: Sample,
    blocks: Blocks,
    columns: Columns,
    measured: ThicknessSurface,
    element_size: float,
) -> StressResult:
    """Maps and attributes of an estimate."""
    stack, state = estimate.pressed.stack, estimate.pressed.state
    x0, x1, y0, y1 = blocks.extent
    x = node_positions(x1 - x0, element_size, x0)
    y = node_positions(y1 - y0, element_size, y0)
    maps = observed_maps(stack, state, x, y).drop_vars(["unloaded_thickness"])
    there = np.meshgrid(x, y)
    computed = maps["loaded_thickness"].values
    off = computed - measured(there[0].ravel(), there[1].ravel()).reshape(computed.shape)
    maps["loaded_thickness"] = loaded.interp(x=x, y=y, kwargs={"fill_value": "extrapolate"})
    algebraic = algebraic_stress(loaded, initial, material)
    maps["algebraic_axial_stress"] = np.minimum(
        algebraic.interp(x=x, y=y, kwargs={"fill_value": "extrapolate"}), 0.0
    )
    for name in ("loaded_thickness", "algebraic_axial_stress"):
        maps[name].attrs = {"units": "mm" if name == "loaded_thickness" else "kPa"}

    moved = [maps[f"sample_displacement_{axis}"].values for axis in "xy"]
    of_column = [points - shift for points, shift in zip(there, moved, strict=True)]
    spread = np.sqrt(np.diag(estimate.covariance)[: estimate.stiffness.size])
    unknown = spread.reshape(columns.shape) > _UNKNOWN
    known = columns.at(np.where(unknown, np.nan, 0.0), *of_column) == 0.0
    known &= (maps["contact_state"].values > 0) & np.isfinite(computed)
    modulus = blocks.sample_law.shear_modulus * np.exp(columns.at(estimate.stiffness, *of_column))
    modulus = np.where(known, modulus, np.nan)
    youngs = modulus * blocks.sample_law.initial_youngs_modulus / blocks.sample_law.shear_modulus
    half = np.where(known, columns.at(errors.stiffness, *of_column), np.nan)
    there_is = np.isfinite(computed)
    new = {
        "thickness_misfit": off,
        "sample_shear_modulus": modulus,
        "sample_youngs_modulus": youngs,
        "sample_modulus_error": half,
        "axial_stress_error": np.where(there_is, errors.stress_at(*there), np.nan),
    }
    for name, values in new.items():
        units, text = SAMPLE_MAPS[name]
        maps[name] = (("y", "x"), values, {"units": units, "long_name": text})

    window, interface, plate = (float(force.sum()) for force in state.forces)
    sides = float(stack.sides.force(stack.position(state.u))[0].sum())
    window += sides
    largest = max(window, interface, plate)
    relative = estimate.misfit / estimate.tolerance
    maps.attrs = {
        **{key: value for key, value in loaded.attrs.items() if key.startswith("source")},
        "method": "computational",
        **material.attributes,
        "bulk_to_shear": material.bulk_to_shear,
        "window_friction": blocks.friction[0],
        "sample_friction": blocks.friction[1],
        "initial_thickness_mm": float(initial.where(inside_layer(loaded)).mean()),
        **_sample_attributes(sample, blocks.sample_size),
        "compression_mm": estimate.travel,
        **({} if errors.travel is None else {"compression_error_mm": errors.travel}),
        "sample_law": json.dumps(blocks.sample_law.attributes),
        "element_size_mm": list(stack.bodies[LAYER].grid.spacing[::-1]),
        "elements": stack.n_elements,
        "edges": "free",
        "window_force_mN": window,
        "sample_force_mN": interface,
        "plate_force_mN": plate,
        "force_error_mN": errors.force,
        "force_mesh_error_mN": errors.force_of_mesh,
        "force_balance": (largest - min(window, interface, plate)) / max(largest, 1e-30),
        "no_contact_share": algebraic.attrs["no_contact_share"],
        "thickness_noise_mm": measured.noise,
        "thickness_misfit_mm": float(np.sqrt(np.mean(estimate.misfit**2))),
        "misfit_over_tolerance": float(np.sqrt(np.mean(relative**2))),
        "regularisation": estimate.alpha,
        "forward_solutions": len(estimate.solutions),
        "inversion": json.dumps(
            [
                {"elements": n, "misfit_over_tolerance": None if np.isnan(q) else round(q, 3)}
                for n, q in estimate.solutions
            ]
        ),
        "error_bands": json.dumps(errors.inputs),
        **residuals(balance(stack, state)),
        "sides_force_share": sides / max(window, 1e-30),
        "slip_length_mm": stack.slip_length,
    }
    pixels = xr.Dataset({"algebraic_axial_stress": algebraic, "loaded_thickness": loaded})
    return StressResult(
        maps, body_dataset(stack, state, LAYER), pixels=pixels.drop_attrs(deep=False)
    )
