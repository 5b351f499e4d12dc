"""The napari plugin: see the layer, correct its boundaries, solve, and read off regions.

``session`` and ``layers`` know neither Qt nor napari; the other modules are the plugin itself, and
need the extra ``viewer``.
"""
