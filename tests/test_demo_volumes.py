import numpy as np
import pytest

from optical_palpation.experiment.demo_volumes import demo_volumes, write_volume
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
