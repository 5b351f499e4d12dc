"""Hyperelastic laws of the compliant layer and their fits to uniaxial tests."""

from optical_palpation.material.laws import MooneyRivlin, neo_hookean, stable_stretches

__all__ = ["MooneyRivlin", "neo_hookean", "stable_stretches"]
