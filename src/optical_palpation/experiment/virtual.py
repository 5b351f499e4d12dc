"""Virtual experiments: a layer pressed on a deformable sample (section 6 of the paper)."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass

import xarray as xr

from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.experiment.assembly import build
from optical_palpation.experiment.scene import Scene
from optical_palpation.mechanics.path import LoadNotReached
from optical_palpation.mechanics.stack.cascade import solve
from optical_palpation.mechanics.stack.problem import LAYER, SAMPLE, Stack
from optical_palpation.palpation.algebraic import algebraic_stress
from optical_palpation.palpation.progress import Progress
from optical_palpation.palpation.stack_maps import body_dataset, observed_maps, pixels
from optical_palpation.palpation.threads import limited_threads
from optical_palpation.thickness.frames import thickness_map

#: Elements up to which the load path is followed on the mesh itself.
_COARSEST = 4000


@dataclass(frozen=True)
class ExperimentResult:
    """What a virtual experiment shows and what it knows.

    Attributes
    ----------
    maps
        Variables on ``(y, x)``, laboratory coordinates in mm in which the unloaded layer begins at
        0; they reach as far beyond it as the loaded layer does and are NaN where it is not. As OCT
        would see them: ``unloaded_thickness`` and ``loaded_thickness`` (mm; attributes as from
        :func:`~optical_palpation.thickness.read_thickness_map`; with
        :func:`~optical_palpation.thickness.clean_thickness` ready for
        :func:`~optical_palpation.palpation.computational_stress`), ``sample_displacement_x`` and
        ``sample_displacement_y`` (mm, everywhere): the maps are that function's
        ``sample_motion``. True stress of the sample on the layer in kPa: ``axial_stress`` (tension
        positive), ``contact_pressure`` (compression positive), ``traction_x``, ``traction_y``,
        ``traction_z``; ``contact_state`` and ``window_contact_state``; ``algebraic_axial_stress``
        of that loaded thickness. Attributes: ``window_force_mN``, ``sample_force_mN``,
        ``plate_force_mN``, ``force_balance``, the scene as JSON and the convergence record.
    layer, sample
        The deformed bodies, variables as in
        :attr:`~optical_palpation.palpation.StressResult.layer`; the sample's also has
        ``stiffness`` on ``(cell_z, cell_y, cell_x)``, and its z runs from the layer to the plate.
    scene
        The scene that was computed.
    """

    maps: xr.Dataset
    layer: xr.Dataset
    sample: xr.Dataset
    scene: Scene


#: Elements that the finest lengths of a relief, or of a stiffness, need at least.
_FINEST = {"wavelength": 2.0, "correlation_length": 0.5}
#: Across a map.
MAX_PIXELS = 4096


def run_experiment(
    scene: Scene,
    *,
    relief: xr.DataArray | None = None,
    stiffness: xr.DataArray | None = None,
    progress: Callable[[Progress], None] | None = None,
    threads: int | None = None,
) -> ExperimentResult:
    """Press the layer of a scene on its sample.

    Parameters
    ----------
    scene
        From :func:`~optical_palpation.experiment.read_scene`, or built in Python.
    relief
        Height of the sample's surface on ``(y, x)``, mm, added to that of the scene.
    stiffness
        Factor on the sample's stiffness on ``(y, x)`` or ``(z, y, x)``, z the depth below the
        mean surface; multiplied onto that of the scene.
    progress
        Called with a :class:`~optical_palpation.palpation.Progress` now and then.
    threads
        Number of threads; by default one for each core that the process may use.

    Raises
    ------
    InputError
        For a scene that cannot be computed.
    ConvergenceError
        If the full compression is not reached; the message says how far it came.
    """
    if threads is not None and threads < 1:
        raise InputError(f"threads must be at least 1, not {threads!r}")
    _check(scene)
    newton = 0

    def report(level: Stack, load: float, _: object) -> None:
        nonlocal newton
        newton += 1
        if progress:
            progress(Progress(f"{level.n_elements:,} elements", load, newton))

    if progress:
        progress(Progress("preparing", 0.0, 0, "the first run compiles for up to a minute"))
    levels = [build(scene, relief=relief, stiffness=stiffness)]
    while levels[0].n_elements > _COARSEST:
        factor = 2.0 ** len(levels)
        if not _coarser(scene, factor):
            break
        levels.insert(0, build(scene, coarsening=factor, relief=relief, stiffness=stiffness))
    try:
        with limited_threads(threads):
            path = solve(levels, report)
    except LoadNotReached as failure:
        raise ConvergenceError(
            f"the sample was compressed {failure.how_far(f'{scene.compression:g} mm')}: "
            f"{failure.reason}. {_advice(scene)}"
        ) from None
    stack, state = levels[-1], path.state

    x, y = pixels(stack, state, scene.pixel_spacing or 0.2 * scene.mesh.element_size)
    maps = observed_maps(stack, state, x, y)
    loaded = thickness_map(
        maps["loaded_thickness"].values,
        x=x,
        y=y,
        layer_extent=(0.0, scene.layer.size[0], 0.0, scene.layer.size[1]),
        where=scene.title or "virtual experiment",
    )
    maps["loaded_thickness"].attrs |= loaded.attrs
    maps["algebraic_axial_stress"] = algebraic_stress(
        maps["loaded_thickness"], scene.layer.thickness, scene.layer.material
    )
    window, interface, plate = stack.total_forces(state)
    maps.attrs |= {
        "method": "virtual experiment",
        **scene.layer.material.attributes,
        "bulk_to_shear": scene.layer.bulk_to_shear,
        "window_friction": scene.friction.window,
        "sample_friction": scene.friction.sample,
        "initial_thickness_mm": scene.layer.thickness,
        "window_force_mN": window,
        "sample_force_mN": interface,
        "plate_force_mN": plate,
        "force_balance": (max(window, interface, plate) - min(window, interface, plate)) / window,
        "elements": [body.grid.n_elements for body in stack.bodies],
        "newton_iterations": sum(entry[2] for entry in path.record),
        "convergence": json.dumps(
            [
                {"elements": elements, "load": round(load, 4), "newton": count}
                for elements, load, count in path.record
            ]
        ),
        "scene": scene.model_dump_json(),
    }
    return ExperimentResult(
        maps, body_dataset(stack, state, LAYER), body_dataset(stack, state, SAMPLE), scene
    )


def _check(scene: Scene) -> None:
    """Raise for materials that are none, and for compressions beyond anything sensible."""
    layer, sample = scene.layer.material, scene.sample.material
    stack = scene.layer.thickness + scene.sample.thickness
    if scene.compression > 0.5 * stack:
        raise InputError(
            f"compression: {scene.compression:g} mm is more than half of layer and sample "
            f"together, {stack:g} mm"
        )
    if not 1e-4 < layer.shear_modulus / sample.shear_modulus < 1e4:
        raise InputError("sample: stiffer or softer than the layer by more than a factor of 10000")
    element = scene.mesh.element_size
    for part in (*scene.sample.relief, *scene.sample.stiffness):
        for name, elements in _FINEST.items():
            length = getattr(part, name, None)
            if length is not None and length < elements * element:
                raise InputError(
                    f"sample: a {name} of {length:g} mm is too short for elements of {element:g} "
                    f"mm, of which it needs {elements:g}; lengths are in mm"
                )
    spacing, width = scene.pixel_spacing, min(scene.layer.size)
    if spacing is not None and not width / MAX_PIXELS <= spacing <= 0.5 * width:
        raise InputError(
            f"pixel_spacing: {spacing:g} mm must lie between {width / MAX_PIXELS:.3g} and "
            f"{0.5 * width:g} mm for a layer {width:g} mm wide"
        )


def _advice(scene: Scene) -> str:
    """What may help where a scene does not reach its load."""
    friction = scene.friction
    faces = {
        "layer": (friction.window, friction.sample),
        "sample": (friction.sample, friction.plate),
    }
    loose = [body for body, coefficients in faces.items() if not any(coefficients)]
    if loose:
        bodies = " and the ".join(loose)
        return f"Nothing holds the {bodies} sideways: there is no friction on either face"
    return "Try less compression, a flatter relief, smaller elements or less contrast of stiffness"


def _coarser(scene: Scene, factor: float) -> bool:
    """Whether elements ``factor`` times as large can still be used."""
    smallest = min(*scene.layer.size, *scene.sample.size)
    return factor * scene.mesh.element_size <= smallest / 8
