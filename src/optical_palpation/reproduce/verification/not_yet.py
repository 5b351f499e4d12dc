"""Classics and references that the solver has not been put to."""

from __future__ import annotations

from optical_palpation.reproduce.record import Part, Row, Setting


def not_yet(setting: Setting) -> Part:
    """Name what is missing and why."""
    part = Part("What belongs on this page and is not computed.")
    part.rows += [
        Row(
            "NGSolve",
            "force and contact pressure under a step like the rim of a coin, and under ridges on a "
            "layer glued to the window, plane strain",
            "the cases `step` and `cast` of `benchmarks/references.py`",
            "not computed",
            "their references have not been run on meshes that are fine enough",
        ),
        Row(
            "NGSolve",
            "force of the sinusoid and of the slab in three dimensions, sides resolved",
            "163.0 and 1068 mN, sides not resolved",
            "not computed",
            "the references on the page of the numerics have outermost elements of 0.25 to 0.3 mm; "
            "slab and ridges in plane strain are above",
        ),
        Row(
            "Code_Aster SSNV128",
            "tangential displacement of a plate on a rigid plane at five points, friction 1, um",
            "28.6, 27.2, 22.8, 19.8, 15.0",
            "not computed",
            "needs pressure on one side and Poisson's ratio 0.2: a layer is loaded by window and "
            "imprint alone, and laws have K / mu of at least 10, it has 1.33",
        ),
        Row(
            "Taylor and Papadopoulos 1991",
            "contact patch test over a non-matching interface of two bodies",
            "uniform stress",
            "not computed",
            "virtual experiments mesh layer and sample at the same lateral element size",
        ),
    ]
    return part
