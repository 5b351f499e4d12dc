"""``optical-palpation demo``: a whole study of OCT volumes that the program makes itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optical_palpation.cli.study import run
from optical_palpation.errors import OutputError

_STUDY = """\
title = "Demonstration"

[unloaded]
volume = "unloaded.npy"

[loaded]
volume = "loaded.npy"

[volumes]
axes = "yzx"
spacing = {{ z = {z}, y = {y}, x = {x} }}    # mm
scale = "linear"

[material]    # kPa
c10 = 2.23
c01 = 0.703

[friction]
window = 0.15
sample = 0.05

[grid]
element_size = {element_size}    # mm

[outputs]
folder = "results"
"""

_EXPLANATION = """\
A layer of silicone, 0.5 mm thick and 5 x 5 mm wide, was pressed on an imaginary sample with three
bumps, a ridge, a ring and a bar. What OCT sees of it before and after, with speckle, noise and a
tilted window, is now in {folder}: unloaded.npy and loaded.npy. The file {study}
says what they are and what to do with them. This command does it:

optical-palpation run {study}
"""

_CLOSING = """
The thickness found is off the true one by {error:.1f} um (RMS). Open {report}
in a browser, or look at {picture}. The algebraic method takes every
pixel for a uniaxial test of its own; the computational one knows that the layer is incompressible
and held by friction, so that it bears more where it has far to flow."""


def demo(
    output: Annotated[Path, typer.Option(help="Folder for the results; made if need be.")] = Path(
        "demo-output"
    ),
    element_size: Annotated[str, typer.Option(help="Size of the elements, mm.")] = "0.125",
) -> None:
    """Make OCT volumes, find the layer in them, compute the stress by both methods, and draw it."""
    from optical_palpation.experiment.demo_volumes import demo_volumes, write_volume
    from optical_palpation.files import replacing

    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{output}: the folder cannot be made ({reason})") from error
    volumes = demo_volumes()
    for name, volume in volumes.items():
        print(f"making {output / name}.npy", flush=True)
        write_volume(volume, output / f"{name}.npy")
    study = output / "study.toml"
    sizes = f"[{element_size}]" if "," in element_size else element_size
    z, y, x = volumes["loaded"].spacing
    with replacing(study) as temporary:
        temporary.write_text(_STUDY.format(z=z, y=y, x=x, element_size=sizes), encoding="utf-8")
    print(_EXPLANATION.format(folder=output, study=study), flush=True)
    run(study)

    from optical_palpation.thickness import read_thickness_map

    results = output / "results"
    found = read_thickness_map(results / "boundaries-loaded.nc").values
    error_um = 1e3 * float(((found - volumes["loaded"].thickness) ** 2).mean() ** 0.5)
    print(
        _CLOSING.format(
            error=error_um, report=results / "report.html", picture=results / "stress.png"
        )
    )
