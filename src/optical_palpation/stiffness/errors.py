"""Error bands of stress and stiffness, from the noise of the map and the errors of the inputs.

For an input that is off, the thickness of the model changes, the stiffness answers to that
(``Estimate.gain``), and the stress changes by both. The model's change is that of a solution from
scratch on the coarse mesh: friction depends on the load path, and a derivative at its end is not
that of a path.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import gaussian_filter

from optical_palpation.mechanics.path import LoadNotReached
from optical_palpation.mechanics.stack.assembly import Blocks
from optical_palpation.mechanics.stack.problem import INTERFACE
from optical_palpation.palpation.input_errors import InputErrors
from optical_palpation.stiffness.forward import Model, Pressed, carried
from optical_palpation.stiffness.inversion import Estimate, Order
from optical_palpation.stiffness.measurement import ThicknessSurface

Array = NDArray[np.float64]

#: Half the width of a 95 % band in standard deviations.
_BAND = 1.96
#: Nodes over which the error of the mesh is averaged.
_NEAR = 2.0


@dataclass(frozen=True, eq=False)
class Band:
    """Half-widths of 95 % bands at one load.

    ``positions`` are points (n, 2), y before x, mm, and ``stress`` the band of the axial stress
    there, kPa; ``force`` that of the total force, mN, ``force_of_mesh`` its standard error by the
    mesh, mN; ``travel`` of the travel of the plate where that is sought, mm.
    """

    positions: Array
    stress: Array
    force: float
    force_of_mesh: float
    travel: float | None

    def stress_at(self, x: Array, y: Array) -> Array:
        """Band of the axial stress at points, kPa."""
        points = np.stack([y, x], axis=-1)
        values = LinearNDInterpolator(self.positions, self.stress)(points)
        nearest = NearestNDInterpolator(self.positions, self.stress)(points)
        return np.where(np.isfinite(values), values, nearest)


@dataclass(frozen=True, eq=False)
class Errors:
    """Half the widths of 95 % bands.

    Attributes
    ----------
    loads
        Of stress and force at each load.
    stiffness
        Of the logarithm of the stiffness of the columns, (y, x).
    relief
        Of the heights at the corners of the columns above their mean, (y, x), mm, where they are
        sought.
    inputs
        For each input the half-width of its 95 % interval, and how an error of that size changes
        force (mN) and mean stress (kPa) at the last load; None where the change could not be
        computed.
    """

    loads: list[Band]
    stiffness: Array
    relief: Array | None
    inputs: dict[str, dict[str, float | None]]


@dataclass(frozen=True, eq=False)
class _Effect:
    """What an error does: to all that is sought, and at each load to pressure, kPa, and force."""

    sought: Array
    pressure: Array
    force: Array


class _Propagation:
    """What changes of the model, of the map or of the forces do to what follows from them."""

    def __init__(self, estimate: Estimate, coarse: Model, rough: list[Pressed]) -> None:
        self.estimate, self.coarse, self.rough = estimate, coarse, rough
        self.of_pressure = np.stack([s.pressure for s in estimate.sensitivities])
        self.of_force = np.stack([s.force for s in estimate.sensitivities])
        self.pressure = np.stack([p.pressure.ravel() for p in rough])
        self.force = np.array([p.force for p in rough])

    def effect(
        self, answer: Array, pressure: Array | float = 0.0, force: Array | float = 0.0
    ) -> _Effect:
        """Effect of an answer of what is sought, beside that of the model."""
        return _Effect(answer, pressure + self.of_pressure @ answer, force + self.of_force @ answer)

    def of_model(self, other: list[Pressed], measured: Sequence[ThicknessSurface]) -> _Effect:
        """Effect of a change of the model that made the coarse solutions these ``other`` ones."""
        fine = self.estimate.pressed[-1].layer
        change = [
            carried(new.misfit(m) - old.misfit(m), self.coarse.layer, fine).ravel()
            for new, old, m in zip(other, self.rough, measured, strict=True)
        ]
        force = np.array([p.force for p in other]) - self.force
        answer = -self.estimate.gain @ np.concatenate(change)
        if self.estimate.order.travels:
            answer -= self.estimate.gain_by_force @ force
        pressure = np.stack([p.pressure.ravel() for p in other]) - self.pressure
        return self.effect(answer, pressure, force)

    def of_modulus(self, error: float) -> _Effect:
        """Effect of a layer that is stiffer by a fraction."""
        # Layer and sample stiffer by the same factor deform alike.
        answer = np.zeros(self.estimate.order.size)
        answer[self.estimate.order.of_stiffness] = error
        if not self.estimate.order.travels:
            return _Effect(answer, error * self.pressure, error * self.force)
        # A layer that is stiffer is one on which the force is smaller, in units of its modulus.
        effect = self.of_total_force(-error)
        return _Effect(
            answer + effect.sought,
            error * self.pressure + effect.pressure,
            error * self.force + effect.force,
        )

    def of_total_force(self, error: float) -> _Effect:
        """Effect of total forces that are larger by a fraction."""
        return self.effect(self.estimate.gain_by_force @ (error * self.force))

    def of_thickness(self, error: float) -> _Effect:
        """Effect of a loaded thickness that is measured too large everywhere."""
        # The misfit is the computed thickness less the measured one.
        return self.effect(error * self.estimate.gain.sum(1))


def propagated(
    estimate: Estimate,
    coarse: Model,
    measured: Sequence[ThicknessSurface],
    inputs: InputErrors | None,
    report: Callable[[str, float], None],
) -> Errors:
    """Propagate noise, mesh and input errors to stress, stiffness and force.

    ``report`` is called with the stage and the share of the load.
    """
    sought, order = estimate.sought, estimate.order
    rough = coarse.pressed(sought, partial(_at_stage, report, "errors"))
    propagation = _Propagation(estimate, coarse, rough)
    # squares of half-widths
    covariance = _BAND**2 * estimate.covariance
    on_sought = np.diag(_centred(_centred(covariance, order).T, order)).copy()
    on_pressure = np.stack([np.sum((s @ covariance) * s, axis=1) for s in propagation.of_pressure])
    on_force = np.stack([s @ covariance @ s for s in propagation.of_force])
    # The search stops within the tolerance of the misfit, not at its least.
    unfinished = propagation.effect(estimate.unfinished)
    on_sought += _centred(unfinished.sought, order) ** 2
    on_pressure += unfinished.pressure**2
    on_force += unfinished.force**2
    effects, of_mesh = _of_mesh(propagation, measured)
    on_sought += (_BAND * _without_sign([_centred(each.sought, order) for each in effects])) ** 2
    force_of_mesh = _without_sign([each.force for each in effects])
    on_force += (_BAND * force_of_mesh) ** 2

    known: dict[str, dict[str, float | None]] = {}
    areas = rough[-1].stack.areas[INTERFACE]
    of_other = "compression" if order.travels else "total_force"
    for name, error in ({} if inputs is None else asdict(inputs)).items():
        if error == 0 or name == of_other:
            continue
        if name in ("modulus", "total_force", "thickness"):
            of_input = getattr(propagation, f"of_{name}")(error)
        else:
            stage = partial(_at_stage, report, f"error of the {name.replace('_', ' ')}")
            changed = _changed(coarse.blocks, name, error)
            moved = sought
            if name == "compression":
                travels = tuple((1 + error) * travel for travel in sought.travels)
                moved = replace(sought, travels=travels)
            try:
                other = coarse.changed(**changed).pressed(moved, stage)
            except LoadNotReached:
                known[name] = {"half_width": error, "force_mN": None, "mean_stress_kPa": None}
                continue
            of_input = propagation.of_model(other, measured)
        on_sought += _centred(of_input.sought, order) ** 2
        on_pressure += of_input.pressure**2
        on_force += of_input.force**2
        known[name] = {
            "half_width": error,
            "force_mN": float(of_input.force[-1]),
            "mean_stress_kPa": -float(np.average(of_input.pressure[-1], weights=areas)),
        }
    relief = on_sought[order.of_relief].reshape(order.columns.corners) if order.relief else None
    of_travels = np.sqrt(on_sought[order.of_travels])
    loads = []
    for n, (pressed, own) in enumerate(zip(estimate.pressed, rough, strict=True)):
        variance = carried(on_pressure[n].reshape(own.pressure.shape), own.slaves, pressed.slaves)
        nodes = pressed.stack.contacts[INTERFACE].slaves.ravel()
        loads.append(
            Band(
                positions=pressed.stack.position(pressed.state.u)[nodes][:, [1, 0]],
                stress=np.sqrt(variance + of_mesh[n]).ravel(),
                force=float(np.sqrt(on_force[n])),
                force_of_mesh=float(force_of_mesh[n]),
                travel=float(of_travels[n]) if order.travels else None,
            )
        )
    return Errors(
        loads=loads,
        stiffness=np.sqrt(on_sought[order.of_stiffness]).reshape(order.columns.shape),
        relief=None if relief is None else np.sqrt(relief),
        inputs=known,
    )


def _centred(sought: Array, order: Order) -> Array:
    """Heights above their mean in place of heights; along the first axis."""
    out = sought.copy()
    if order.relief:
        out[order.of_relief] -= out[order.of_relief].mean(0)
    return out


def _without_sign(parts: Sequence[Array]) -> Array:
    """Sum of parts of an error whose signs are unknown: they must not cancel."""
    return np.sum(np.abs(parts), axis=0)


def _of_mesh(
    propagation: _Propagation, measured: Sequence[ThicknessSurface]
) -> tuple[list[_Effect], list[Array]]:
    """Effects of the error of the fine mesh, and squares of half-widths of the stress by it.

    The coarse mesh is further from the truth than the fine one: in stress, and in thickness, to
    which the stiffness has answered. Half of the latter is taken off; this goes by the whole. As
    what is left may have either sign, there is one effect of each.
    """
    estimate, rough = propagation.estimate, propagation.rough
    thickness, pressure, force = [], [], []
    for pressed, own, m in zip(estimate.pressed, rough, measured, strict=True):
        thickness.append(pressed.misfit(m) - carried(own.misfit(m), own.layer, pressed.layer))
        pressure.append(pressed.pressure - carried(own.pressure, own.slaves, pressed.slaves))
        force.append((pressed.force - own.force) / estimate.refinement)
    of_thickness = propagation.effect(-estimate.gain @ np.ravel(thickness) / estimate.refinement)
    answer = np.zeros(estimate.order.size)
    if estimate.order.travels:
        answer -= estimate.gain_by_force @ force
    of_stress = propagation.effect(answer, 0.0, np.array(force))
    squares = []
    for n, (pressed, own, change) in enumerate(zip(estimate.pressed, rough, pressure, strict=True)):
        by_thickness, by_travel = (
            carried(effect.pressure[n].reshape(own.pressure.shape), own.slaves, pressed.slaves)
            for effect in (of_thickness, of_stress)
        )
        whole = _without_sign([change / estimate.refinement + by_travel, by_thickness])
        squares.append(_BAND**2 * gaussian_filter(whole**2, _NEAR, mode="nearest"))
    return [of_thickness, of_stress], squares


def _at_stage(
    report: Callable[[str, float], None], stage: str, _: object, load: float, __: object
) -> None:
    report(stage, load)


def _changed(blocks: Blocks, name: str, error: float) -> dict[str, Any]:
    """The input of the blocks that is off by its error; the travel is none of these."""
    if name == "compression":
        return {}
    if name == "initial_thickness":
        return {"thickness": lambda x, y: blocks.thickness(x, y) + error}
    if name == "sample_thickness":
        return {name: (1 + error) * blocks.sample_thickness}
    place = ("window_friction", "sample_friction", "plate_friction").index(name)
    friction = np.array(blocks.friction)
    friction[place] += error
    return {"friction": tuple(friction.tolist())}
