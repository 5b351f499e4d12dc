"""The imprint: smoothed whatever the width, and on even pixels whatever those of the map."""

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter

from optical_palpation.averages import gaussian_average
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.palpation.meshing import imprint_of

PIXELS = 0.01 * np.arange(120), 0.02 * np.arange(90)


def relief(x, y):
    return 0.4 - 0.05 * np.exp(-((x - 0.5) ** 2) / 0.02 - (y - 0.8) ** 2 / 0.1)


@pytest.mark.parametrize("sigma", [0.05, 0.2, 0.3])  # 2.5 to 15 pixels along y, 5 to 30 along x
def test_wide_averages_are_those_of_narrow_ones(sigma):
    x, y = PIXELS
    loaded = relief(*np.meshgrid(x, y))
    loaded[0] += 0.01  # beyond the border it goes on as there
    motion = np.stack([0.1 * loaded, loaded**2])
    smooth = Imprint(x, y, np.full_like(loaded, 0.5), loaded, motion).smoothed(sigma)
    widths = sigma / 0.02, sigma / 0.01
    expected = gaussian_filter(loaded, widths, mode="nearest")
    assert_allclose(smooth.loaded, expected, rtol=1e-13)
    assert_allclose(smooth.motion[1], gaussian_filter(motion[1], widths, mode="nearest"))
    assert np.all(smooth.unloaded == 0.5)


def test_beyond_the_border_there_may_be_nothing():
    loaded = relief(*np.meshgrid(*PIXELS))
    widths = 3.0, 40.0  # wider than a third of the map
    expected = gaussian_filter(loaded, widths, mode="constant")
    assert_allclose(gaussian_average(loaded, widths, "constant"), expected, rtol=1e-13)


def test_two_pixels_next_to_each_other_do_not_make_millions():
    even = np.linspace(0.0, 5.0, 101)
    x = np.sort(np.append(even, even[40] + 1e-7))
    fields = [
        xr.DataArray(relief(*np.meshgrid(at, even)), {"y": even, "x": at}, ("y", "x"))
        for at in (x, even)
    ]
    here, there = (
        imprint_of(loaded, 0.5 + 0 * loaded, None, 0.1, beyond=True) for loaded in fields
    )
    assert here.x.size < 5 * x.size
    assert np.ptp(np.diff(here.x)) < 1e-9
    points = np.meshgrid(np.linspace(0.0, 5.0, 50), np.linspace(0.0, 5.0, 50))
    height, expected = (imprint.evaluate(*points, 1.0)[0] for imprint in (here, there))
    # the finer pixels follow the straight lines between those of the map more closely
    assert_allclose(height, expected, atol=5e-4)
