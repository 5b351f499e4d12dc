"""Sphinx: the pages of this folder as a site (``make docs``)."""

from optical_palpation.runtime import software_version

project = "Optical palpation"
author = copyright = "The Optical Palpation developers"
version = release = software_version()
extensions = ["myst_parser"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

html_theme = "pydata_sphinx_theme"
html_title = project
html_theme_options = {"show_prev_next": True, "navigation_with_keys": False}
