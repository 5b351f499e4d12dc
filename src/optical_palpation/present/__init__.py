"""Results out: NetCDF, picture, HTML report, ParaView file, profiles and a summary in words."""

from optical_palpation.present.boundaries_figure import write_boundaries_figure
from optical_palpation.present.deck import write_deck
from optical_palpation.present.figure import write_maps
from optical_palpation.present.matlab import write_mat
from optical_palpation.present.netcdf import read_result, write_result
from optical_palpation.present.output import check_outputs
from optical_palpation.present.panel import write_panel
from optical_palpation.present.profiles import centre_profiles, write_profiles
from optical_palpation.present.report import write_report
from optical_palpation.present.summary import of_sides, of_solution, summarise
from optical_palpation.present.terms import percent
from optical_palpation.present.tiff import write_tiff
from optical_palpation.present.vtk import write_vtk
from optical_palpation.present.writing import write

__all__ = [
    "centre_profiles",
    "check_outputs",
    "of_sides",
    "of_solution",
    "percent",
    "read_result",
    "summarise",
    "write",
    "write_boundaries_figure",
    "write_deck",
    "write_maps",
    "write_mat",
    "write_panel",
    "write_profiles",
    "write_report",
    "write_result",
    "write_tiff",
    "write_vtk",
]
