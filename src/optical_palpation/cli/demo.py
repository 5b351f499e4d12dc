"""``optical-palpation demo``: the main job on a thickness map that the program makes itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optical_palpation.cli.stress import stress
from optical_palpation.errors import OutputError

_EXPLANATION = """\
A layer of silicone, 0.5 mm thick and 5 x 5 mm wide, was pressed on an imaginary sample with three
bumps, a ridge, a ring and a bar. Its thickness map as OCT would see it, with noise and gaps: {map}.
Now the tactile stress behind that map, by the algebraic and the computational method, as this
command does it:

optical-palpation stress {map} --initial-thickness 0.5 --c10 2.23 --c01 0.703 \\
  --window-friction 0.15 --sample-friction 0.05 --element-size {element_size} \\
  --output {result} --plot {picture} --vtk {vtk} --profiles {profiles}
"""

_CLOSING = """
Open the picture first. The algebraic method takes every pixel for a uniaxial test of its own; the
computational one knows that the layer is incompressible and held by friction, so that it bears more
where it has far to flow."""


def demo(
    output: Annotated[Path, typer.Option(help="Folder for the results; made if need be.")] = Path(
        "demo-output"
    ),
    element_size: Annotated[str, typer.Option(help="Size of the elements, mm.")] = "0.125",
) -> None:
    """Make a thickness map, compute the stress behind it by both methods, and draw it."""
    from optical_palpation.experiment.demo_map import demo_thickness_map
    from optical_palpation.thickness import write_thickness_map

    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{output}: the folder cannot be made ({reason})") from error
    files = {
        "map": output / "loaded-thickness.nc",
        "result": output / "stress.nc",
        "picture": output / "stress.png",
        "vtk": output / "layer.vts",
        "profiles": output / "profiles.csv",
    }
    write_thickness_map(demo_thickness_map(), files["map"])
    print(_EXPLANATION.format(element_size=element_size, **files), flush=True)
    stress(
        files["map"],
        initial_thickness="0.5",
        c10=2.23,
        c01=0.703,
        window_friction=0.15,
        sample_friction=0.05,
        element_size=element_size,
        output=files["result"],
        plot=files["picture"],
        vtk=files["vtk"],
        profiles=files["profiles"],
    )
    print(_CLOSING)
