"""
How fine a mesh
===============

Halve the element size until the force changes by less than you care for. Time and memory grow
about in proportion to the number of elements.
"""

import matplotlib.pyplot as plt

import optical_palpation as op
from optical_palpation.experiment import sample_truth

truth = sample_truth("relief")
study = op.Study(
    loaded=truth["loaded_thickness"],
    unloaded=0.5,
    material=op.MooneyRivlin(c10=2.23, c01=0.703),
    friction={"window": 0.15, "sample": 0.1},
    grid=0.25,
)
figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
for size in (0.25, 0.167, 0.125):
    result = study.with_(grid={"element_size": size}).run()
    row = result.maps["axial_stress"].interp(y=2)
    axes.plot(row["x"], row, label=f"{size:g} mm, {result.maps.attrs['window_force_mN']:.1f} mN")
axes.plot(truth["x"], truth["axial_stress"].interp(y=2), "k", label="truth")
axes.set(xlabel="x (mm)", ylabel="axial stress (kPa)", xlim=(0, 4))
axes.legend(title="element size, force")
figure.show()
