"""Virtual experiments: layers and samples made by formulas, and OCT of them."""

from optical_palpation.experiment.scene import Scene, read_scene, scene_names
from optical_palpation.experiment.virtual import ExperimentResult, run_experiment

__all__ = ["ExperimentResult", "Scene", "read_scene", "run_experiment", "scene_names"]
