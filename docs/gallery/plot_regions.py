"""
Regions of interest
===================

Mean stress, force and contrast in regions, which may also come from ImageJ, napari or a table. A
pixel on the border counts by the fraction of it that lies inside. Stress is in kPa, force in mN,
area in mm².
"""

import matplotlib.pyplot as plt

import optical_palpation as op
from optical_palpation.experiment import sample_truth

truth = sample_truth("nodule")
about = truth.attrs
result = op.computational_stress(
    op.clean_thickness(truth["loaded_thickness"])["thickness"],
    about["initial_thickness_mm"],
    op.MooneyRivlin(c10=about["c10_kPa"], c01=about["c01_kPa"]),
    window_friction=about["window_friction"],
    sample_friction=about["sample_friction"],
    sample_motion=truth,
    element_size=0.2,
)
regions = [
    op.Region.ellipse("nodule", (2.5, 1.8), (0.6, 0.6)),
    op.Region.rectangle("beside it", 0.6, 1.5, 0.6, 3.4),
]
result.regions(regions).to_dataframe().T

# %%
figure, axes = plt.subplots(figsize=(5, 4), layout="constrained")
result.plot(ax=axes, regions=regions, scale_bar=True)
figure.show()
