"""Virtual experiments: layers and samples made by formulas, and OCT of them."""

from optical_palpation.experiment.sample_data import SAMPLES, make_sample, sample_truth
from optical_palpation.experiment.scene import Scene, read_scene, scene_names
from optical_palpation.experiment.virtual import ExperimentResult, run_experiment

__all__ = [
    "SAMPLES",
    "ExperimentResult",
    "Scene",
    "make_sample",
    "read_scene",
    "run_experiment",
    "sample_truth",
    "scene_names",
]
