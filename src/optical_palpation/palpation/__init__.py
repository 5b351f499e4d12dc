"""The two methods of optical palpation, and their common result."""

from optical_palpation.mechanics.similar import Similar
from optical_palpation.palpation.algebraic import algebraic_result, algebraic_stress
from optical_palpation.palpation.computational import computational_stress
from optical_palpation.palpation.input_errors import InputErrors
from optical_palpation.palpation.motion import read_sample_motion, uniform_motion
from optical_palpation.palpation.progress import Progress
from optical_palpation.palpation.result import ContactState, StressResult
from optical_palpation.palpation.submodel import submodel_stress

__all__ = [
    "ContactState",
    "InputErrors",
    "Progress",
    "Similar",
    "StressResult",
    "algebraic_result",
    "algebraic_stress",
    "computational_stress",
    "read_sample_motion",
    "submodel_stress",
    "uniform_motion",
]
