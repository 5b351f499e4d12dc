"""
The layer in an OCT volume
==========================

The window shows as a bright line, the sample as scattering below a transparent layer.
:func:`~optical_palpation.thickness.find_layer` finds both surfaces and tells how well they are
seen.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np

import optical_palpation as op
from optical_palpation.experiment import make_sample

folder = make_sample("relief", tempfile.mkdtemp()).parent
spacing = {"z": 0.0029, "y": 0.04, "x": 0.04}  # mm
volume = op.open_volume(folder / "loaded.npy", axes="yzx", spacing=spacing, scale="linear")
layer = op.find_layer(volume)

middle = len(volume) // 2
image = 20 * np.log10(volume.bscan(middle) + 1e-6)
depth = spacing["z"] * np.arange(image.shape[0])

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
left.pcolormesh(layer["x"], depth, image, cmap="gray", vmin=np.median(image) - 5, rasterized=True)
for name in ("window_depth", "sample_depth"):
    left.plot(layer["x"], layer[name][middle], label=name.replace("_", " "))
left.invert_yaxis()
left.set(xlabel="x (mm)", ylabel="depth (mm)", title="B-scan in the middle")
left.legend()
label = {"label": "thickness (mm)"}
layer["thickness"].plot.imshow(ax=right, cmap="cividis", cbar_kwargs=label)
right.set(xlabel="x (mm)", ylabel="y (mm)", title="thickness", aspect="equal")
figure.show()
