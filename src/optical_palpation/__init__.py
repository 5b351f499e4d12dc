"""Computational optical palpation: maps of tactile stress from the thickness of a soft layer.

``import optical_palpation as op`` gives the names below; each is loaded when it is first used. More
live in the subpackages ``volume``, ``thickness``, ``material``, ``palpation``, ``friction``,
``stiffness``, ``analysis``, ``present``, ``study``, ``batch`` and ``experiment``; errors in
``errors``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from optical_palpation.analysis import Region, compare_results, read_regions, stress_uncertainty
    from optical_palpation.batch import field_stress, sweep
    from optical_palpation.errors import OpticalPalpationError
    from optical_palpation.material import MooneyRivlin
    from optical_palpation.palpation import (
        StressResult,
        algebraic_result,
        computational_stress,
        submodel_stress,
    )
    from optical_palpation.present import read_result
    from optical_palpation.stiffness import Sample, sample_stress
    from optical_palpation.study.python import Study
    from optical_palpation.thickness import (
        clean_thickness,
        find_layer,
        read_thickness_map,
        thickness_map,
    )
    from optical_palpation.volume import open_volume

__all__ = [
    "MooneyRivlin",
    "OpticalPalpationError",
    "Region",
    "Sample",
    "StressResult",
    "Study",
    "__version__",
    "algebraic_result",
    "clean_thickness",
    "compare_results",
    "computational_stress",
    "field_stress",
    "find_layer",
    "open_volume",
    "read_regions",
    "read_result",
    "read_thickness_map",
    "sample_stress",
    "stress_uncertainty",
    "submodel_stress",
    "sweep",
    "thickness_map",
]

__version__: str
_HOMES = {
    "MooneyRivlin": "material",
    "OpticalPalpationError": "errors",
    "Region": "analysis",
    "Sample": "stiffness",
    "StressResult": "palpation",
    "Study": "study.python",
    "algebraic_result": "palpation",
    "clean_thickness": "thickness",
    "compare_results": "analysis",
    "computational_stress": "palpation",
    "field_stress": "batch",
    "find_layer": "thickness",
    "open_volume": "volume",
    "read_regions": "analysis",
    "read_result": "present",
    "read_thickness_map": "thickness",
    "sample_stress": "stiffness",
    "stress_uncertainty": "analysis",
    "submodel_stress": "palpation",
    "sweep": "batch",
    "thickness_map": "thickness",
}
_SUBPACKAGES = {
    "analysis",
    "batch",
    "errors",
    "experiment",
    "friction",
    "material",
    "palpation",
    "present",
    "stiffness",
    "study",
    "thickness",
    "volume",
}


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if name == "__version__":
        from optical_palpation.runtime import software_version

        return software_version()
    if name in _HOMES:
        value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    if name in _SUBPACKAGES:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, *_SUBPACKAGES])
