"""``optical-palpation uncertainty``: what the errors of the inputs do to the stress."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optical_palpation.cli.options import (
    Quiet,
    Scheduler,
    Threads,
    each_on,
    print_files,
)
from optical_palpation.cli.progress import ProgressDisplay
from optical_palpation.errors import InputError


def uncertainty(
    file: Annotated[
        Path, typer.Argument(metavar="STUDY", help="The study file.", show_default=False)
    ],
    window_friction: Annotated[
        float,
        typer.Option(
            metavar="NUMBER", help="Error of the friction coefficient at the window.", min=0
        ),
    ] = 0.05,
    sample_friction: Annotated[
        float,
        typer.Option(
            metavar="NUMBER", help="Error of the friction coefficient at the sample.", min=0
        ),
    ] = 0.05,
    modulus: Annotated[
        float,
        typer.Option(
            metavar="NUMBER",
            help="Relative error of the layer's stiffness, 0.02 for 2 %.",
            min=0,
            max=1,
        ),
    ] = 0.0,
    thickness: Annotated[
        float,
        typer.Option(
            metavar="NUMBER", help="Error common to the whole loaded thickness, mm.", min=0
        ),
    ] = 0.0,
    thickness_noise: Annotated[
        float,
        typer.Option(
            metavar="NUMBER",
            help="Random error of the loaded thickness of each pixel, mm: twice its standard "
            "deviation, where the other errors are half-widths of 95 % intervals.",
            min=0,
        ),
    ] = 0.0,
    noise_correlation: Annotated[
        float,
        typer.Option(
            metavar="NUMBER",
            help="Standard deviation of the Gaussian over which that noise is correlated, mm.",
            min=0,
        ),
    ] = 0.0,
    probes: Annotated[
        int,
        typer.Option(
            metavar="NUMBER", help="Random fields that stand for the noise, two solves each.", min=1
        ),
    ] = 4,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Error maps (.nc); uncertainty.nc in the study's result folder.",
            show_default=False,
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Picture (.png, .pdf); uncertainty.png in the study's result folder.",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="NUMBER",
            help="Solve for the noise side by side, on so many workers of this machine (extra "
            "batch).",
            min=1,
        ),
    ] = None,
    scheduler: Scheduler = None,
    threads: Threads = None,
    quiet: Quiet = False,
) -> None:
    """Propagate errors of friction, material and thickness to the stress of a study.

    Runs the study first where it is not complete. Noise costs two solves for each probe, side by
    side with --workers or --scheduler; all else follows from the sensitivities of the stress.
    """
    import xarray as xr

    from optical_palpation import present, study
    from optical_palpation.analysis import Noise, stress_uncertainty
    from optical_palpation.palpation.threads import limited_threads
    from optical_palpation.present.uncertainty_figure import write_uncertainty_figure
    from optical_palpation.present.uncertainty_file import uncertainty_in_words, write_uncertainty
    from optical_palpation.study.compute import solver_settings

    each = each_on(workers, scheduler)
    if not any((window_friction, sample_friction, modulus, thickness, thickness_noise)):
        raise typer.BadParameter("all errors are zero: give at least one")
    asked = study.read_study(file)
    if asked.sample.modelled:
        raise InputError(
            f"{file}: has the sample in the model ([sample]); the stress of such a study carries "
            "its errors already, in stress.nc"
        )
    wanted = {"result": output, "picture": plot}
    present.check_outputs({k: path for k, path in wanted.items() if path is not None}, [file])
    with limited_threads(threads), ProgressDisplay(quiet) as progress:
        done = study.run_study(asked, progress=progress)
        nominal = done.stress()
        measured = xr.load_dataset(done.folder / "thickness.nc", engine="h5netcdf")
        loaded = measured["loaded_thickness"]
        settings = solver_settings(asked, loaded)
        if settings.pop("accuracy") is not None:  # all on the mesh that was chosen
            settings["element_size"] = nominal.maps.attrs["chosen_element_size_mm"]
        noise = None
        if thickness_noise:
            pixel = float(loaded["x"][1] - loaded["x"][0])
            noise = Noise(thickness_noise, noise_correlation / pixel, probes)
        errors = stress_uncertainty(
            loaded,
            measured["initial_thickness"],
            asked.material.make(),
            window_friction_error=window_friction,
            sample_friction_error=sample_friction,
            modulus_error=modulus,
            thickness_error=thickness,
            thickness_noise=noise,
            nominal=nominal,
            progress=progress,
            each=each,
            **settings,
        )
    output = output or done.folder / "uncertainty.nc"
    plot = plot or done.folder / "uncertainty.png"
    write_uncertainty(errors, output)
    write_uncertainty_figure(errors, plot)
    if quiet:
        return
    print(uncertainty_in_words(errors))
    print_files({"result": output, "picture": plot})
