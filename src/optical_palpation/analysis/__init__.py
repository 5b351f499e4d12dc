"""What a stress map says: forces, regions, contrast, resolution, comparison and uncertainty."""

from optical_palpation.analysis.comparison import compare_maps, compare_results
from optical_palpation.analysis.features import (
    FeatureContrast,
    PerturbationCorrelation,
    feature_contrast,
    perturbation_correlation,
)
from optical_palpation.analysis.force import ForceBalance, force_balance
from optical_palpation.analysis.layer_uncertainty import stress_uncertainty
from optical_palpation.analysis.profile import line_profile
from optical_palpation.analysis.regions import Region, region_statistics
from optical_palpation.analysis.resolution import EdgeResponse, edge_response
from optical_palpation.analysis.roi_files import read_regions, write_regions
from optical_palpation.analysis.tracing import traced
from optical_palpation.analysis.uncertainty import Noise, propagate_uncertainty

__all__ = [
    "EdgeResponse",
    "FeatureContrast",
    "ForceBalance",
    "Noise",
    "PerturbationCorrelation",
    "Region",
    "compare_maps",
    "compare_results",
    "edge_response",
    "feature_contrast",
    "force_balance",
    "line_profile",
    "perturbation_correlation",
    "propagate_uncertainty",
    "read_regions",
    "region_statistics",
    "stress_uncertainty",
    "traced",
    "write_regions",
]
