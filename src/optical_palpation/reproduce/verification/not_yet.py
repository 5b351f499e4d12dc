"""Classics that the solver cannot be put to."""

from __future__ import annotations

from optical_palpation.reproduce.record import Part, Row, Setting


def not_yet(setting: Setting) -> Part:
    """Name what is missing and why."""
    part = Part("What belongs on this page and is not computed.")
    part.rows += [
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
