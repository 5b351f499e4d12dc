"""``optical-palpation sample``: a small measurement with a known answer."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from optical_palpation.cli.options import Quiet


class SampleName(StrEnum):
    """A sample."""

    PLATE = "plate"
    RELIEF = "relief"
    NODULE = "nodule"


def sample(
    name: Annotated[
        SampleName,
        typer.Argument(
            metavar="NAME",
            help="plate: flat and without friction, known in closed form. relief: a stiff sample, "
            "as a coin. nodule: soft tissue with a stiff nodule.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FOLDER", help="Folder; made if need be.  [default: NAME]"
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write a small measurement with a known answer: OCT volumes, a study of them, the truth."""
    from optical_palpation.experiment.sample_data import SAMPLES, make_sample, sample_truth

    folder = output or Path(name)
    if not quiet:
        print(f"{name}: {SAMPLES[name]}", flush=True)
    study = make_sample(name, folder)
    if quiet:
        return
    truth = sample_truth(name)
    stress = truth["axial_stress"]
    print(
        f"{folder / 'unloaded.npy'}, {folder / 'loaded.npy'}: OCT volumes of the layer\n"
        f"{folder / 'truth.nc'}: axial stress {float(stress.min()):.2f} to "
        f"{float(stress.max()):.2f} kPa, force {truth.attrs['window_force_mN']:.1f} mN\n"
        f"{study}: the study of them; next: optical-palpation run {study}"
    )
