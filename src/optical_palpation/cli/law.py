"""The options that name the law of the layer, shared by several commands."""

from __future__ import annotations

from enum import StrEnum


class LawChoice(StrEnum):
    """A hyperelastic law."""

    MOONEY_RIVLIN = "mooney-rivlin"
    NEO_HOOKEAN = "neo-hookean"
    YEOH = "yeoh"
    OGDEN = "ogden"


class ComputedLaw(StrEnum):
    """A hyperelastic law that the computational method takes."""

    MOONEY_RIVLIN = "mooney-rivlin"
    NEO_HOOKEAN = "neo-hookean"
    YEOH = "yeoh"


LAW_HELP = "Law of the layer."
C10_HELP = "C10, kPa, of mooney-rivlin, neo-hookean or yeoh."
C01_HELP = "C01, kPa, of mooney-rivlin; 0 if not given."
C20_HELP = "C20, kPa, of yeoh; 0 if not given."
C30_HELP = "C30, kPa, of yeoh; 0 if not given."
MU_HELP = "Initial shear modulus, kPa, of ogden."
ALPHA_HELP = "Exponent of ogden."
