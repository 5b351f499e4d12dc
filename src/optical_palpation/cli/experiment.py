"""``optical-palpation experiment``: a layer pressed on a deformable sample."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optical_palpation.cli.options import Quiet, Threads
from optical_palpation.cli.progress import ProgressDisplay
from optical_palpation.errors import OutputError


def experiment(
    scene: Annotated[
        str,
        typer.Argument(
            metavar="SCENE",
            help="A scene file (.toml), or one of cube_on_plate, nodule, random_tissue, "
            "relief, sinusoid, soft_stiff_columns.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FOLDER", help="Folder for the results; made if need be."
        ),
    ] = Path("experiment-output"),
    element_size: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER", help="Lateral size of the elements, mm, instead of the scene's."
        ),
    ] = None,
    compression: Annotated[
        float | None,
        typer.Option(metavar="NUMBER", help="Travel of the plate, mm, instead of the scene's."),
    ] = None,
    volumes: Annotated[
        bool, typer.Option("--volumes", help="Also write OCT volumes: unloaded.npy, loaded.npy.")
    ] = False,
    threads: Threads = None,
    quiet: Quiet = False,
) -> None:
    """Press a layer on a virtual sample: its thickness as OCT would see it, and the true stress.

    Writes experiment.nc, experiment.png, layer.vts and sample.vts, and OCT volumes if asked for.
    """
    from optical_palpation.experiment import read_scene, run_experiment
    from optical_palpation.experiment.scene import with_compression, with_element_size
    from optical_palpation.present.experiment import (
        write_bodies,
        write_experiment,
        write_experiment_figure,
    )
    from optical_palpation.present.output import check_writable

    read = read_scene(scene)
    if element_size is not None:
        read = with_element_size(read, element_size)
    if compression is not None:
        read = with_compression(read, compression)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{output}: the folder cannot be made ({reason})") from error
    result_file, picture = output / "experiment.nc", output / "experiment.png"
    layer, sample = output / "layer.vts", output / "sample.vts"
    check_writable(result_file, "result")
    check_writable(picture, "picture")
    check_writable(layer, "ParaView file")
    check_writable(sample, "ParaView file")
    with ProgressDisplay(quiet) as progress:
        result = run_experiment(read, threads=threads, progress=progress)
    write_experiment(result, result_file)
    write_experiment_figure(result, picture)
    write_bodies(result, layer, sample)
    written = [result_file, picture, layer, sample]
    if volumes:
        from optical_palpation.experiment.volumes import experiment_volumes, write_volume

        for name, volume in experiment_volumes(result.maps).items():
            written.append(output / f"{name}.npy")
            if not quiet:
                print(f"making {written[-1]}", flush=True)
            write_volume(volume, written[-1])
        pixels = ", ".join(f"{1e3 * step:g}" for step in volume.spacing)
        if not quiet:
            print(f"  stacks of B-scans, linear amplitude, pixels (z, y, x) of {pixels} um")
    if quiet:
        return
    maps = result.maps
    thickness, stress = maps["loaded_thickness"], maps["axial_stress"]
    print(
        f"{read.title or scene}: {maps.attrs['newton_iterations']} Newton iterations\n"
        f"  force at window, sample, plate  {maps.attrs['window_force_mN']:.2f}, "
        f"{maps.attrs['sample_force_mN']:.2f}, {maps.attrs['plate_force_mN']:.2f} mN\n"
        f"  loaded thickness                {float(thickness.min()):.4f} to "
        f"{float(thickness.max()):.4f} mm\n"
        f"  true axial stress               {float(stress.min()):.3f} to "
        f"{float(stress.max()):.3f} kPa\n"
        f"Written: {', '.join(map(str, written))}"
    )
