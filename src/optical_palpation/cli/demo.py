"""``optical-palpation demo``: a sample and its study in one go."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optical_palpation.cli.options import Quiet, Threads
from optical_palpation.cli.sample import SampleName, sample
from optical_palpation.cli.study import run

_CLOSING = """
Against the truth, more than 0.5 mm from the border: the thickness is off by {thickness:.1f} um
(RMS), the axial stress by {computational:.0%} (computational method) and {algebraic:.0%}
(algebraic method) of its RMS value. The algebraic method treats each pixel as an independent
uniaxial test; the computational method models an incompressible layer held by friction, which
carries more where it has far to flow.
Open {report} in a browser, or look at {picture}."""


def demo(
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FOLDER", help="Folder for the results; made if need be."
        ),
    ] = Path("demo-output"),
    threads: Threads = None,
    quiet: Quiet = False,
) -> None:
    """Make the sample "relief", run its study, and compare the result with the truth."""
    sample(SampleName.RELIEF, output, quiet)
    run([output / "study.toml"], threads=threads, quiet=quiet)
    if quiet:
        return

    import xarray as xr

    from optical_palpation.analysis import compare_maps
    from optical_palpation.present import read_result
    from optical_palpation.thickness import read_thickness_map

    results = output / "results"
    truth = xr.load_dataset(output / "truth.nc", engine="h5netcdf")
    found = read_thickness_map(results / "boundaries-loaded.nc")
    maps = read_result(results / "stress.nc").maps
    interior = {
        name: compare_maps(values, truth[of]).sel(zone="interior")
        for name, values, of in (
            ("thickness", found, "loaded_thickness"),
            ("computational", maps["axial_stress"], "axial_stress"),
            ("algebraic", maps["algebraic_axial_stress"], "axial_stress"),
        )
    }
    print(
        _CLOSING.format(
            thickness=1e3 * float(interior["thickness"]["rms"]),
            computational=float(interior["computational"]["relative_rms"]),
            algebraic=float(interior["algebraic"]["relative_rms"]),
            report=results / "report.html",
            picture=results / "stress.png",
        )
    )
