"""Virtual experiments: a layer pressed on a deformable sample (section 6 of the paper)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import xarray as xr

from optical_palpation.experiment.scene import Scene
from optical_palpation.palpation.computational import Progress


@dataclass(frozen=True)
class ExperimentResult:
    """What a virtual experiment shows and what it knows.

    Attributes
    ----------
    maps
        Variables on ``(y, x)``, laboratory coordinates in mm over the unloaded layer. As OCT would
        see them: ``unloaded_thickness`` and ``loaded_thickness`` (mm; attributes as from
        :func:`~optical_palpation.thickness.read_thickness_map`, ready for
        :func:`~optical_palpation.palpation.computational_stress`). True stress of the sample on
        the layer in kPa: ``axial_stress`` (tension positive), ``contact_pressure`` (compression
        positive), ``traction_x``, ``traction_y``, ``traction_z``; ``contact_state`` and
        ``window_contact_state``; ``algebraic_axial_stress`` of that loaded thickness. Attributes:
        ``window_force_mN``, ``sample_force_mN``, ``plate_force_mN``, ``force_balance``, the scene
        as JSON and the convergence record.
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
        Number of threads; all cores by default.

    Raises
    ------
    InputError
        For a scene that cannot be computed.
    ConvergenceError
        If the full compression is not reached; the message says how far it came.
    """
    raise NotImplementedError
