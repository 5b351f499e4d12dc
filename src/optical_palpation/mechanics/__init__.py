"""The mechanics of the compliant layer: a finite-element solver on a structured grid.

Plain NumPy arrays in mm, kPa and mN; nothing here knows of OCT, files or plots.
"""

import os

# Threads that wait for one another spin for about 10 us and then sleep. By default GNU OpenMP lets
# them spin for milliseconds: where another program holds a core they spin its time away, and a run
# takes ten times as long. The runtime reads this when Numba first loads it.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
