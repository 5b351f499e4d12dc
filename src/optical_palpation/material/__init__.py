"""Hyperelastic laws of the compliant layer and their fits to uniaxial tests."""

from optical_palpation.material.laws import MooneyRivlin, neo_hookean, stable_stretches  # isort: skip
from optical_palpation.material.contact import find_contact
from optical_palpation.material.fitting import UniaxialFit, fit_uniaxial
from optical_palpation.material.uniaxial import UniaxialTest, read_uniaxial_test

__all__ = [
    "MooneyRivlin",
    "UniaxialFit",
    "UniaxialTest",
    "find_contact",
    "fit_uniaxial",
    "neo_hookean",
    "read_uniaxial_test",
    "stable_stretches",
]
