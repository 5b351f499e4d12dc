"""The mechanics of the compliant layer: a finite-element solver on a structured grid.

Plain NumPy arrays in mm, kPa and mN; nothing here knows of OCT, files or plots.
"""
