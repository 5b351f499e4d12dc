"""
Both methods against the truth
==============================

The sample data *relief* come from a virtual experiment: a stiff sample with a random relief is
pressed into the layer, and the stress between them is known. The algebraic method treats each
pixel as an independent uniaxial test. The computational method solves the mechanics of the whole
layer.
"""

import matplotlib.pyplot as plt

import optical_palpation as op
from optical_palpation.experiment import sample_truth

truth = sample_truth("relief")
about = truth.attrs

result = op.computational_stress(
    op.clean_thickness(truth["loaded_thickness"])["thickness"],
    about["initial_thickness_mm"],
    op.MooneyRivlin(c10=about["c10_kPa"], c01=about["c01_kPa"]),
    window_friction=about["window_friction"],
    sample_friction=about["sample_friction"],
    element_size=0.2,
)
result

# %%
# One row through the middle of each map. Near the border both methods and the experiment itself
# depend on how the free sides of the layer are modelled.

figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
along = truth["axial_stress"].interp(y=2)
axes.plot(along["x"], along, "k", label="truth")
for name, label in {
    "axial_stress": "computational",
    "algebraic_axial_stress": "algebraic",
}.items():
    row = result.maps[name].interp(y=2)
    axes.plot(row["x"], row, label=label)
axes.set(xlabel="x (mm)", ylabel="axial stress (kPa)")
axes.legend()
figure.show()
