import numpy as np
import pytest

from optical_palpation.experiment.demo_map import demo_thickness_map
from optical_palpation.thickness import clean_thickness


def test_the_map_is_the_same_every_time_and_noise_depends_on_the_seed():
    first, again, other = demo_thickness_map(), demo_thickness_map(), demo_thickness_map(seed=2)
    np.testing.assert_array_equal(first, again)
    difference = clean_thickness(first)["thickness"] - clean_thickness(other)["thickness"]
    # Two independent detection errors of 0.5 um each, outliers apart.
    middle = np.percentile(difference, [15.87, 84.13])
    assert np.ptp(middle) / 2 == pytest.approx(0.0005 * np.sqrt(2), rel=0.05)


def test_the_cleaned_map_is_a_layer_that_is_pressed_everywhere():
    cleaned = clean_thickness(demo_thickness_map())
    assert cleaned.attrs["missing_share"] == pytest.approx(0.002, rel=0.3)
    assert cleaned.attrs["spike_share"] == pytest.approx(0.0005, rel=0.5)
    assert 0.32 < float(cleaned["thickness"].min()) < 0.34
    assert 0.45 < float(cleaned["thickness"].max()) < 0.47
    assert float(cleaned["x"][-1]) == float(cleaned["y"][-1]) == 5.0
