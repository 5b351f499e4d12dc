"""
The layer's material from a uniaxial test
=========================================

The recorded zero of a test mostly lies before the contact of platen and specimen. The contact is
found, and three laws are fitted to what follows.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from optical_palpation.material import (
    MooneyRivlin,
    find_contact,
    fit_uniaxial,
    read_uniaxial_test,
)

# Stands for a test of yours: 10 mm high, met 0.3 mm after the recorded zero.
travel = np.linspace(0.0, 4.3, 200)
strain = np.maximum(travel - 0.3, 0.0) / 10.0
stress = MooneyRivlin(2.23, 0.703).uniaxial_stress(-strain)
noise = np.random.default_rng(0).normal(0.0, 0.02, travel.size)
table = pd.DataFrame({"compressive_strain": travel / 10.3, "stress_kPa": stress + noise})
file = Path(tempfile.mkdtemp()) / "silicone.csv"
table.to_csv(file, index=False)

test = read_uniaxial_test(file)
contact = find_contact(test)
clean = test.from_contact(contact.strain, contact.toe_end)
fits = [fit_uniaxial(clean, law) for law in ("mooney-rivlin", "neo-hookean", "yeoh")]

figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
shown = slice(None, None, 8)
axes.plot(-clean.strain[shown], -clean.stress[shown], "ko", ms=4, label="test, from contact on")
for fit in fits:
    law = fit.material()
    e = np.linspace(0, -clean.strain.min(), 80)
    modulus = f"E = {law.initial_youngs_modulus:.1f} kPa"
    axes.plot(e, -law.uniaxial_stress(-e), label=f"{fit.law}: {modulus}")
axes.set(xlabel="compressive strain", ylabel="engineering stress (kPa)")
axes.legend()
figure.show()
