"""Friction at the window from phase-sensitive OCT (section 4 of the paper)."""

from optical_palpation.friction.calibration import (
    calibration_curves,
    read_calibration,
    slab_profile,
    write_calibration,
)
from optical_palpation.friction.estimate import (
    FrictionEstimate,
    doubts_about,
    estimate_friction,
    read_profile,
)
from optical_palpation.friction.phase import axial_strain, displacement_profile
from optical_palpation.friction.volumes import read_pair

__all__ = [
    "FrictionEstimate",
    "axial_strain",
    "calibration_curves",
    "displacement_profile",
    "doubts_about",
    "estimate_friction",
    "read_calibration",
    "read_pair",
    "read_profile",
    "slab_profile",
    "write_calibration",
]
