"""Small results as JSON files that say what made them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from optical_palpation.friction.estimate import FrictionEstimate
from optical_palpation.material.fitting import UniaxialFit
from optical_palpation.present.output import atomic
from optical_palpation.runtime import software_version


def write_fits(fits: Sequence[UniaxialFit], path: str | Path, **about: Any) -> None:
    """Write fits to a uniaxial test as JSON; `about` are further entries, such as the contact.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    _write(
        path,
        {
            "test": fits[0].test.source,
            "measure": fits[0].test.measure,
            "points": fits[0].test.stress.size,
            "strain_range": fits[0].strain_range,
            **about,
            "fits": [
                {
                    "law": fit.law,
                    "parameters": fit.parameters,
                    "parameter_units": {
                        name: "1" if name == "alpha" else "kPa" for name in fit.parameters
                    },
                    "intervals_95": fit.intervals,
                    "initial_youngs_modulus_kPa": fit.initial_youngs_modulus,
                    "initial_youngs_modulus_interval_95": fit.initial_youngs_modulus_interval,
                    "rms_kPa": fit.rms,
                    "stable": fit.stable,
                    "stable_stretches": fit.stable_stretches,
                }
                for fit in fits
            ],
        },
    )


def write_friction(estimate: FrictionEstimate, path: str | Path, **about: Any) -> None:
    """Write an estimate of friction as JSON; `about` are further entries, such as the source.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    profile = estimate.profile
    if bool(profile["standard_error"].isnull().all()):  # the measurement came without errors
        profile = profile.drop_vars("standard_error")
    _write(
        path,
        {
            "friction": estimate.coefficient,
            "interval_95": estimate.interval,
            "at_limit_of_calibration": estimate.at_limit,
            "step": estimate.step,
            "offset": estimate.offset,
            "relative_residual": estimate.residual,
            **about,
            "units": {
                "step": estimate.unit or "that of the profile",
                "offset": estimate.unit or "that of the profile",
                "relative_residual": "fraction of the step",
                "profile": {
                    str(k): f"fraction of the {'layer' if k == 'depth' else 'step'}"
                    for k in ("depth", *profile.data_vars)
                },
            },
            "profile": {str(k): profile[k].values.tolist() for k in ("depth", *profile.data_vars)},
        },
    )


def _write(path: str | Path, record: Mapping[str, Any]) -> None:
    about = {"software": "optical-palpation", "software_version": software_version()}
    # NumPy's numbers and arrays say by themselves what they are as plain ones.
    text = json.dumps(about | dict(record), indent=2, allow_nan=False, default=lambda v: v.tolist())
    with atomic(path, "record") as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
