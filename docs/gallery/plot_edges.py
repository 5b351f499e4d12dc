"""
Where the layer ends
====================

``free`` edges take the field of view for the whole layer; ``padded`` edges continue it for three
thicknesses. The pressure of an incompressible layer grows with the distance from its free sides,
so this changes the whole map and not its border alone.
"""

import matplotlib.pyplot as plt

import optical_palpation as op
from optical_palpation.experiment import sample_truth

truth = sample_truth("relief")
loaded = op.clean_thickness(truth["loaded_thickness"])["thickness"]
results = {
    edges: op.computational_stress(
        loaded,
        0.5,
        op.MooneyRivlin(c10=2.23, c01=0.703),
        window_friction=0.15,
        sample_friction=0.1,
        element_size=0.25,
        edges=edges,
        mesh_check=False,  # the stress alone
        edge_check=False,
        input_errors=None,
    )
    for edges in ("free", "padded")
}

limits = (float(min(r.maps["axial_stress"].min() for r in results.values())), 0)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
for ax, (edges, result) in zip(axes, results.items(), strict=True):
    result.plot(ax=ax, limits=limits)
    mean = -op.analysis.force_balance(result.maps["axial_stress"]).mean_stress
    ax.set_title(f"Axial stress (kPa), {edges}: {mean:.1f} on average", loc="left")
figure.show()
