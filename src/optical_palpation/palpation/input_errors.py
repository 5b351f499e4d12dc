"""Errors of the inputs, and what they make of force and stress."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np
import xarray as xr

from optical_palpation.arguments import LARGEST_FRICTION, explained_fields
from optical_palpation.errors import InputError

#: Inputs that there are only with the sample in the model.
OF_SAMPLE = ("plate_friction", "compression", "sample_thickness", "total_force")


@explained_fields
@dataclass(frozen=True)
class InputErrors:
    """Half-widths of the 95 % intervals of the inputs.

    The defaults are those of careful work, not of yours: friction as in the error bars of the
    paper, the stiffness of a layer that was tested beside its batch, thicknesses from OCT with a
    refractive index known to 0.5 %; travel, thickness and force as a stage, a caliper and a load
    cell give them.

    Attributes
    ----------
    window_friction, sample_friction
        Of the coefficients of friction.
    modulus
        Of the layer's stiffness, common to all coefficients of its law, as a fraction of it.
    thickness, initial_thickness
        Common to the whole loaded, and the whole unloaded, thickness, mm.
    plate_friction
        Of the coefficient of friction between sample and plate; this and the next three count only
        with the sample in the model.
    compression
        Of the travel of the plate, as a fraction of it.
    sample_thickness
        Of the unloaded thickness of the sample, as a fraction of it.
    total_force
        Of a total force that is given instead of the travel, as a fraction of it.
    """

    window_friction: float = 0.05
    sample_friction: float = 0.05
    modulus: float = 0.05
    thickness: float = 0.002
    initial_thickness: float = 0.002
    plate_friction: float = 0.05
    compression: float = 0.05
    sample_thickness: float = 0.05
    total_force: float = 0.05

    @classmethod
    def parsed(cls, given: Sequence[str]) -> InputErrors:
        """Return the errors that texts such as ``window_friction=0.03`` say, else the defaults.

        Raises
        ------
        InputError
            If a text names no input, or no number, or two name the same input.
        """
        names = [field.name for field in fields(cls)]
        values: dict[str, float] = {}
        for text in given:
            name, _, number = text.partition("=")
            name = name.strip().replace("-", "_")
            try:
                value = float(number)
            except ValueError:
                value = np.nan
            if name not in names or np.isnan(value):
                raise InputError(
                    f"input error {text!r}: must be NAME=NUMBER, with NAME one of "
                    f"{', '.join(names)}; for example window_friction=0.03"
                )
            if name in values:
                raise InputError(f"input error {text!r}: {name} is given more than once")
            values[name] = value
        return cls(**values)

    @property
    def any_of_layer(self) -> bool:
        """Whether there is any that counts without a sample in the model."""
        given = asdict(self)
        return any(error for name, error in given.items() if name not in OF_SAMPLE)

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not (isinstance(value, int | float) and 0 <= value < np.inf):
                raise InputError(f"error of {name}: a number of at least 0, not {value!r}")
        for name in ("modulus", "compression", "sample_thickness", "total_force"):
            if getattr(self, name) >= 1:
                raise InputError(
                    f"error of {name}: a fraction of it below 1, not {getattr(self, name)!r}; 5 % "
                    "is 0.05"
                )
        for name in ("window_friction", "sample_friction", "plate_friction"):
            if (value := getattr(self, name)) > LARGEST_FRICTION:
                raise InputError(
                    f"error of {name}: no interface has a coefficient above "
                    f"{LARGEST_FRICTION:g}, nor an error of {value!r}"
                )

    def check_thickness(self, thickness: float) -> None:
        """Refuse errors of a thickness that leave nothing of it.

        Parameters
        ----------
        thickness
            Of the layer, mm, or a bound of it.

        Raises
        ------
        InputError
            Naming the error.
        """
        for name in ("thickness", "initial_thickness"):
            if (error := getattr(self, name)) >= 0.5 * thickness:
                raise InputError(
                    f"error of {name}: {error:g} mm is half of the layer, {thickness:.3g} mm, or "
                    "more; it is in mm: divide by 1000 if it is in um"
                )


#: Unless others are given.
INPUT_ERRORS = InputErrors()


def add_error_bands(maps: xr.Dataset, sensitivities: xr.Dataset, errors: InputErrors) -> None:
    """Let the errors that follow from those of the inputs go with the maps (in place).

    Errors of the inputs are independent, and the solution is linear in them: their effects add in
    quadrature. The result is ``axial_stress_error`` (kPa) and the attributes ``force_error_mN``,
    ``force_error_contributions_mN`` and ``input_errors`` (JSON, by input), all half-widths of 95 %
    intervals. Where there are no sensitivities but that to the modulus there are none of these,
    and the attribute ``input_errors_unknown`` says why.
    """
    if failure := sensitivities.attrs["failure"]:
        maps.attrs["input_errors_unknown"] = failure
        return
    given = asdict(errors)
    inputs = [str(name) for name in sensitivities["input"].values]
    each = xr.DataArray([given[name] for name in inputs], {"input": inputs}, ("input",))
    forces = abs(sensitivities["force"] * each)
    squares = (sensitivities["axial_stress"] * each) ** 2
    stress = squares.sum("input", skipna=False) ** 0.5
    words = "error of the axial stress from those of the inputs, 95 %"
    described = {"units": "kPa", "long_name": words}
    maps["axial_stress_error"] = (("y", "x"), stress.transpose("y", "x").values, described)
    maps.attrs["force_error_mN"] = float(np.linalg.norm(forces))
    maps.attrs["force_error_contributions_mN"] = json.dumps(
        {name: float(force) for name, force in zip(inputs, forces.values, strict=True)}
    )
    maps.attrs["input_errors"] = json.dumps({name: given[name] for name in inputs})
