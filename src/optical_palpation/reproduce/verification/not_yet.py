"""Classics that the solver cannot be put to yet."""

from __future__ import annotations

from typing import Literal

from optical_palpation.reproduce.record import Part, Row, Setting
from optical_palpation.reproduce.verification.closed_forms import dimitriadis, hertz, paraboloid
from optical_palpation.reproduce.verification.layers import error


def not_yet(setting: Setting) -> Part:
    """Name what is missing and why."""
    part = Part(
        "What belongs on this page and is not computed yet. For a paraboloid on a layer the linear "
        "theory is solved from Lebedev and Ufliand's integral equation, which meets Hertz on thick "
        "layers and both limits of thin ones; it shows how far the series of Dimitriadis et al. "
        "(Biophys. J. 82:2798, 2002) holds."
    )
    bases: tuple[Literal["stuck", "sliding"], ...] = ("stuck", "sliding")
    for base in bases:
        for contact in (0.2, 0.5, 1.0):
            delta, force = paraboloid(contact, base)
            part.rows.append(
                Row(
                    "Integral equation, linear theory",
                    f"force of a paraboloid, incompressible layer {base} at the window, a/h "
                    f"{contact:g}, mu h³/R",
                    f"{force:.4g}",
                    "not computed",
                    f"Hertz {error(hertz(delta), force)}, Dimitriadis "
                    f"{error(dimitriadis(delta, base), force)}",
                )
            )
    part.rows += [
        Row(
            "Gent and Lindley 1959",
            "apparent modulus of a bonded square block, S loaded over free area, S >> 1",
            "E (1 + 2.249 S²)",
            "not computed",
            "the same flow as for a disc, where it is 2 S²",
        ),
        Row(
            "Flow between plates",
            "force of a thin layer stuck on both faces over that stuck on one",
            "4",
            "not computed",
            "needs faces that stick where they are not pressed",
        ),
        Row(
            "von Karman's strip",
            "slope of ln p across a slab that slips on both faces",
            "sum of the friction coefficients / thickness",
            "not computed",
            "needs plane strain with free sides",
        ),
        Row(
            "Cattaneo 1938, Mindlin 1949",
            "radius of the stick zone under a tangential load Q, c/a",
            "(1 - Q / (friction P))^(1/3)",
            "not computed",
            "needs a tangential displacement after the normal one; the imprint's motion is "
            "proportional to the load",
        ),
        Row(
            "Code_Aster SSNV128",
            "tangential displacement of a plate on a rigid plane at five points, friction 1, um",
            "28.6, 27.2, 22.8, 19.8, 15.0",
            "not computed",
            "needs pressure on the sides and a compressible law (Poisson's ratio 0.2)",
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
