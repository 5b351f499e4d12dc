"""Uniaxial tests of the layer's material: reading, sign, unit and measure conventions."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from optical_palpation.arguments import choice, explained_fields, file_path, number
from optical_palpation.errors import InputError
from optical_palpation.volume.text import Columns, read_columns

Measure = Literal["engineering", "true"]
Loading = Literal["compression", "tension"]

_STRAIN_UNITS = {"fraction": 1.0, "percent": 0.01, "pct": 0.01, "%": 0.01}
_STRAIN_UNITS |= dict.fromkeys(("-", "1", "mm/mm", "m/m", "in/in"), 1.0)
_STRESS_UNITS = {"pa": 1e-3, "kpa": 1.0, "mpa": 1e3, "gpa": 1e6, "n/m2": 1e-3, "n/mm2": 1e3}
_LENGTH_UNITS = {"nm": 1e-6, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1e3}
_FORCE_UNITS = {"un": 1e-3, "µn": 1e-3, "μn": 1e-3, "mn": 1.0, "n": 1e3, "kn": 1e6}
# Units that would otherwise be overlooked, and two whose case decides about nine powers of ten.
_OTHER_UNITS = {"psi", "ksi", "bar", "mbar", "torr", "atm", "mmhg", "mm2", "m2", "kgf", "gf", "lbf"}
_OTHER_UNITS |= {
    "lb",
    "lbs",
    "g",
    "kg",
    "inch",
    "inches",
    "in",
    "ft",
    "mil",
    "microstrain",
    "ustrain",
}
_OTHER_CASES = {"MN", "mPa"}
# What else may stand in brackets after a name.
_ENGINEERING = {"engineering", "nominal"}
_TRUE = {"true", "cauchy", "logarithmic", "log", "hencky", "natural"}
_REMARKS = {*_ENGINEERING, *_TRUE, "compression", "tension", "compressive"}
_REMARKS |= {"tensile", "axial", "abs", "mean", "average", "corrected"}
# Above these a column without a unit is in another one than is assumed.
_LARGEST_STRAIN = 3.0
# kPa, secant moduli of layers; and of the hardest rubbers.
_SOFTEST, _STIFFEST, _HARDEST = 0.1, 5e3, 2e4
# A test that reaches less tells no law: its strain is a fraction, called a percentage.
_SMALLEST_STRAIN = 0.01


@explained_fields
@dataclass(frozen=True)
class UniaxialTest:
    """One uniaxial test, sorted as recorded, signs as everywhere: tension positive.

    Attributes
    ----------
    stretch
        Loaded over unloaded height, ``(n,)``, below 1 in compression.
    stress
        Stress in kPa, ``(n,)``, negative in compression: force per undeformed area if `measure`
        is ``"engineering"``, per deformed area (incompressible) if ``"true"``.
    measure
        The measure of `stress`. Fits are made in it: least squares in the other measure weighs the
        points differently and gives other coefficients.
    source
        Where the data came from, for figures and messages.
    """

    stretch: NDArray[np.float64]
    stress: NDArray[np.float64]
    measure: Measure = "engineering"
    source: str = ""

    def __post_init__(self) -> None:
        if self.measure not in ("engineering", "true"):
            raise InputError(f"measure = {self.measure!r}: choose 'engineering' or 'true'")
        stretch = np.asarray(self.stretch, dtype=np.float64)
        stress = np.asarray(self.stress, dtype=np.float64)
        if stretch.ndim != 1 or stretch.shape != stress.shape or stretch.size < 5:
            raise InputError(
                f"uniaxial test {self.source}: stretch {stretch.shape} and stress {stress.shape} "
                "must be two columns of equal length, at least 5 points"
            )
        if not (np.isfinite(stretch).all() and np.isfinite(stress).all()):
            raise InputError(f"uniaxial test {self.source}: stretch and stress must be finite")
        if stretch.min() <= 0.0:
            raise InputError(
                f"uniaxial test {self.source}: strain reaches {stretch.min() - 1.0:g}, but -1 "
                "leaves no height at all; is the strain in percent, or its sign reversed?"
            )
        object.__setattr__(self, "stretch", stretch)
        object.__setattr__(self, "stress", stress)

    @property
    def strain(self) -> NDArray[np.float64]:
        """Engineering strain, negative in compression."""
        return self.stretch - 1.0

    @property
    def loading(self) -> Loading:
        """Direction of the test."""
        extreme = self.strain[np.argmax(np.abs(self.strain))]
        return "compression" if extreme < 0.0 else "tension"

    def between(self, lowest: float, highest: float = np.inf) -> UniaxialTest:
        """Return the points whose strain lies between two magnitudes (engineering, inclusive).

        Raises
        ------
        InputError
            If fewer than 5 points are left.
        """
        magnitude = self.strain * (-1.0 if self.loading == "compression" else 1.0)
        keep = (magnitude >= lowest) & (magnitude <= highest)
        if keep.sum() < 5:
            raise InputError(
                f"uniaxial test {self.source}: {keep.sum()} points have a strain between "
                f"{lowest:g} and {highest:g}, at least 5 are needed; the test spans "
                f"{magnitude.min():g} to {magnitude.max():g}"
            )
        return replace(self, stretch=self.stretch[keep], stress=self.stress[keep])

    def from_contact(self, strain: float, toe_end: float | None = None) -> UniaxialTest:
        """Return the test counted from another point of contact, without what lies before it.

        The specimen's height is the one at contact, so that moving the contact changes the height
        as well as the origin: ``stretch / stretch_at_contact``. True stress was computed with the
        wrong stretch and is corrected with it; engineering stress refers to the undeformed area
        and stays.

        Parameters
        ----------
        strain
            Engineering strain at contact in the present counting, negative in compression.
        toe_end
            Strain in the present counting up to which points are dropped; `strain` by default.

        Raises
        ------
        InputError
            If a strain is impossible or fewer than 5 points are left.
        """
        end = strain if toe_end is None else toe_end
        if not (-1.0 < strain < np.inf and -1.0 < end < np.inf):
            raise InputError(f"strains at contact {strain:g} and toe end {end:g} must be above -1")
        factor = 1.0 + strain
        keep = self.strain <= end if self.loading == "compression" else self.strain >= end
        if keep.sum() < 5:
            raise InputError(
                f"uniaxial test {self.source}: {keep.sum()} points lie beyond a strain of {end:g}, "
                "at least 5 are needed; give the strains at contact and at the end of the toe"
            )
        stress = self.stress / factor if self.measure == "true" else self.stress
        return replace(self, stretch=self.stretch[keep] / factor, stress=stress[keep])


def read_uniaxial_test(
    path: str | Path,
    *,
    strain: str | None = None,
    stress: str | None = None,
    measure: Measure | None = None,
    loading: Loading | None = None,
    height: float | None = None,
    area: float | None = None,
) -> UniaxialTest:
    """Read a uniaxial test from a table with a header (CSV; comma, semicolon, tab or spaces).

    Columns are found by name: *strain* and *stress*, or else *displacement* (compression,
    extension) with `height` and *force* (load) with `area`. Names carry measure (*engineering* or
    *nominal*, *true*, *cauchy* or *logarithmic*; engineering where neither says it) and unit
    (percent; Pa, kPa, MPa, GPa, N/mm2; nm to m; uN to kN) in the header or a second line below it;
    another unit is refused. Without one they are the fraction, kPa, mm and N, as far as that is
    plausible. Either sign convention is taken: strain and stress of opposite signs mean
    compression, and so do two negative ones; two positive ones are decided by *compression* or
    *tension* in a name, or by `loading`. Rows after the largest strain (unloading) are dropped.

    Parameters
    ----------
    path
        The file.
    strain, stress
        Names of the columns, if the automatic choice is wrong. They may also name the
        displacement and the force.
    measure
        Measure of both columns where the table holds several or its names say nothing.
    loading
        Direction of the test where signs and names leave it open.
    height, area
        Unloaded height in mm and area in mm2, for tables of displacement and force.

    Raises
    ------
    InputError
        The file cannot be read, columns are missing or ambiguous, or numbers are impossible.
    """
    path = file_path(path)
    if loading is not None:
        choice(loading, "loading", "compression", "tension")
    height, area = (
        None if value is None else number(value, name)
        for name, value in (("height", height), ("area", area))
    )
    table = read_columns(path)
    strain_name = strain or _find(
        table, path, measure, "strain", "displacement compression extension"
    )
    stress_name = stress or _find(table, path, measure, "stress", "force load")
    x, y = (table.numbers(name) for name in (strain_name, stress_name))
    if x.size < 5:
        raise InputError(f"{path}: {x.size} rows, at least 5 are needed")

    strain_measure, stress_measure = _measure_of(strain_name), _measure_of(stress_name)
    if "stress" not in _words(stress_name):  # a force counts per unloaded area
        stress_measure = "engineering"
    found = measure or stress_measure or strain_measure or "engineering"
    if strain_measure is not None and strain_measure != found:
        raise InputError(
            f"{path}: strain column {strain_name!r} and stress column {stress_name!r} are of "
            "different measures; name two columns of the same one"
        )
    is_strain = "strain" in _words(strain_name)
    if measure is None and found == "true" and is_strain and strain_measure != stress_measure:
        silent = strain_name if strain_measure is None else stress_name
        raise InputError(
            f"{path}: one of the columns {strain_name!r} and {stress_name!r} is true, and of "
            f"{silent!r} nothing is said. If it is true as well, say so (measure = 'true'); if "
            "not, give both as engineering ones"
        )
    stress_unit: str | None = ""
    if is_strain:
        strain_unit = _unit(strain_name, _STRAIN_UNITS, path)
        if strain_unit is None and np.abs(x).max() > _LARGEST_STRAIN:
            raise InputError(
                f"{path}: column {strain_name!r} reaches {np.abs(x).max():g} and names no unit; is "
                "it in percent? Say so in its name"
            )
        x = x * _STRAIN_UNITS[strain_unit or "fraction"]
    else:
        where = f"{path}: column {strain_name!r} is a displacement"
        height = _of_specimen(height, "height in mm", where)
        x = x * _LENGTH_UNITS[_unit(strain_name, _LENGTH_UNITS, path) or "mm"] / height
    if "stress" in _words(stress_name):
        stress_unit = _unit(stress_name, _STRESS_UNITS, path)
        y = y * _STRESS_UNITS[stress_unit or "kpa"]
    else:
        area = _of_specimen(area, "area in mm2", f"{path}: column {stress_name!r} is a force")
        stress_unit = _unit(stress_name, _FORCE_UNITS, path)
        y = y * _FORCE_UNITS[stress_unit or "n"] / area
        found = "engineering"

    if 0.0 < (largest := np.abs(x).max()) < _SMALLEST_STRAIN:
        raise InputError(
            f"{path}: column {strain_name!r} reaches a strain of {largest:.3g} only; is its unit "
            "(or the height) another one?"
        )
    if largest > 0.0:
        _check_modulus(float(np.abs(y).max() / largest), stress_name, stress_unit, path)
    end = int(np.argmax(np.abs(x)))
    if end < 4:
        raise InputError(
            f"{path}: the strain is largest in data row {end + 1}; what follows is unloading "
            "and is dropped. Sort the rows as they were measured, from no load on"
        )
    x, y = x[: end + 1], y[: end + 1]
    sign = _direction(x, y, f"{strain_name} {stress_name}", loading, path)
    x = sign * np.sign(x[-1]) * x
    y = sign * np.sign(y[-1]) * y
    true_strain = found == "true" and is_strain
    return UniaxialTest(np.exp(x) if true_strain else 1.0 + x, y, found, path.name)


def _of_specimen(given: float | None, what: str, where: str) -> float:
    """Return a size of the specimen that a column needs, or refuse that it is missing."""
    if given is None or not given > 0.0:
        wrong = "" if given is None else f", a positive number and not {given:g}"
        raise InputError(f"{where}; give the specimen's unloaded {what}{wrong}")
    return given


def _check_modulus(modulus: float, name: str, unit: str | None, path: Path) -> None:
    """Refuse a secant modulus (kPa) of no layer."""
    low, high = _SOFTEST, _STIFFEST if unit is None else _HARDEST
    if low <= modulus <= high:
        return
    assumed = "kPa" if "stress" in _words(name) else "N"
    raise InputError(
        f"{path}: column {name!r} "
        + (f"names no unit; taken as {assumed} it" if unit is None else f"in {unit}")
        + f" gives a modulus of {modulus:.3g} kPa. "
        + ("Say its unit in its name" if unit is None else "Check its unit, and height and area")
    )


def _words(name: str) -> set[str]:
    return set(re.split(r"[^a-zµ%]+", name.lower()))


def _measure_of(name: str) -> Measure | None:
    words = _words(name)
    if words & _TRUE:
        return "true"
    return "engineering" if words & _ENGINEERING else None


def _find(table: Columns, path: Path, measure: Measure | None, first: str, otherwise: str) -> str:
    names = table.names
    usable = [name for name in names if not _words(name) & {"sd", "std", "error", "sem"}]
    for wanted in (first, otherwise):
        found = [name for name in usable if _words(name) & set(wanted.split())]
        of_measure = [
            name for name in found if _measure_of(name) in (measure or "engineering", None)
        ]
        if found and not of_measure:
            if measure is not None:
                raise InputError(
                    f"{path}: measure = {measure!r}, but the columns are: {', '.join(found)}"
                )
            of_measure = found
        if len(of_measure) == 1:
            return of_measure[0]
        if len(of_measure) > 1:
            raise InputError(
                f"{path}: several columns could be the {first}: {', '.join(of_measure)}; name one"
            )
    raise InputError(
        f"{path}: no column for the {first} (or {otherwise.replace(' ', ' or ')}"
        f"{f', {measure} measure' if measure else ''}); the table has: {', '.join(names)}"
    )


def _unit(name: str, units: dict[str, float], path: Path) -> str | None:
    """Unit that a column's name states, a key of `units`, or None.

    Raises
    ------
    InputError
        For a unit that is not known here, or several.
    """
    where = f"{path}: column {name!r}"
    tidy = name.replace("²", "2").replace("^2", "2")
    brackets = [text.strip() for text in re.findall(r"[(\[]([^)\]]*)[)\]]", tidy)]
    words = [word for word in re.split(r"[\s_()\[\],;]+", tidy) if word]
    words += ["%"] if "%" in tidy else []
    known = {word.lower() for word in [*brackets, *words] if word.lower() in units}
    other = [word for word in words if word in _OTHER_CASES or word.lower() in _OTHER_UNITS]
    other += [
        text
        for text in brackets
        if text and text.lower() not in units and not set(text.lower().split()) <= _REMARKS
    ]
    if (other and not known) or set(words) & _OTHER_CASES:
        raise InputError(
            f"{where} is in {other[0]!r}; known units are "
            f"{', '.join(unit for unit in units if unit.isascii())}. Convert it"
        )
    if len({units[unit] for unit in known}) > 1:
        raise InputError(f"{where} names several units: {', '.join(sorted(known))}")
    return next(iter(known), None)


def _direction(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    names: str,
    loading: Loading | None,
    path: Path,
) -> float:
    if loading is None:
        if x[-1] < 0.0 or y[-1] < 0.0:
            loading = "compression"
        else:
            words = _words(names)
            compressed = bool(words & {"compression", "compressive"})
            pulled = bool(words & {"tension", "tensile"})
            if compressed == pulled:
                raise InputError(
                    f"{path}: strain and stress are both positive, which may be a tension test or "
                    "a compression test counted positive; say which (loading = 'compression' or "
                    "'tension')"
                )
            loading = "tension" if pulled else "compression"
    return -1.0 if loading == "compression" else 1.0
