"""Thickness of the layer: from OCT volumes or files to clean maps."""

from optical_palpation.thickness.boundaries import LayerFinder, find_layer, find_surface
from optical_palpation.thickness.cleaning import clean_thickness
from optical_palpation.thickness.corrections import (
    Anchor,
    Corrections,
    Exclusion,
    read_corrections,
    write_corrections,
)
from optical_palpation.thickness.frames import thickness_map
from optical_palpation.thickness.initial import match_initial_thickness
from optical_palpation.thickness.maps import (
    read_height_map,
    read_thickness_map,
    write_thickness_map,
)
from optical_palpation.thickness.registration import lateral_shift, shift_map

__all__ = [
    "Anchor",
    "Corrections",
    "Exclusion",
    "LayerFinder",
    "clean_thickness",
    "find_layer",
    "find_surface",
    "lateral_shift",
    "match_initial_thickness",
    "read_corrections",
    "read_height_map",
    "read_thickness_map",
    "shift_map",
    "thickness_map",
    "write_corrections",
    "write_thickness_map",
]
