"""The common result of the algebraic and the computational method."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import xarray as xr

from optical_palpation.mechanics.problem import LayerProblem, LayerState


class ContactState(IntEnum):
    """State of a surface point in the ``contact_state`` maps."""

    OPEN = 0
    SLIP = 1
    STICK = 2


@dataclass(frozen=True)
class StressResult:
    """Tactile stress as maps in the frame of the imaging system, and the layer behind them.

    Attributes
    ----------
    maps
        Variables on ``(y, x)``, laboratory coordinates in mm, stress in kPa (tension positive):
        ``axial_stress``, ``contact_pressure`` (compression positive), ``traction_x``,
        ``traction_y``, ``traction_z``, ``contact_state``, ``window_contact_state``,
        ``loaded_thickness`` (mm), ``algebraic_axial_stress``. The attributes hold the total forces
        ``window_force_mN`` and ``sample_force_mN``, all parameters and the convergence record.
        The algebraic method fills only ``axial_stress`` (equal to ``algebraic_axial_stress``),
        ``contact_state`` and ``loaded_thickness``.
    layer
        The deformed layer on its own (reference) grid, or ``None`` for the algebraic method.
        Node variables on ``(z, y, x)``: ``position`` and ``displacement`` (trailing dimension
        ``component`` = x, y, z; mm; z = 0 at the window). Element means on
        ``(cell_z, cell_y, cell_x)``: ``cauchy_stress`` (trailing dimension ``tensor`` =
        xx, yy, zz, yz, xz, xy; kPa). Surface node variables on ``(y, x)``: ``sample_traction``
        and ``window_traction`` (trailing ``component``; kPa per deformed area),
        ``sample_contact_state``, ``window_contact_state``.
    problem
        The boundary-value problem that was solved, for export to other codes; ``None`` for the
        algebraic method and for results read from a file.
    state
        The state of that problem at full load, from which solving a similar one may start; likewise
        ``None``.
    """

    maps: xr.Dataset
    layer: xr.Dataset | None = None
    problem: LayerProblem | None = None
    state: LayerState | None = field(default=None, repr=False)
