"""A whole study as one validated file."""

from optical_palpation.study.inputs import find_boundaries
from optical_palpation.study.reading import read_study, write_template
from optical_palpation.study.record import Progress
from optical_palpation.study.run import StudyResult, describe_inputs, run_study
from optical_palpation.study.schema import Study
from optical_palpation.study.stages import warnings_about

__all__ = [
    "Progress",
    "Study",
    "StudyResult",
    "describe_inputs",
    "find_boundaries",
    "read_study",
    "run_study",
    "warnings_about",
    "write_template",
]
