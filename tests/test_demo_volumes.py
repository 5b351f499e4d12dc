import numpy as np
import pytest
import xarray as xr

from optical_palpation.experiment.demo_volumes import demo_volumes, experiment_volumes, write_volume
from optical_palpation.thickness import find_layer
from optical_palpation.volume import open_volume


def test_the_layer_is_pressed_everywhere_and_fits_its_volumes():
    volumes = demo_volumes()
    unloaded, loaded = (volumes[name].thickness for name in ("unloaded", "loaded"))
    assert 0.32 < loaded.min() < 0.34
    assert 0.45 < loaded.max() < 0.47
    assert np.abs(unloaded - 0.5).max() < 0.003
    for volume in volumes.values():
        nz, ny, nx = volume.shape
        assert [s * (n - 1) for s, n in zip(volume.spacing[1:], (ny, nx), strict=True)] == [5, 5]
        # Below its deepest point there is enough sample to see that it scatters.
        deepest = (volume.window_map + volume.thickness).max() / volume.spacing[0]
        assert deepest < nz - 40


def test_volumes_are_written_as_they_are_and_are_the_same_every_time(tmp_path):
    volume, again = (demo_volumes()["loaded"] for _ in range(2))
    small = type(volume)(volume.thickness[:6, :30], volume.spacing, volume.n_depth, seed=2)
    write_volume(small, tmp_path / "v.npy")
    spacing = dict(zip("zyx", small.spacing, strict=True))
    with open_volume(tmp_path / "v.npy", axes="yzx", spacing=spacing, scale="linear") as opened:
        assert opened.shape == small.shape
        np.testing.assert_array_equal(opened.bscan(4), small.bscan(4))
    np.testing.assert_array_equal(volume.bscan(100), again.bscan(100))
    assert volume.bscan(100).mean() == pytest.approx(again.bscan(101).mean(), rel=0.05)


def test_layer_of_an_experiment_is_found_again_in_its_volumes():
    x, y = np.linspace(-0.1, 1.1, 25), np.linspace(0.0, 1.0, 21)
    loaded = 0.4 + 0.05 * np.sin(3 * x) * np.cos(2 * y[:, None])
    loaded[:, 0] = np.nan  # no layer here
    maps = xr.Dataset(
        {
            "unloaded_thickness": (("y", "x"), np.full((21, 25), 0.5)),
            "loaded_thickness": (("y", "x"), loaded),
        },
        {"x": x, "y": y},
    )
    volumes = experiment_volumes(maps)
    for name, volume in volumes.items():
        found = find_layer(volume, spacing=volume.spacing, scale="linear").thickness
        truth = maps[f"{name}_thickness"].interp(x=found.x.values - 0.1, y=found.y.values)
        error = (found.values - truth.values)[:, 10:]
        assert np.sqrt(np.mean(error**2)) < 0.6 * volume.spacing[0]
    # the border goes on where there is no layer
    np.testing.assert_allclose(volumes["loaded"].thickness[0, 0], loaded[0, 1])
