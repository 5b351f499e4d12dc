"""The field's detector: edges of each B-scan by Canny's method, the strongest taken."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from .intensity import Read
from .tracking import Edge

SMOOTHING = 2.0  # Gaussian, in axial point-spread functions
THRESHOLDS = 6.0, 12.0  # of the gradient, in median absolute values of it (its noise)


def canny_surface(
    read: Read,
    shape: tuple[int, int, int],
    edge: Edge,
    first: NDArray[np.float64],
    last: NDArray[np.float64],
    *,
    sigma: float,
) -> NDArray[np.float64]:
    """Depth `[y, x]`, pixels, of the strongest edge between `first` and `last`; NaN where none is.

    The edge has the sign of `edge`; of a line, its middle between rise and fall is taken.
    """
    from skimage.feature import canny  # slow to import

    depth = np.full(shape[1:], np.nan)
    width = max(SMOOTHING * sigma, 1.0)
    for y in range(shape[1]):
        image = read(y)
        floor = np.median(image[image >= 0])
        log = np.log(np.where(image >= 0, image, floor) + floor)
        gradient = np.gradient(gaussian_filter(log, width), axis=0)
        # Canny's own gradient is that of Sobel, four times the difference of neighbours.
        noise = 4.0 * float(np.median(np.abs(gradient)))
        low, high = (t * noise for t in THRESHOLDS)
        edges = canny(log, width, low, high)
        if edge == "fall":
            depth[y] = _strongest(edges & (gradient < 0), -gradient, first[y], last[y])
            continue
        depth[y] = _strongest(edges & (gradient > 0), gradient, first[y], last[y])
        if edge == "line":
            bottom = _strongest(edges & (gradient < 0), -gradient, depth[y], last[y])
            depth[y] = 0.5 * (depth[y] + bottom)
    return depth


def _strongest(
    edges: NDArray[np.bool_],
    strength: NDArray[np.float32],
    first: NDArray[np.float64],
    last: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Depth of the strongest edge of each column, from a parabola through its gradient."""
    z = np.arange(len(edges))[:, None]
    with np.errstate(invalid="ignore"):
        edges = edges & (z >= first) & (z <= last)
    edges[0] = edges[-1] = False
    column = np.flatnonzero(edges.any(axis=0))
    at = np.argmax(np.where(edges, strength, -np.inf)[:, column], axis=0)
    above, here, below = (strength[at + i, column].astype(float) for i in (-1, 0, 1))
    bend = np.minimum(above - 2.0 * here + below, -1e-12)
    depth = np.full(edges.shape[1], np.nan)
    depth[column] = at + np.clip(0.5 * (above - below) / bend, -0.5, 0.5)
    return depth
