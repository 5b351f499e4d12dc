"""Picture of a uniaxial test and the laws fitted to it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from optical_palpation.material.contact import Contact
from optical_palpation.material.fitting import UniaxialFit
from optical_palpation.material.uniaxial import UniaxialTest
from optical_palpation.present.figure import figure_file
from optical_palpation.present.terms import PALETTE

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_material_figure(
    fits: Sequence[UniaxialFit],
    path: str | Path,
    *,
    recorded: UniaxialTest | None = None,
    contact: Contact | None = None,
) -> None:
    """Draw a test with its fits and their residuals (PNG, PDF or SVG by the name's ending).

    Curves are broken beyond the stretches where a law is stable.

    Parameters
    ----------
    fits
        Fits to one test, at least one.
    path
        The picture.
    recorded
        The test before the contact was corrected, drawn grey with its own origin.
    contact
        Its contact point and the end of its toe.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with figure_file(path, 140.0, 140.0) as figure:
        _draw(figure, fits, recorded, contact)


def _draw(
    figure: Figure,
    fits: Sequence[UniaxialFit],
    recorded: UniaxialTest | None,
    contact: Contact | None,
) -> None:
    test = fits[0].test
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    if recorded is not None:
        top.plot(100 * recorded.strain, recorded.stress, ".", color="0.75", ms=3, label="recorded")
    top.plot(100 * test.strain, test.stress, ".", color="black", ms=3, label="fitted points")
    if contact is not None:
        for at, style, label in (
            (contact.strain, "-", "contact, as recorded"),
            (contact.toe_end, "--", "end of toe, as recorded"),
        ):
            top.axvline(100 * at, color="0.6", lw=0.8, ls=style, label=label)

    low, high = min(test.strain.min(), 0.0), max(test.strain.max(), 0.0)
    strain = np.linspace(low, high, 400)
    for fit, colour in zip(fits, PALETTE, strict=False):
        stress = fit.stress(strain)
        lowest = max(limits[0] for limits in fit.stable_stretches.values())
        highest = min(limits[1] for limits in fit.stable_stretches.values())
        stable = (1 + strain >= lowest) & (1 + strain <= highest)
        label = f"{fit.law}: {_describe(fit)}"
        top.plot(100 * strain, np.where(stable, stress, np.nan), color=colour, label=label)
        if not stable.all():
            top.plot(100 * strain, stress, color=colour, lw=1.0, ls=":")
        bottom.plot(100 * test.strain, test.stress - fit.stress(test.strain), color=colour, lw=1.0)
    top.set(ylabel=f"{test.measure} stress (kPa)")
    figure.suptitle(test.source)
    figure.legend(loc="outside lower center")
    bottom.axhline(0.0, color="0.6", lw=0.8)
    bottom.set(xlabel="engineering strain (%)", ylabel="measured − fit (kPa)")
    for axes in (top, bottom):
        axes.grid()


def _describe(fit: UniaxialFit) -> str:
    values = ", ".join(
        f"{name} {value:.3g} ± {value - fit.intervals[name][0]:.2g}"
        for name, value in fit.parameters.items()
    )
    return f"{values} (rms {fit.rms:.2g} kPa{'' if fit.stable else '; UNSTABLE'})"
