"""The stiffness of what was pressed, and the stress on a sample that is itself soft."""

from optical_palpation.stiffness.sample import Sample, check_sample, check_sample_elements
from optical_palpation.stiffness.stress import sample_stress

__all__ = ["Sample", "check_sample", "check_sample_elements", "sample_stress"]
