"""Error bands of stress and stiffness, from the noise of the map and the errors of the inputs.

For an input that is off, the thickness of the model changes, the stiffness answers to that
(``Estimate.gain``), and the stress changes by both. The model's change is that of a solution from
scratch on the coarse mesh: friction depends on the load path, and a derivative at its end is not
that of a path.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import gaussian_filter

from optical_palpation.errors import InputError
from optical_palpation.mechanics.path import LoadNotReached
from optical_palpation.mechanics.stack.assembly import Blocks
from optical_palpation.mechanics.stack.problem import INTERFACE
from optical_palpation.stiffness.forward import Model, carried
from optical_palpation.stiffness.inversion import Estimate
from optical_palpation.stiffness.measurement import ThicknessSurface

Array = NDArray[np.float64]

#: Half the width of a 95 % band in standard deviations.
BAND = 1.96
#: Nodes over which the error of the mesh is averaged.
_NEAR = 2.0


@dataclass(frozen=True)
class InputErrors:
    """Standard errors: coefficients of friction as they are, the rest as shares of the value."""

    compression: float = 0.02
    sample_thickness: float = 0.02
    layer_modulus: float = 0.03
    window_friction: float = 0.05
    sample_friction: float = 0.05
    plate_friction: float = 0.05
    total_force: float = 0.02

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and 0 <= value < 1):
                raise InputError(f"{name}: a standard error must lie in 0 ... 1, not {value!r}")


@dataclass(frozen=True, eq=False)
class Errors:
    """Half the widths of 95 % bands.

    Attributes
    ----------
    positions, stress
        Points (n, 2), y before x, mm, and the band of the axial stress there, kPa.
    stiffness
        Of the logarithm of the stiffness of the columns, (y, x).
    travel
        Of the travel of the plate, mm, where it is sought.
    force
        Of the total force, mN.
    force_of_mesh
        Standard error of the total force by the mesh, mN.
    inputs
        For each input its standard error and how it changes force (mN) and mean stress (kPa);
        None where the change could not be computed.
    """

    positions: Array
    stress: Array
    stiffness: Array
    travel: float | None
    force: float
    force_of_mesh: float
    inputs: dict[str, dict[str, float | None]]

    def stress_at(self, x: Array, y: Array) -> Array:
        """Band of the axial stress at points, kPa."""
        points = np.stack([y, x], axis=-1)
        values = LinearNDInterpolator(self.positions, self.stress)(points)
        nearest = NearestNDInterpolator(self.positions, self.stress)(points)
        return np.where(np.isfinite(values), values, nearest)


def propagated(
    estimate: Estimate,
    coarse: Model,
    measured: ThicknessSurface,
    inputs: InputErrors,
    report: Callable[[str, float], None],
) -> Errors:
    """Propagate noise, mesh and input errors to stress, stiffness and force.

    ``report`` is called with the stage and the share of the load.
    """
    pressed, sensitivity = estimate.pressed, estimate.sensitivity
    stiffness, travel = estimate.stiffness, estimate.travel
    rough = coarse.pressed(stiffness, partial(_at_stage, report, "errors"), travel)
    of_stress, of_force = sensitivity.pressure, sensitivity.force
    on_columns = np.diag(estimate.covariance).copy()
    on_stress = np.einsum("ij,jk,ik->i", of_stress, estimate.covariance, of_stress, optimize=True)
    on_force = float(of_force @ estimate.covariance @ of_force)
    # The coarse mesh is further from the truth than the fine one: in stress, and in thickness, to
    # which the stiffness has answered.
    nominal = rough.misfit(measured)
    thickness = estimate.misfit - carried(nominal, coarse.layer, pressed.layer)
    answer = -estimate.gain @ thickness.ravel() / estimate.refinement
    differs = pressed.pressure - carried(rough.pressure, rough.slaves, pressed.slaves)
    stress = (of_stress @ answer).reshape(rough.pressure.shape)
    differs = differs / estimate.refinement + carried(stress, rough.slaves, pressed.slaves)
    of_mesh = gaussian_filter(differs**2, _NEAR, mode="nearest")
    by_mesh = (pressed.force - rough.force) / estimate.refinement + float(of_force @ answer)
    on_columns += answer**2
    on_force += by_mesh**2

    known: dict[str, dict[str, float | None]] = {}
    of_travel = len(on_columns) > stiffness.size  # it is sought, and the force given instead
    for name, error in vars(inputs).items():
        if error == 0 or name == ("compression" if of_travel else "total_force"):
            continue
        if name == "layer_modulus" and not of_travel:
            # Layer and sample stiffer by the same factor deform alike.
            answer = np.full(on_columns.shape, error)
            stress, force = error * rough.pressure.ravel(), error * rough.force
        elif name in ("total_force", "layer_modulus"):
            # A layer that is stiffer is one on which the force is smaller, in units of its modulus.
            sign = 1.0 if name == "total_force" else -1.0
            answer = sign * error * rough.force * estimate.gain_by_force
            stress, force = of_stress @ answer, float(of_force @ answer)
            if name == "layer_modulus":
                answer[: stiffness.size] += error
                stress, force = stress + error * rough.pressure.ravel(), force + error * rough.force
        else:
            stage = f"error of the {name.replace('_', ' ')}"
            changed = _changed(coarse.blocks, name, error)
            moved = (1 + error) * travel if name == "compression" else travel
            try:
                other = coarse.changed(**changed).pressed(
                    stiffness, partial(_at_stage, report, stage), moved
                )
            except LoadNotReached:
                known[name] = {"standard_error": error, "force_mN": None, "mean_stress_kPa": None}
                continue
            change = carried(other.misfit(measured) - nominal, coarse.layer, pressed.layer)
            answer = -estimate.gain @ change.ravel()
            answer -= estimate.gain_by_force * (other.force - rough.force)
            stress = (other.pressure - rough.pressure).ravel() + of_stress @ answer
            force = other.force - rough.force + float(of_force @ answer)
        on_columns += answer**2
        on_stress += stress**2
        on_force += force**2
        known[name] = {
            "standard_error": error,
            "force_mN": force,
            "mean_stress_kPa": -float(stress.mean()),
        }
    variance = carried(on_stress.reshape(rough.pressure.shape), rough.slaves, pressed.slaves)
    nodes = pressed.stack.contacts[INTERFACE].slaves.ravel()
    return Errors(
        positions=pressed.stack.position(pressed.state.u)[nodes][:, [1, 0]],
        stress=BAND * np.sqrt(variance + of_mesh).ravel(),
        stiffness=BAND * np.sqrt(on_columns[: stiffness.size]).reshape(stiffness.shape),
        travel=BAND * float(np.sqrt(on_columns[-1])) if of_travel else None,
        force=BAND * float(np.sqrt(on_force)),
        force_of_mesh=abs(by_mesh),
        inputs=known,
    )


def _at_stage(
    report: Callable[[str, float], None], stage: str, _: object, load: float, __: object
) -> None:
    report(stage, load)


def _changed(blocks: Blocks, name: str, error: float) -> dict[str, Any]:
    """The input of the blocks that is off by its standard error; the travel is none of these."""
    if name == "compression":
        return {}
    if name == "sample_thickness":
        return {name: (1 + error) * blocks.sample_thickness}
    place = ("window_friction", "sample_friction", "plate_friction").index(name)
    friction = np.array(blocks.friction)
    friction[place] += error
    return {"friction": tuple(friction.tolist())}
