"""What a stress map says: forces, resolution, contrast, comparison and uncertainty."""

from optical_palpation.analysis.comparison import compare_maps
from optical_palpation.analysis.features import (
    FeatureContrast,
    PerturbationCorrelation,
    feature_contrast,
    perturbation_correlation,
)
from optical_palpation.analysis.force import ForceBalance, force_balance
from optical_palpation.analysis.layer_uncertainty import stress_uncertainty
from optical_palpation.analysis.resolution import EdgeResponse, edge_response
from optical_palpation.analysis.uncertainty import Noise, propagate_uncertainty

__all__ = [
    "EdgeResponse",
    "FeatureContrast",
    "ForceBalance",
    "Noise",
    "PerturbationCorrelation",
    "compare_maps",
    "edge_response",
    "feature_contrast",
    "force_balance",
    "perturbation_correlation",
    "propagate_uncertainty",
    "stress_uncertainty",
]
