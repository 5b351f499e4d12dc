"""Thickness of the layer: from OCT volumes or files to clean maps."""

from optical_palpation.thickness.cleaning import clean_thickness
from optical_palpation.thickness.frames import thickness_map
from optical_palpation.thickness.initial import match_initial_thickness
from optical_palpation.thickness.maps import read_thickness_map, write_thickness_map

__all__ = [
    "clean_thickness",
    "match_initial_thickness",
    "read_thickness_map",
    "thickness_map",
    "write_thickness_map",
]
