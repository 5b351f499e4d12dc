"""Computational optical palpation: maps of tactile stress from the thickness of a soft layer.

The public names live in the subpackages: ``volume``, ``thickness``, ``material``, ``palpation``,
``friction``, ``analysis`` and ``present``; errors in ``errors``.
"""

from optical_palpation.kernel_cache import provide_kernel_cache

provide_kernel_cache()
del provide_kernel_cache
