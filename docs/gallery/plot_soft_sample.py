"""
A soft sample spreads
=====================

The sample data *nodule* are those of tissue as soft as the layer, which spreads sideways under
load and carries the layer with it. Stress computed as if the surface of the sample stood still is
wrong; with its lateral displacement it is right.
"""

import matplotlib.pyplot as plt

import optical_palpation as op
from optical_palpation.experiment import sample_truth

truth = sample_truth("nodule")
about = truth.attrs
loaded = op.clean_thickness(truth["loaded_thickness"])["thickness"]
law = op.MooneyRivlin(c10=about["c10_kPa"], c01=about["c01_kPa"])
common = {
    "window_friction": about["window_friction"],
    "sample_friction": about["sample_friction"],
    "element_size": 0.2,
    "mesh_check": False,  # the stress alone, without what mesh, sides and errors of the inputs do
    "edge_check": False,
    "input_errors": None,
}
still = op.computational_stress(loaded, about["initial_thickness_mm"], law, **common)
moving = op.computational_stress(
    loaded, about["initial_thickness_mm"], law, sample_motion=truth, **common
)

figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
axes.plot(truth["x"], truth["axial_stress"].interp(y=2), "k", label="truth")
for maps, name, label in (
    (still.maps, "axial_stress", "sample taken as still"),
    (moving.maps, "axial_stress", "motion of the sample known"),
    (still.maps, "algebraic_axial_stress", "algebraic"),
):
    row = maps[name].interp(y=2)
    axes.plot(row["x"], row, label=label)
axes.set(xlabel="x (mm)", ylabel="axial stress (kPa)")
axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
figure.show()
