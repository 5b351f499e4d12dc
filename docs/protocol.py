"""The numbers of docs/protocol.md (``make protocol``).

Runs the commands that stand on the page for the samples *relief* and *nodule*, and writes what they
find into its two tables and into the sentence on the mean indentation. Takes a minute or two.
"""

import re
import subprocess
import sys
import tempfile
from contextlib import chdir
from pathlib import Path
from typing import Any

import xarray as xr

PAGE = Path(__file__).with_name("protocol.md")
ERRORS = (
    *("--modulus", "0.02", "--thickness", "0.002"),
    *("--thickness-noise", "0.002", "--noise-correlation", "0.02", "--probes", "2"),
)
#: Where the layer of both samples lies, mm; their maps reach beyond it.
LAYER = slice(0.0, 4.0)
#: Rows of the first table: input, what it is called, and what to aim for.
QUANTITIES = (
    ("window_friction", "friction at the window", "± 0.05"),
    ("sample_friction", "friction at the sample", "± 0.05"),
    ("modulus", "stiffness of the layer", "± 2 %"),
    ("thickness", "thickness, error common to all pixels", "± 2 um"),
    (
        "thickness_noise",
        "thickness, random error of each pixel, correlated over 0.02 mm",
        "± 2 um",
    ),
)
#: Rows of the second table, by its name in the example of the page.
CHOICES = {
    "edges-padded": "the layer is taken to go on beyond the field (`padded`), and ends there: "
    "force of the continued layer",
    "extent-too-small": "the extent of the layer is 0.1 mm too small on each side",
    "sample-frictionless": "friction at the sample is left out",
    "compressible": "K/mu of 20, as in published code, instead of 1e4",
    "coarse": "elements of 0.25 mm, two through the depth",
}


def main() -> None:
    """Run the commands of the page and write their numbers into it."""
    text = PAGE.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        found, indentation = {}, {}
        for name in ("relief", "nodule"):
            run(folder, "sample", name)
            run(folder, "uncertainty", f"{name}/study.toml", *ERRORS)
            results = folder / name / "results"
            found[name] = xr.load_dataset(results / "uncertainty.nc", engine="h5netcdf")
            maps = xr.load_dataset(results / "thickness.nc", engine="h5netcdf")
            depth = (maps["initial_thickness"] - maps["loaded_thickness"]).sel(x=LAYER, y=LAYER)
            indentation[name] = 1e3 * float(depth.mean())
        example = re.search(r"```python\n(.*?)```", text, re.S)
        assert example is not None
        names: dict[str, Any] = {}
        with chdir(folder):
            exec(example[1], names)
    text = with_table(text, "| quantity |", errors_table(found))
    text = with_table(text, "| wrong choice |", choices_table(names["change"]))
    text, count = re.subn(
        r"2 um are \S+ % of the mean\s+indentation of \*relief\*, \S+ um, and \S+ % of that of "
        r"\*nodule\*, \S+ um\.",
        "2 um are {:.0f} % of the mean\n  indentation of *relief*, {:.0f} um, and {:.0f} % of that "
        "of *nodule*, {:.0f} um.".format(
            *(number for depth in indentation.values() for number in (100 * 2 / depth, depth))
        ),
        text,
    )
    assert count == 1, "the sentence on the mean indentation is not there"
    PAGE.write_text(text, encoding="utf-8")
    print(f"{PAGE}: written; look at what stands between the tables")


def run(folder: Path, *arguments: str) -> None:
    """Run a command as on the page."""
    command = [sys.executable, "-m", "optical_palpation", *arguments]
    subprocess.run(command, cwd=folder, check=True)


def errors_table(found: dict[str, xr.Dataset]) -> str:
    """What an error of each quantity costs in the force."""
    forces = {name: float(errors.attrs["force_mN"]) for name, errors in found.items()}
    heads = (
        f"{kind} sample: force, {force:.0f} mN"
        for kind, force in zip(("stiff", "soft"), forces.values(), strict=True)
    )
    rows = [f"| quantity | aim for | {' | '.join(heads)} |", "| --- | --- | --- | --- |"]
    for key, what, aim in QUANTITIES:
        cells = []
        for name, errors in found.items():
            error = float(errors["force_contribution"].sel(input=key))
            share = 100 * error / forces[name]
            size = f"{error:.1f}" if error >= 0.05 else f"{error:.1g}"
            part = f"{share:.0f}" if share >= 1 else f"{share:.1g}"
            cells.append(f"± {size} mN" + (f" ({part} %)" if share >= 0.1 else ""))
        rows.append(f"| {what} | {aim} | {' | '.join(cells)} |")
    return "\n".join(rows)


def choices_table(changes: dict[str, float]) -> str:
    """What choices that are wrong cost in the force."""
    rows = ["| wrong choice | force of *relief* |", "| --- | --- |"]
    for name, what in CHOICES.items():
        change = 100 * changes[name]
        rows.append(f"| {what} | {'+' if change > 0 else '-'} {abs(change):.0f} % |")
    return "\n".join(rows)


def with_table(text: str, start: str, table: str) -> str:
    """Replace the table that starts so."""
    pattern = re.compile(rf"^{re.escape(start)}.*(?:\n\|.*)*", re.M)
    assert len(pattern.findall(text)) == 1, f"no table {start}"
    return pattern.sub(lambda _: table, text)


if __name__ == "__main__":
    main()
