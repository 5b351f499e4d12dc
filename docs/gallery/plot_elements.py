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
loaded = op.clean_thickness(truth["loaded_thickness"])["thickness"]
figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
for size in (0.25, 0.167, 0.125):
    result = op.computational_stress(
        loaded,
        0.5,
        op.MooneyRivlin(c10=2.23, c01=0.703),
        window_friction=0.15,
        sample_friction=0.1,
        element_size=size,
        mesh_check=False,  # the stress alone
        edge_check=False,
        input_errors=None,
    )
    row = result.maps["axial_stress"].interp(y=2)
    axes.plot(row["x"], row, label=f"{size:g} mm, {result.maps.attrs['window_force_mN']:.1f} mN")
axes.plot(truth["x"], truth["axial_stress"].interp(y=2), "k", label="truth")
axes.set(xlabel="x (mm)", ylabel="axial stress (kPa)", xlim=(0, 4))
axes.legend(title="element size, force")
figure.show()
