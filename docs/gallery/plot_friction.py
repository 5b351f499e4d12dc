"""
What friction does to the stress
================================

The same loaded thickness means more stress if the layer sticks than if it slides. A sweep over
the coefficient at the window shows how much is at stake before anything is measured.
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
    errors={"estimates": False},  # the stress alone
)
sweep = op.sweep(study, {"friction.window": [0.05, 0.1, 0.15, 0.2, 0.3]})

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for friction, row in sweep["axial_stress"].interp(y=2).groupby("friction_window"):
    left.plot(row["x"], row.squeeze(), label=f"{friction:g}")
left.legend(title="friction", loc="center left", bbox_to_anchor=(1, 0.5))
left.set(xlabel="x (mm)", ylabel="axial stress (kPa)", title="along y = 2 mm")
sweep["window_force"].plot.line("o-", ax=right)
right.set(xlabel="friction at the window", ylabel="force (mN)", title="total force", ylim=(0, None))
figure.show()
