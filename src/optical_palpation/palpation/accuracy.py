"""A mesh for a wanted accuracy of the total force."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from optical_palpation.errors import ConvergenceError, InputError, InsufficientMemoryError
from optical_palpation.palpation.result import StressResult

#: Accuracies that can be asked for: what free edges are off by on any mesh, and what no longer
#: needs a choice of one.
LOWEST, HIGHEST = 0.01, 0.3
#: Elements to begin with, as fractions of the thickness and of the smaller side of the field.
_OF_THICKNESS, _OF_FIELD = 0.25, 0.1
#: Meshes that are tried, and how much finer the next one may be.
_MESHES, _FINER = 6, (0.4, 0.8)


def first_size(thickness: float, field: tuple[float, float]) -> float:
    """Size of the elements to begin with, mm, of a layer of some thickness and field, mm."""
    return min(_OF_THICKNESS * thickness, _OF_FIELD * min(field))


def solve_to_accuracy(
    accuracy: float,
    thickness: float,
    field: tuple[float, float],
    solve: Callable[[float], StressResult],
) -> StressResult:
    """Solve on finer and finer elements until the error of the mesh is small enough.

    Parameters
    ----------
    accuracy
        Error of the total force that is wanted at the most, as a fraction of it.
    thickness, field
        Of the layer, mm.
    solve
        Returns the result for an element size, mm.

    Raises
    ------
    InputError
        For an accuracy that cannot be had.
    InsufficientMemoryError
        If the elements that it takes need more memory than there is.
    ConvergenceError
        If the estimated error stays above it.
    """
    numeric = isinstance(accuracy, int | float | np.number)
    if not (numeric and LOWEST <= accuracy <= HIGHEST):
        raise InputError(
            f"accuracy must lie between {LOWEST:g} and {HIGHEST:g} (0.02 for 2 % of the total "
            f"force), not {accuracy!r}"
        )
    size = first_size(thickness, field)
    said = ""
    for _ in range(_MESHES):
        try:
            result = solve(size)
        except InsufficientMemoryError as failure:
            raise InsufficientMemoryError(
                f"an accuracy of {accuracy:.2%} takes elements of about {size:.2g} mm{said}: "
                f"{failure}"
            ) from None
        attrs = result.maps.attrs
        if "asked_elements_failure" in attrs:
            raise ConvergenceError(
                f"an accuracy of {accuracy:.2%} takes elements of about {size:.2g} mm{said}, with "
                f"which {attrs['asked_elements_failure']}"
            )
        force = abs(attrs["sample_force_mN"])
        error = attrs.get("force_mesh_error_mN", np.inf) / max(force, 1e-30)
        if error <= accuracy:
            # elements of this size are the same mesh
            attrs |= {"accuracy": float(accuracy), "chosen_element_size_mm": size}
            return result
        said = f" (on elements of {size:.2g} mm the error of the mesh is about {error:.1%})"
        size *= float(np.clip(0.9 * accuracy / error, *_FINER))
    raise ConvergenceError(
        f"no mesh was found on which the force is accurate to {accuracy:.2%}{said}: give an "
        "element_size, or ask for less"
    )
