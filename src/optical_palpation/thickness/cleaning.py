"""Missing values and single-pixel spikes of a thickness map."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from optical_palpation.arguments import explained
from optical_palpation.errors import InputError
from optical_palpation.thickness.frames import inside_layer, on_grid

# A spike stands out of the range of its neighbours by this many times that range. For the nine
# values together this is Dixon's ratio 0.75, far beyond the 1 % critical value.
_SPIKE_RANGES = 3.0
# ... and by this share of the layer's thickness, so that the relief of a noise-free map is kept.
_SPIKE_SHARE = 0.02

_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=bool)


@explained
def clean_thickness(thickness: xr.DataArray) -> xr.Dataset:
    """Replace single-pixel spikes and missing values; leave every other pixel as it is.

    A pixel is a spike if it lies outside the range (smallest to largest) of its eight neighbours

    - by more than 3 times that range, or 3 times the median of that range over the whole map if
      this is more (so that a range small by chance accuses nobody), and
    - by more than 2 % of the median thickness.

    A pixel inside the range of its neighbours is never a spike, so edges, ridges and steps stay.
    Spikes and missing values are interpolated with the solution of Laplace's equation between the
    good pixels (no slope across the border of the map): smooth, and never thicker or thinner than
    the pixels around the gap.

    Parameters
    ----------
    thickness
        Map in mm on ``(y, x)``, NaN where missing.

    Returns
    -------
    xarray.Dataset
        ``thickness`` (mm, no NaN) and ``filled`` (bool, True where the value is made up), on the
        coordinates of `thickness`. The attributes report ``missing_share``, ``spike_share`` and
        ``filled_share`` (0 to 1) of the pixels in the layer's extent.

    Raises
    ------
    InputError
        If the map is not on ``(y, x)`` with coordinates, or all of it is missing.
    """
    thickness = on_grid(thickness)
    values = thickness.values.astype(np.float64)
    missing = ~np.isfinite(values)
    if missing.all():
        raise InputError("all of the thickness map is missing; nothing to fill it from")
    spikes = _spikes(values)
    filled = missing | spikes
    inside = inside_layer(thickness)
    weights = [1.0 / float(np.median(np.abs(np.diff(thickness[axis])))) ** 2 for axis in "yx"]
    clean = thickness.copy(data=_fill(values, filled, weights))
    clean.attrs["missing_share"] = 0.0
    return xr.Dataset(
        {
            "thickness": clean,
            "filled": clean.copy(data=filled)
            .drop_attrs(deep=False)
            .assign_attrs(units="1", long_name="missing or spike, interpolated"),
        },
        attrs={
            "missing_share": float(missing[inside].mean()),
            "spike_share": float(spikes[inside].mean()),
            "filled_share": float(filled[inside].mean()),
            "spike_rule": (
                f"outside the range of the 8 neighbours by more than {_SPIKE_RANGES:g} times that "
                f"range and {_SPIKE_SHARE:g} of the median thickness"
            ),
        },
    )


def _spikes(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    missing = ~np.isfinite(values)

    def over_neighbours(filter_, empty: float) -> NDArray[np.float64]:  # type: ignore[no-untyped-def]
        padded = np.where(missing, empty, values)
        return filter_(padded, footprint=_NEIGHBOURS, mode="constant", cval=empty)

    highest = over_neighbours(ndimage.maximum_filter, -np.inf)
    lowest = over_neighbours(ndimage.minimum_filter, np.inf)
    count = ndimage.convolve((~missing).astype(int), _NEIGHBOURS.astype(int), mode="constant")
    judged = ~missing & (count >= 3)  # a corner has three; fewer say too little
    if not judged.any():
        return np.zeros(values.shape, dtype=bool)
    spread = np.where(judged, highest - lowest, np.nan)
    outside = np.where(judged, np.maximum(values - highest, lowest - values), 0.0)
    threshold = _SPIKE_RANGES * np.maximum(spread, np.nanmedian(spread))
    return judged & (outside > np.fmax(threshold, _SPIKE_SHARE * np.nanmedian(values)))


def _fill(
    values: NDArray[np.float64], holes: NDArray[np.bool_], weights: list[float]
) -> NDArray[np.float64]:
    """Solve Laplace's equation in the holes; weights are those of the differences along y, x."""
    unknown = np.flatnonzero(holes)
    if not unknown.size:
        return values
    number = np.full(values.size, -1)
    number[unknown] = np.arange(unknown.size)
    index = np.arange(values.size).reshape(values.shape)
    pairs = [
        (np.stack([first.ravel(), second.ravel()]), weight)
        for first, second, weight in (
            (index[:-1], index[1:], weights[0]),
            (index[:, :-1], index[:, 1:], weights[1]),
        )
    ]
    flat = values.ravel()
    diagonal = np.zeros(unknown.size)
    right = np.zeros(unknown.size)
    rows, columns, entries = [], [], []
    for pair, weight in pairs:
        for here, there in (pair, pair[::-1]):
            keep = number[here] >= 0
            here, there = number[here[keep]], there[keep]
            np.add.at(diagonal, here, weight)
            inner = number[there] >= 0
            np.add.at(right, here[~inner], weight * flat[there[~inner]])
            rows.append(here[inner])
            columns.append(number[there[inner]])
            entries.append(np.full(int(inner.sum()), -weight))
    matrix = sparse.coo_array(
        (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))),
        shape=(unknown.size, unknown.size),
    ) + sparse.diags_array(diagonal)
    # Symmetric positive definite: order by the symmetric pattern and do without pivoting.
    factors = splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    result = flat.copy()
    result[unknown] = factors.solve(right)
    return result.reshape(values.shape)
