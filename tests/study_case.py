"""A small pair of synthetic volumes, the study of them, and the command line in a test."""

from pathlib import Path

import numpy as np

from optical_palpation.experiment.synthetic_oct import SyntheticOCT

SPACING = (0.0029, 0.03, 0.03)
Y, X = np.meshgrid(0.03 * np.arange(40), 0.03 * np.arange(48), indexing="ij")
UNLOADED = 0.4 + 0.01 * X
LOADED = UNLOADED - 0.05 - 0.04 * np.exp(-((X - 0.9) ** 2 + (Y - 0.7) ** 2) / 0.1)

LAYER = """
[material]
c10 = 2.23
c01 = 0.703

[friction]
window = 0.15
sample = 0.05
"""

STUDY = f"""
[unloaded]
volume = "unloaded.npy"

[loaded]
volume = "loaded.npy"

[volumes]
axes = "yzx"
spacing = {{ z = 0.0029, y = 0.03, x = 0.03 }}
scale = "linear"
{LAYER}
[grid]
element_size = [0.2, 0.2, 0.1]
threads = 1
"""

#: Errors that are estimated take longer than the stress; for what is not about them.
NO_ESTIMATES = "\n[errors]\nestimates = false\n"


def map_study(loaded: str, rest: str = "") -> str:
    """Text of a study of a map on a layer of 0.5 mm, on coarse elements."""
    return f"""
[unloaded]
thickness = 0.5

[loaded]
{loaded}
{LAYER}
[grid]
element_size = 0.25
{rest}
"""


def make_volumes(folder: Path) -> None:
    """Write ``unloaded.npy`` and ``loaded.npy``, in which a part of the sample lies in shadow."""
    shadow = np.ones(LOADED.shape)
    shadow[22:, :18] = 1e-4
    for name, thickness, light, seed in (
        ("unloaded", UNLOADED, None, 1),
        ("loaded", LOADED, shadow, 2),
    ):
        volume = SyntheticOCT(
            thickness,
            SPACING,
            230,
            window_depth=0.06,
            tilt=(0.01, 0.02),
            transmission=light,
            seed=seed,
        )
        np.save(folder / f"{name}.npy", np.stack(list(volume)))


def make_study(folder: Path, text: str = STUDY) -> Path:
    """Write the study file."""
    path = folder / "study.toml"
    path.write_text(text)
    return path
