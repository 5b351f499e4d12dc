import numpy as np
import pytest

from optical_palpation.errors import InputError
from optical_palpation.experiment.synthetic_oct import FWHM, Optics, SyntheticOCT, complex_pair

SPACING = (0.003, 0.01, 0.01)


def volume(thickness: float = 0.2, shape: tuple[int, int] = (24, 100), **given) -> SyntheticOCT:
    return SyntheticOCT(np.full(shape, thickness), SPACING, 256, **given)


def test_speckle_is_fully_developed_and_correlated_over_the_psf_alone():
    plain = volume(attenuation=1e-9, window_db=None, saturation_db=99.0, snr_db=40.0)
    intensity = np.stack(list(plain), axis=1).astype(float)[150:] ** 2
    assert intensity.std() / intensity.mean() == pytest.approx(1.0, abs=0.03)
    rest = intensity - intensity.mean()
    for axis, resolution in ((0, 5.5e-3), (1, 13e-3), (2, 13e-3)):
        n = rest.shape[axis]
        for lag in (1, 2, 4):
            a = np.take(rest, range(n - lag), axis) * np.take(rest, range(lag, n), axis)
            sigma = resolution / FWHM / SPACING[axis]
            expected = np.exp(-(lag**2) / (4.0 * sigma**2))
            assert a.mean() / rest.var() == pytest.approx(expected, abs=0.04)


@pytest.mark.parametrize("snr", [10.0, 20.0])
def test_signal_to_noise_ratio_and_depth_of_the_surface(snr):
    plain = volume(attenuation=1e-9, window_db=None, saturation_db=99.0, snr_db=snr)
    profile = np.mean([image**2.0 for image in plain], axis=(0, 2))
    noise, signal = profile[10:40].mean(), profile[150:240].mean()
    assert noise == pytest.approx(1.0, rel=0.02)
    assert signal - 1.0 == pytest.approx(10 ** (snr / 10), rel=0.05)
    level = (profile - noise) / (signal - noise)
    below = int(np.argmax(level > 0.5))
    middle = below - 1 + (0.5 - level[below - 1]) / (level[below] - level[below - 1])
    assert middle == pytest.approx(0.35 / SPACING[0], abs=0.3)


def test_attenuation_is_counted_both_ways():
    plain = volume(attenuation=3.0, window_db=None, saturation_db=99.0, snr_db=40.0)
    profile = np.mean([image**2.0 for image in plain], axis=(0, 2))
    depth = SPACING[0] * np.arange(256)
    slope = np.polyfit(depth[130:230], np.log(profile[130:230]), 1)[0]
    assert slope == pytest.approx(-6.0, rel=0.1)


def test_window_reflection_stands_at_its_depth_with_its_strength_and_tilt():
    tilted = volume(tilt=(0.0, 0.05), window_db=25.0, saturation_db=99.0, snr_db=30.0)
    image = tilted.bscan(5)
    for x in (10, 90):
        line = tilted.window_map[5, x] / SPACING[0]
        z = int(np.argmax(image[:, x]))
        assert abs(z - line) <= 0.5
        assert 20 * np.log10(image[z, x]) == pytest.approx(55.0, abs=1.5)
    assert tilted.window_map[0, -1] - tilted.window_map[0, 0] == pytest.approx(0.05 * 0.99)


def test_the_cut_of_the_spectrum_gives_a_reflection_side_lobes():
    def lobes(cut: float) -> float:
        given = Optics(spectral_window=cut)
        image = volume(optics=given, window_db=40.0, saturation_db=99.0).bscan(5)
        return float(np.median(image[56:62] ** 2))  # 6 to 12 pixels below the line

    assert lobes(2.0) > 20.0
    assert lobes(6.0) < 2.0


def test_shadow_saturation_ghost_and_clipping():
    light = np.ones((24, 100))
    light[:, 30:60] = 0.01
    plain = volume(transmission=light, saturated=0.1, ghosts=((0.1, 15.0),), window_db=40.0)
    stack = np.stack(list(plain), axis=1)
    assert stack.max() == pytest.approx(10 ** ((20 + 22) / 20))
    sample = (stack[125:140] ** 2).mean(axis=0)
    assert np.median(sample[:, 35:55]) < 0.1 * np.median(sample[:, 65:])
    noise = (stack[:30] ** 2).mean(axis=0)
    assert 0.05 < np.mean(noise > 5.0) < 0.15
    assert np.median(stack[round(0.25 / 0.003), :, 70:]) > 5 * np.median(stack[70, :, 70:])


def test_a_bscan_depends_on_seed_and_index_alone():
    forward, backward, other = volume(seed=3), volume(seed=3), volume(seed=4)
    np.testing.assert_array_equal(list(forward)[7], backward.bscan(7))
    assert np.abs(forward.bscan(7) - other.bscan(7)).mean() > 0.1


def test_phase_of_a_pair_is_four_pi_n_u_over_wavelength():
    u = np.broadcast_to(np.linspace(0.0, 3e-4, 200)[:, None, None], (200, 6, 60))
    before, after = complex_pair(u, spacing=SPACING)
    phase = np.unwrap(np.angle(np.sum(before * after.conj(), axis=(1, 2))))
    expected = 4 * np.pi * 1.4 * u[:, 0, 0] / 1.3e-3
    np.testing.assert_allclose(phase[5:-5], expected[5:-5], atol=0.05)


def test_strain_within_the_psf_decorrelates_the_pair():
    def coherence(strain: float) -> float:
        u = strain * SPACING[0] * np.broadcast_to(np.arange(200)[:, None, None], (200, 4, 40))
        before, after = complex_pair(u, spacing=SPACING, snr_db=60)
        part = slice(20, 60)
        cross = np.abs(np.sum(before[part] * after[part].conj(), axis=(1, 2)))
        power = np.sqrt(
            np.sum(np.abs(before[part]) ** 2, (1, 2)) * np.sum(np.abs(after[part]) ** 2, (1, 2))
        )
        return float(np.mean(cross / power))

    assert coherence(1e-4) > 0.99
    assert coherence(2e-2) < 0.97


def test_impossible_input_is_refused():
    with pytest.raises(InputError, match="deepest point"):
        volume(thickness=0.9)
    with pytest.raises(InputError, match="axial_resolution"):
        Optics(axial_resolution=0.0)
    with pytest.raises(InputError, match="no B-scan"):
        volume().bscan(24)
    with pytest.raises(InputError, match="displacement"):
        complex_pair(np.zeros((3, 3)), spacing=SPACING)
