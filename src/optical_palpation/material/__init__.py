"""Hyperelastic laws of the compliant layer and their fits to uniaxial tests."""

from optical_palpation.material.contact import find_contact
from optical_palpation.material.fitting import UniaxialFit, fit_uniaxial
from optical_palpation.material.law import InvariantLaw, Law
from optical_palpation.material.laws import LAWS, LawName, make_law, neo_hookean, stable_stretches
from optical_palpation.material.mooney_rivlin import MooneyRivlin
from optical_palpation.material.neo_hookean import NeoHookean
from optical_palpation.material.ogden import Ogden
from optical_palpation.material.uniaxial import UniaxialTest, read_uniaxial_test
from optical_palpation.material.yeoh import Yeoh

__all__ = [
    "LAWS",
    "InvariantLaw",
    "Law",
    "LawName",
    "MooneyRivlin",
    "NeoHookean",
    "Ogden",
    "UniaxialFit",
    "UniaxialTest",
    "Yeoh",
    "find_contact",
    "fit_uniaxial",
    "make_law",
    "neo_hookean",
    "read_uniaxial_test",
    "stable_stretches",
]
