"""What the maps of a result are called in figures and in the report, and how they are coloured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.palpation.result import ContactState

# Perceptually uniform, and told apart by all kinds of colour vision. Brighter is more compressed,
# as in the published maps: stress is negative there.
STRESS, PRESSURE, LENGTH = "viridis_r", "viridis", "cividis"
ERROR, DIFFERENCE, QUALITY, MODULUS = "magma", "vik", "cividis", "plasma"
# Okabe and Ito's palette, told apart by all kinds of colour vision.
ALGEBRAIC, COMPUTATIONAL = "#D55E00", "#0072B2"
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
STATES = {"open": "#DDDDDD", "slip": "#E69F00", "stick": "#0072B2", "glued": "#009E73"}
#: What the numbers of contact states mean.
STATE_NUMBERS = ", ".join(f"{int(state)} {state.name.lower()}" for state in ContactState)

_LEAST_PERCENT = 0.001
# Maps that hold a fraction of something.
_FRACTIONS = {"edge_influence", "sample_modulus_error"}


@dataclass(frozen=True)
class Term:
    """A quantity in words.

    Attributes
    ----------
    words
        Its name, as in "Axial stress, algebraic".
    units
        Unit, "" for a number.
    colours
        Name of its colour map; "states" for states of contact, "flags" for yes and no.
    scale
        Maps of one scale share their colour limits.
    """

    words: str
    units: str
    colours: str
    scale: str

    @property
    def label(self) -> str:
        """Words and unit."""
        return f"{self.words} ({self.units})" if self.units else self.words

    @property
    def has_limits(self) -> bool:
        """Whether its colours run from a lowest to a highest value."""
        return self.colours not in ("states", "flags")


_TERMS = {
    "axial_stress": Term("Axial stress", "kPa", STRESS, "stress"),
    "algebraic_axial_stress": Term("Axial stress, algebraic", "kPa", STRESS, "stress"),
    "contact_pressure": Term("Contact pressure", "kPa", PRESSURE, "pressure"),
    "traction_x": Term("Traction along x", "kPa", DIFFERENCE, "shear"),
    "traction_y": Term("Traction along y", "kPa", DIFFERENCE, "shear"),
    "traction_z": Term("Traction along z", "kPa", STRESS, "traction_z"),
    "contact_state": Term("Contact with the sample", "", "states", "states"),
    "window_contact_state": Term("Contact with the window", "", "states", "states"),
    "loaded_thickness": Term("Loaded thickness", "mm", LENGTH, "thickness"),
    "initial_thickness": Term("Unloaded thickness", "mm", LENGTH, "thickness"),
    "thickness": Term("Thickness of the layer", "mm", LENGTH, "thickness"),
    "filled": Term("Interpolated pixels", "", "flags", "flags"),
    "quality": Term("Quality of the boundaries", "", QUALITY, "quality"),
    "edge_influence": Term("Influence of the sides", "", ERROR, "edge_influence"),
    "axial_stress_error": Term("Error of the axial stress", "kPa", ERROR, "error"),
    "axial_stress_mesh_error": Term("Error of the mesh", "kPa", ERROR, "error"),
    "sample_youngs_modulus": Term("Young's modulus of the sample", "kPa", MODULUS, "modulus"),
    "sample_shear_modulus": Term("Shear modulus of the sample", "kPa", MODULUS, "shear_modulus"),
    "sample_modulus_error": Term("95 % band of the modulus, ±", "", ERROR, "modulus_error"),
    "sample_relief": Term("Relief of the unloaded sample", "mm", DIFFERENCE, "relief"),
    "sample_relief_error": Term("95 % band of the relief, ±", "mm", ERROR, "relief_error"),
    "sample_displacement_x": Term("Motion of the sample along x", "mm", DIFFERENCE, "motion"),
    "sample_displacement_y": Term("Motion of the sample along y", "mm", DIFFERENCE, "motion"),
    "thickness_misfit": Term("Computed less measured thickness", "mm", DIFFERENCE, "misfit"),
    "difference": Term("Difference", "kPa", DIFFERENCE, "difference"),
}


def term(maps: xr.Dataset, name: str) -> Term:
    """Return what a map is called: by the table here, else by its own attributes."""
    field = maps[name]
    units = str(field.attrs.get("units", ""))
    units = "" if units == "1" else units
    if (known := _TERMS.get(name)) is not None:
        if name == "axial_stress" and "contact_pressure" in maps:
            return replace(known, words="Axial stress, computational")
        if name == "axial_stress_error" and "95 %" in str(field.attrs.get("long_name", "")):
            return replace(known, words="95 % band of the axial stress, ±")
        return replace(known, units=units or known.units)
    words = str(field.attrs.get("long_name", name)).replace("_", " ")
    words = words[:1].upper() + words[1:]
    if "flag_meanings" in field.attrs:
        return Term(words, "", "states", name)
    if field.dtype.kind == "b":
        return Term(words, "", "flags", name)
    values = field.values[np.isfinite(field.values)]
    if "difference" in name or (values.size and values.min() < 0 < values.max()):
        return Term(words, units, DIFFERENCE, name)
    return Term(words, units, ERROR, name)


def in_percent(maps: xr.Dataset) -> xr.Dataset:
    """Return maps as figures show them: fractions in percent, whose unit cannot be mistaken."""
    shown = maps.copy()
    for name in _FRACTIONS & set(maps):
        if maps[name].attrs.get("units", "1") in ("", "1"):
            shown[name] = (100 * maps[name]).assign_attrs(maps[name].attrs | {"units": "%"})
    return shown


def is_map(field: xr.DataArray) -> bool:
    """Whether a variable is a map that can be shown."""
    return set(field.dims) == {"y", "x"} and field.dtype.kind in "fiub" and field.size > 0


def common_limits(
    fields: Mapping[str, xr.DataArray], colours: str, share: float = 1.0
) -> tuple[float, float]:
    """Colour limits that hold for all of these maps.

    Between them lie, of each map, all values but `share` percent at either end, so that the few
    extreme ones at the edges do not hide the rest; about zero for a diverging colour map. Maps
    count alike, however many points they have.
    """
    finite = (v[np.isfinite(v)] for v in (f.values.astype(float) for f in fields.values()))
    ends = [np.percentile(values, [share, 100.0 - share]) for values in finite if values.size]
    if not ends:
        return 0.0, 1.0
    low, high = float(np.min(ends)), float(np.max(ends))
    if colours == DIFFERENCE:
        high = max(abs(low), abs(high)) or 1.0
        return -high, high
    if high - low <= 1e-6 * max(abs(low), abs(high)):
        # one colour for a constant map, and a scale that can be read
        margin = 0.05 * abs(high) or 1.0
        return low - margin, high + margin
    return low, high


def rounded(value: Any, error: Any = None, *, digits: int = 3) -> str:
    """A number to the digits that its error leaves, two of the error; else to some digits.

    So 412.3 with an error of 11.7 is 412 +- 12, and 0.5 with none is 0.500.
    """
    value = float(value)
    if error is None or not (np.isfinite(float(error)) and float(error) > 0):
        return _significant(value, f"#.{digits}g" if value else "g").removesuffix(".")
    error = float(f"{float(error):.1e}")
    place = 1 - int(np.floor(np.log10(error)))
    places = max(0, place)
    value = round(value, place) + 0.0  # what rounds to zero has no sign
    text = f"{value:.{places}f} \N{PLUS-MINUS SIGN} {error:.{places}f}"
    return text.replace("-", "\N{MINUS SIGN}")


def as_given(value: Any, *, digits: int = 3) -> str:
    """A number that somebody gave: 0.05 and not 0.0500."""
    return _significant(float(value), f".{digits}g")


def _significant(value: float, form: str) -> str:
    text = format(value, form)
    if "e" in text and 1e-4 < abs(value) < 1e6:  # no 1.2e+03 mN
        text = f"{float(text):.0f}"
    return text.replace("-", "\N{MINUS SIGN}")


def plain(text: str) -> str:
    """Text with the minus of a terminal, which programs can read."""
    return text.replace("\N{MINUS SIGN}", "-")


def percent(fraction: Any, *, digits: int = 2) -> str:
    """A fraction in percent, such as 2.7 %; where there is next to nothing of it, that."""
    value = 100 * float(fraction)
    if 0 < abs(value) < _LEAST_PERCENT:
        return f"below {_LEAST_PERCENT:g} %"
    if 0 < 100 - value < 10:  # what is left counts: 99.8 % open is not 100 %
        digits = max(digits, 2 - int(np.floor(np.log10(100 - value))))
    return f"{as_given(value, digits=min(digits, 5))} %"
