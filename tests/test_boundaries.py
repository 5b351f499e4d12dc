import json

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr

from optical_palpation.errors import InputError
from optical_palpation.experiment.synthetic_oct import FWHM, Optics, SyntheticOCT
from optical_palpation.thickness.boundaries import LayerFinder, find_layer
from optical_palpation.thickness.corrections import (
    Anchor,
    Corrections,
    Exclusion,
    read_corrections,
    write_corrections,
)
from optical_palpation.thickness.intensity import intensity_reader, point_spread
from optical_palpation.thickness.registration import lateral_shift, shift_map

SPACING = (0.0029, 0.01, 0.01)
SHAPE = (64, 96)
Y, X = np.meshgrid(*(0.01 * np.arange(n) for n in SHAPE), indexing="ij")
SMOOTH = 0.35 + 0.05 * np.sin(2 * np.pi * X / 0.9) + 0.02 * np.cos(2 * np.pi * Y / 0.5)


def volume(thickness=SMOOTH, **other) -> SyntheticOCT:
    return SyntheticOCT(thickness, SPACING, 280, **{"tilt": (0.02, 0.03), "snr_db": 20.0} | other)


def found(of: SyntheticOCT, **parameters) -> tuple[xr.Dataset, np.ndarray]:
    layer = find_layer(of, spacing=of.spacing, scale="linear", **parameters)
    return layer, (layer.thickness.values - of.thickness) / of.spacing[0]


def rms(a: np.ndarray) -> float:
    return float(np.sqrt(np.mean(a**2)))


@pytest.mark.parametrize(("snr", "limit"), [(30.0, 0.5), (20.0, 0.7), (10.0, 1.5)])
def test_thickness_to_a_fraction_of_a_pixel(snr, limit):
    layer, error = found(volume(snr_db=snr))
    assert rms(error) < limit
    assert abs(error.mean()) < (0.2 if snr == 20.0 else 0.4)
    assert layer.filled_share < 0.01
    assert float(layer.quality.min()) >= 0.0
    assert float(layer.quality.max()) <= 1.0
    np.testing.assert_allclose(layer.thickness, layer.sample_depth - layer.window_depth, atol=1e-12)
    assert layer.thickness.attrs["units"] == "mm"
    assert float(layer.x[1] - layer.x[0]) == pytest.approx(0.01)


@pytest.mark.parametrize("axial", [5.5e-3, 8e-3, 11e-3])
def test_the_tail_of_a_bright_step_is_not_taken_for_the_layer(axial):
    of = volume(snr_db=35.0, optics=Optics(axial, 2.0 * axial))
    bias = np.mean(found(of)[1]) * SPACING[0]
    assert abs(bias) < 0.12 * axial


@pytest.mark.parametrize("axial", [5.5e-3, 11e-3])
@pytest.mark.parametrize("brighter", [-3.0, 2.0, 12.0])
@pytest.mark.parametrize("snr", [12.0, 25.0])
def test_a_reflection_along_the_sample_does_not_shift_it(axial, brighter, snr):
    of = volume(snr_db=snr, interface_db=brighter, optics=Optics(axial, 2.0 * axial))
    layer, error = found(of)
    assert abs(np.mean(error)) * SPACING[0] < 0.2 * axial
    assert json.loads(layer.doubts) == []


def test_a_bright_upper_part_of_the_sample_is_no_reflection():
    """Its first 30 um scatter four times as much as what lies below."""
    lower, upper = volume(), volume(snr_db=25.0, attenuation=16.0, window_db=None, seed=1)
    stack = np.stack([np.abs(lower.field(y) + upper.field(y)) for y in range(SHAPE[0])], axis=1)
    layer = find_layer(stack, spacing=SPACING, scale="linear")
    assert abs(np.mean(layer.thickness.values - SMOOTH)) < 0.25 * SPACING[0]


def test_neither_ghosts_nor_saturated_columns_nor_a_bright_interface_mislead():
    troubled = volume(ghosts=((0.15, 5.0), (0.2, -5.0)), saturated=0.03, interface_db=0.0)
    assert rms(found(troubled)[1]) < 1.5


@pytest.mark.parametrize("saturated", [False, True])
def test_a_specular_spot_lowers_the_quality_and_is_flagged(saturated):
    of = volume()
    stack = np.stack(list(of), axis=1)
    plain = find_layer(stack, spacing=SPACING, scale="linear")
    assert plain.specular_share < 0.001
    top = np.round(plain.sample_depth.values / SPACING[0]).astype(int)
    glare = 30.0 * stack.max()
    if saturated:
        glare = stack.max()  # the detector shows no more, but for longer
    for y in range(28, 34):
        for x in range(50, 56):
            stack[top[y, x] - (9 if saturated else 5) : top[y, x] - 3, y, x] = glare
    layer = find_layer(stack, spacing=SPACING, scale="linear")
    error = np.abs(layer.sample_depth.values - plain.sample_depth.values) / SPACING[0]
    assert error.max() > 1.0
    # what it moves by more than a pixel is marked
    assert (layer.specular.values | layer.filled.values)[error > 1.0].all()
    assert layer.quality.values[28:34, 50:56].max() < 0.5 * plain.quality.values.min()
    far = np.ones(SHAPE, bool)
    far[19:43, 41:65] = False
    assert not layer.specular.values[far].any()


def test_saturated_ascans_lower_the_quality_where_they_are():
    """A saturated detector lifts the noise of whole A-scans: the boundary stands out less there."""
    stack = np.stack(list(volume()), axis=1)
    plain = find_layer(stack, spacing=SPACING, scale="linear")
    rng = np.random.default_rng(1)
    patch = (slice(26, 38), slice(48, 60))
    noise = stack[:20].mean() * 10 ** (22.0 / 20)
    shape = stack[:, *patch].shape
    lifted = stack[:, *patch] + noise * np.abs(
        rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    ).astype(stack.dtype)
    stack[:, *patch] = np.minimum(lifted, stack.max())
    layer = find_layer(stack, spacing=SPACING, scale="linear")
    inside = (slice(29, 35), slice(51, 57))
    assert layer.quality.values[inside].max() < 0.8 * plain.quality.values[inside].min()
    far = np.ones(SHAPE, bool)
    far[16:48, 38:70] = False
    np.testing.assert_allclose(layer.quality.values[far], plain.quality.values[far], atol=0.05)
    error = np.abs(layer.thickness.values - plain.thickness.values) / SPACING[0]
    assert rms(error[far]) < 0.3


def test_a_shadow_is_filled_and_says_so():
    light = np.ones(SHAPE)
    light[16:44, 34:62] = 1e-4
    layer, error = found(volume(transmission=light))
    assert layer.filled.values[26:34, 44:52].all()
    assert (layer.quality.values[layer.filled.values] == 0).all()
    assert np.abs(error).max() < 12.0
    far = np.ones(SHAPE, bool)
    far[8:52, 26:70] = False
    assert not layer.filled.values[far].any()
    assert rms(error[far]) < 0.6


def test_where_the_layer_hangs_free_the_sample_is_found():
    gap = np.where(X > 0.7, 0.06, 0.0)
    free = volume(gap=gap, interface_db=5.0)
    layer, _ = found(free)
    error = (layer.thickness.values - free.thickness - gap)[:, :60] / SPACING[0]
    assert rms(error) < 0.7
    beyond = (layer.thickness.values - free.thickness - gap)[:, 80:] / SPACING[0]
    assert rms(beyond) < 0.7  # there the sample's face does not reflect


def test_result_follows_the_mirror_image():
    of = volume()
    stack = np.stack(list(of), axis=1)
    given = {"spacing": SPACING, "scale": "linear"}
    plain = find_layer(stack, **given).thickness.values
    mirrored = find_layer(np.ascontiguousarray(stack[:, ::-1, ::-1]), **given).thickness.values
    assert rms((plain - mirrored[::-1, ::-1]) / SPACING[0]) < 0.1


def test_amplitude_intensity_and_decibels_give_the_same_layer():
    stack = np.stack(list(volume()), axis=1)
    maps = [
        find_layer(data, spacing=SPACING, scale=scale).thickness.values
        for data, scale in (
            (stack, "linear"),
            (stack**2, "linear"),
            (20 * np.log10(stack), "dB"),
            (1000 * np.log(stack) + 9000, "dB"),  # logarithm in a unit of its own
        )
    ]
    for other in maps[1:3]:
        assert rms((other - maps[0]) / SPACING[0]) < 0.1
    assert rms((maps[3] - maps[0]) / SPACING[0]) < 0.3


@pytest.mark.parametrize(("above", "below"), [(60, 0), (0, 300)])
def test_padding_without_data_is_no_layer(above, below):
    stack = np.stack(list(volume()), axis=1)
    padded = np.pad(stack, [(above, below), (0, 0), (0, 0)])
    layer = find_layer(padded, spacing=SPACING, scale="linear")
    error = (layer.thickness.values - SMOOTH) / SPACING[0]
    assert rms(error) < 0.7
    assert abs(error.mean()) < 0.2  # an amplitude is still known to be one
    assert float(layer.window_depth.min()) > above * SPACING[0]


def test_eight_bits_are_an_amplitude_as_well():
    stack = np.stack(list(volume()), axis=1)
    stored = (255 * stack / stack.max()).astype(np.uint8)  # of noise three steps are left
    layer = find_layer(stored, spacing=SPACING, scale="linear")
    assert abs(np.mean(layer.thickness.values - SMOOTH)) < 0.2 * SPACING[0]


@pytest.mark.parametrize("gain", [2.0**-60, 2.0**40])
def test_the_unit_of_the_signal_does_not_matter(gain):
    stack = np.stack(list(volume()), axis=1)
    plain = find_layer(stack, spacing=SPACING, scale="linear")
    assert find_layer(stack * np.float32(gain), spacing=SPACING, scale="linear").equals(plain)


def test_resolution_is_that_of_a_sample_at_the_end_of_the_volume_too():
    """A layer that fills the depth: the speckle lies in the last pixels, the tile's remainder."""
    flat = np.full(SHAPE, 0.35)
    of = SyntheticOCT(flat, SPACING, 190, tilt=(0.02, 0.03))
    layer, error = found(of)
    assert layer.axial_resolution_mm == pytest.approx(of.optics.axial_resolution, rel=0.15)
    assert abs(error.mean()) < 0.3


@pytest.mark.parametrize("nothing", [None, 0.0, np.nan])
def test_where_the_sample_lies_beyond_the_data_it_is_not_seen(nothing):
    thickness = 0.35 + 0.1 * np.sin(2 * np.pi * X / 0.9)
    of = SyntheticOCT(thickness, SPACING, 300, tilt=(0.02, 0.03))
    stack = np.stack(list(of), axis=1)
    if nothing is None:
        stack = stack[:200].copy()
    else:
        stack[200:] = nothing
    layer = find_layer(stack, spacing=SPACING, scale="linear")
    beyond = (of.window_map + thickness) / SPACING[0] > 200
    assert layer.sample_filled.values[beyond].all()
    error = np.abs(layer.thickness.values - thickness) / SPACING[0]
    assert error[~layer.filled.values].max() < 3.0
    assert 0.1 < layer.filled_share < 0.4


def test_ascans_without_data_are_filled():
    stack = np.stack(list(volume()), axis=1)
    stack[:, :, :24] = np.nan
    stack[:, 20:24, :] = 0.0
    layer = find_layer(stack, spacing=SPACING, scale="linear")
    assert layer.window_filled.values[:, :24].all()
    assert layer.sample_filled.values[20:24].all()
    assert not layer.filled.values[26:, 26:].any()
    error = np.abs(layer.thickness.values - SMOOTH) / SPACING[0]
    assert error[~layer.filled.values].max() < 3.0


@pytest.mark.parametrize("rows", [(20, 80), (60, 110), (100, 170), (180, 300)])
@pytest.mark.parametrize("columns", [slice(16, 44), slice(0, 24)])
def test_the_end_of_a_gap_is_no_boundary(rows, columns):
    """What is missing of a part of the depth is filled where the boundary may lie in it."""
    of = volume()
    stack = np.stack(list(of), axis=1)
    stack[slice(*rows), 12:40, columns] = np.nan
    layer = find_layer(stack, spacing=SPACING, scale="linear")
    error = np.abs(layer.thickness.values - SMOOTH) / SPACING[0]
    assert error[~layer.filled.values].max() < 3.0
    hidden = np.zeros(error.shape, bool)
    hidden[12:40, columns] = True
    bottom = (of.window_map + SMOOTH) / SPACING[0]
    within = hidden & (bottom > rows[0] + 5) & (bottom < rows[1] - 5)
    assert layer.sample_filled.values[within].all()
    assert not layer.filled.values[46:, 50:].any()


def test_no_sample_side_is_found_within_the_resolution_of_the_window():
    thin = np.full(SHAPE, 0.025)
    with pytest.raises(InputError, match="sample side of the layer is nowhere"):
        found(volume(thin))
    upside_down = np.stack(list(volume()), axis=1)[::-1].copy()
    for edge in ("rise", "fall"):
        with pytest.raises(InputError, match="sample side of the layer is nowhere"):
            find_layer(upside_down, spacing=SPACING, scale="linear", sample=edge)
    dip = 0.25 - 0.24 * np.exp(-((X - 0.48) ** 2 + (Y - 0.32) ** 2) / 0.15**2)
    layer, error = found(volume(dip))
    assert float(layer.thickness.min()) > 0
    assert layer.sample_filled.values[dip < 0.02].all()
    assert np.abs(error[~(layer.filled | layer.specular).values]).max() < 3.0


def test_single_bscan_and_known_window():
    of = volume()
    image = of.bscan(20)[:, None, :]
    layer = find_layer(image, spacing=(0.0029, np.nan, 0.01), scale="linear")
    assert layer.thickness.shape == (1, 96)
    assert rms((layer.thickness.values[0] - SMOOTH[20]) / SPACING[0]) < 1.5
    given = find_layer(image, spacing=SPACING, scale="linear", window=0.1)
    assert np.all(given.window_depth == 0.1)
    assert np.allclose(given.sample_depth, layer.sample_depth, atol=3 * SPACING[0])


@pytest.mark.parametrize("factor", [40.0, 0.1])
def test_other_modalities_are_a_matter_of_scale(factor):
    """Ultrasound-like and confocal-like pixels: the same numbers of pixels, other millimetres."""
    optics = Optics(5.5e-3 * factor, 13e-3 * factor)
    spacing = tuple(factor * s for s in SPACING)
    of = SyntheticOCT(
        factor * SMOOTH,
        spacing,
        280,
        window_depth=0.15 * factor,
        optics=optics,
        attenuation=4 / factor,
    )
    assert rms(found(of)[1]) < 0.7


def test_canny_finds_a_clean_layer_and_the_tracked_surface_is_better():
    clean = volume(snr_db=30.0)
    canny, canny_error = found(clean, method="canny")
    assert rms(canny_error) < 4.0
    assert rms(found(clean)[1]) < rms(canny_error)
    assert canny.attrs["method"] == "canny"


def test_anchor_leads_the_surface_and_exclusion_leaves_it_out(tmp_path):
    # A scattering film in the layer looks more like its sample side than the sample does.
    of = volume()
    stack = np.stack(list(of), axis=1)
    rows = slice(100, 130)
    stack[rows] += 30 * np.abs(np.random.default_rng(0).standard_normal(stack[rows].shape))
    wrong = find_layer(stack, spacing=SPACING, scale="linear")
    assert abs(np.median(wrong.sample_depth) / SPACING[0] - 100) < 4
    points = [(y, x) for y in range(2, 64, 8) for x in range(2, 96, 8)]
    depth = of.window_map + SMOOTH
    text = "".join(f"anchor sample {0.01 * x} {0.01 * y} {depth[y, x]}\n" for y, x in points)
    path = tmp_path / "corrections.txt"
    path.write_text(f"# by hand\n{text}exclude sample 0.30 0.50 0.20 0.40  # dirt\n")
    right = find_layer(stack, spacing=SPACING, scale="linear", corrections=path)
    assert np.median(np.abs(right.sample_depth.values - depth)) / SPACING[0] < 3
    assert right.filled.values[20:41, 30:51].all()
    assert right.sample_filled.values[20:41, 30:51].all()
    assert not right.window_filled.values[20:41, 30:51].any()
    assert right.filled.equals(right.window_filled | right.sample_filled)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("anchor top 1 2 3", "window or sample"),
        ("anchor sample 1 2", "takes 3 numbers"),
        ("anchor sample 1 2 nan", "takes 3 numbers"),
        ("\nexclude window 1 0 0 1", "line 2"),
        ("move sample 1", "anchor or exclude"),
    ],
)
def test_corrections_that_cannot_be_understood(tmp_path, text, said):
    path = tmp_path / "c.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_corrections(path)


def test_corrections_in_pixels():
    fixes = Corrections((Anchor("window", 2.0, 3.0, 4.0),), (Exclusion("sample", 1, 2, 0, 1),))
    assert fixes.anchor_pixels("window", (1.0, 0.0, 0.0), (0.5, 1.0, 2.0)) == [(3.0, 1.0, 6.0)]
    assert fixes.anchor_pixels("sample", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)) == []
    mask = fixes.excluded_pixels("sample", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (3, 4))
    assert mask.tolist() == [[False, True, True, False]] * 2 + [[False] * 4]


NUMBERS = st.floats(-100, 100)
SIDES = st.sampled_from(["window", "sample"])
RANGES = st.tuples(NUMBERS, NUMBERS).map(sorted)


@given(
    anchors=st.lists(st.builds(Anchor, SIDES, NUMBERS, NUMBERS, NUMBERS)),
    exclusions=st.lists(
        st.builds(lambda side, x, y: Exclusion(side, *x, *y), SIDES, RANGES, RANGES)
    ),
)
def test_corrections_come_back_from_a_file_to_the_last_digit(tmp_path, anchors, exclusions):
    corrections = Corrections(tuple(anchors), tuple(exclusions))
    write_corrections(corrections, tmp_path / "c.txt")
    assert read_corrections(tmp_path / "c.txt") == corrections


class Counted:
    """A volume that counts how often its B-scans are read."""

    def __init__(self, of: SyntheticOCT) -> None:
        self._stack = np.stack(list(of), axis=1)
        self.shape, self.reads = self._stack.shape, 0

    def bscan(self, y: int) -> np.ndarray:
        self.reads += 1
        return self._stack[:, y]


def test_a_correction_finds_anew_what_it_changes_and_the_same_as_from_scratch():
    of = volume()
    stack = Counted(of)
    finder = LayerFinder(stack, spacing=SPACING, scale="linear")
    depth = of.window_map + SMOOTH
    sample = Anchor("sample", 0.4, 0.3, float(depth[30, 40]) - 0.02)
    hidden = Exclusion("sample", 0.6, 0.8, 0.1, 0.3)
    window = Anchor("window", 0.2, 0.2, float(of.window_map[20, 20]) + 0.02)
    before = xr.Dataset()
    for fixes, reads_again in (
        (Corrections(), True),
        (Corrections((sample,)), True),
        (Corrections((sample,), (hidden,)), True),
        (Corrections((sample,), (hidden,)), False),
        (Corrections((sample, window), (hidden,)), True),
        (Corrections(), True),
    ):
        stack.reads = 0
        now = finder.find(fixes)
        assert stack.reads == (SHAPE[0] if reads_again else 0)
        scratch = find_layer(stack, spacing=SPACING, scale="linear", corrections=fixes)
        assert now.identical(scratch)
        if fixes.exclusions and window not in fixes.anchors:
            assert now["window_depth"].equals(before["window_depth"])
        before = now


def test_a_correction_outside_the_volume_leaves_the_finder_as_it_was():
    of = volume()
    finder = LayerFinder(of, spacing=SPACING, scale="linear")
    before = finder.find()
    with pytest.raises(InputError, match="outside the volume"):
        finder.find(Corrections((Anchor("sample", 99.0, 0.0, 0.1),)))
    assert finder.find().identical(before)


def with_dim_cap() -> np.ndarray:
    """A sample whose first 60 um scatter a hundred times less than what lies below."""
    dim, bright = volume(snr_db=8.0), volume(SMOOTH + 0.06, snr_db=28.0, window_db=None, seed=1)
    return np.hypot(*(np.stack(list(of), axis=1) for of in (dim, bright)))


def test_what_else_may_be_a_boundary_is_told():
    stack = np.stack(list(volume()), axis=1)
    line = stack.copy()
    line[19:22] = stack.max()  # of the instrument, at a fixed depth
    for data, search, texts in (
        (line, {}, ["line nearly as bright as the window's lies about 0.09"]),
        (line, {"window_range": (0.1, 0.2)}, []),
        (with_dim_cap(), {}, ["scattering from about 0.06"]),
        (stack, {}, []),
    ):
        layer = find_layer(data, spacing=SPACING, scale="linear", **search)
        doubts = json.loads(layer.doubts)
        assert len(doubts) == len(texts)
        assert all(text in doubt for text, doubt in zip(texts, doubts, strict=True))
        assert (rms(layer.thickness.values - SMOOTH) > 5 * SPACING[0]) == bool(texts)


@pytest.mark.parametrize(
    "other",
    [
        {"layer_db": -12.0},  # haze in the layer
        {"ghosts": ((0.15, 5.0), (0.2, -5.0)), "saturated": 0.03, "interface_db": 0.0},
        {"gap": np.where(X > 0.7, 0.06, 0.0), "interface_db": 5.0},
        {"snr_db": 3.0, "window_db": 40.0},
        {"thickness": 0.35 + 0.1 * np.sin(2 * np.pi * X / 0.6)},  # a slope of 1
    ],
)
def test_there_is_no_doubt_about_a_layer_that_is_found(other):
    assert json.loads(found(volume(**other))[0].doubts) == []


def test_noise_holds_no_layer():
    noise = np.abs(np.random.default_rng(1).standard_normal((200, 16, 32))).astype(np.float32)
    with pytest.raises(InputError, match="nowhere to be seen"):
        find_layer(noise, spacing=SPACING, scale="linear")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"spacing": None}, "spacing"),
        ({"scale": None}, "scale"),
        ({"scale": "log"}, "scale"),
        ({"spacing": (0.0, 1.0, 1.0)}, "positive"),
        ({"window": "edge"}, "window: 'line'"),
        ({"window": np.nan}, "depth in mm"),
        ({"method": "guess"}, "method"),
        ({"sample_range": (0.5, 0.1)}, "search range"),
        ({"corrections": "missing.txt"}, "cannot be read"),
    ],
)
def test_input_that_cannot_be_used(given, said):
    stack = np.stack([volume().bscan(0)] * 2, axis=1)
    with pytest.raises(InputError, match=said):
        find_layer(stack, **{"spacing": SPACING, "scale": "linear"} | given)


@pytest.mark.parametrize(
    ("samples", "said"),
    [
        (np.full((64, 4, 32), np.nan), "finite data"),
        (np.zeros((64, 4, 32)), "holds no data|finite data"),
        (np.random.default_rng(1).standard_normal((64, 4, 32)), "are negative"),
        (np.ones((64, 32, 1)), "too small for a layer"),
    ],
)
def test_volume_without_data_is_refused(samples, said):
    with pytest.raises(InputError, match=said):
        find_layer(samples, spacing=SPACING, scale="linear")


def test_a_background_may_be_subtracted():
    stack = np.stack(list(volume()), axis=1)
    with_it, without = (
        find_layer(samples, spacing=SPACING, scale="linear").thickness
        for samples in (stack, stack - np.median(stack))  # then half of the samples are negative
    )
    assert rms(without - with_it) < SPACING[0]


def test_resolution_is_read_off_the_speckle():
    for axial in (6e-3, 12e-3):
        of = volume(optics=Optics(axial, 2.5 * axial), saturated=0.02)
        along_z, along_x, speckled = point_spread(intensity_reader(of, "linear"), SHAPE[0])
        assert speckled
        assert along_z == pytest.approx(axial / FWHM / SPACING[0], rel=0.15)
        assert along_x == pytest.approx(2.5 * axial / FWHM / SPACING[2], rel=0.3)


def test_maps_that_begin_elsewhere_are_registered_by_their_coordinates():
    def features(begin_y, begin_x):
        y, x = begin_y + 0.02 * np.arange(60), begin_x + 0.02 * np.arange(70)
        one = np.exp(-((x - 0.9) ** 2 + (y[:, None] - 0.5) ** 2) / 0.02)
        other = np.exp(-((x - 0.4) ** 2 + (y[:, None] - 0.8) ** 2) / 0.01)
        return xr.DataArray(one + other, {"y": y, "x": x}, ("y", "x"))

    reference, moving = features(0.0, 0.0), features(-0.1, 0.06)
    assert lateral_shift(reference, moving) == pytest.approx((0.0, 0.0), abs=0.002)


def test_maps_are_registered_to_each_other():
    def features(dy: float, dx: float) -> xr.DataArray:
        values = np.sin(9 * (X - dx)) * np.cos(7 * (Y - dy)) + np.exp(
            -((X - dx - 0.5) ** 2 + (Y - dy - 0.3) ** 2) / 0.005
        )
        tilted = values + 5.0 * X
        return xr.DataArray(tilted, {"y": Y[:, 0], "x": X[0]}, ("y", "x"))

    reference, moving = features(0.0, 0.0), features(0.03, -0.052)
    shift = lateral_shift(reference, moving)
    assert shift == pytest.approx((0.03, -0.052), abs=0.01)
    elsewhere = moving.assign_coords(y=moving.y + 0.2, x=moving.x - 0.1)
    assert lateral_shift(reference, elsewhere) == pytest.approx((0.23, -0.152), abs=0.01)
    inner = (slice(10, -10), slice(10, -10))
    plane = 5.0 * 0.052  # the tilt travels along and is not a feature
    back = shift_map(moving, shift).values[inner]
    assert np.std(back - reference.values[inner]) < 0.1 * np.std(
        moving.values[inner] - reference.values[inner]
    )
    assert np.mean(back - reference.values[inner]) == pytest.approx(-plane, abs=0.05)
    assert np.isnan(shift_map(moving, (0.03, 0.0)).values[-1]).all()
    with pytest.raises(InputError, match="features"):
        lateral_shift(reference * 0 + X, moving)


def frames(count: int, static: bool, snr_db: float = 25.0) -> np.ndarray:
    """Intensity averaged over frames of the same speckle, or each of its own, `[z, y, x]`."""
    rng = np.random.default_rng(5)
    shape = (280, 32, 64)
    total = np.zeros(shape)
    for k in range(count):
        if k == 0 or not static:
            of = SyntheticOCT(SMOOTH[:32, :64], SPACING, 280, snr_db=snr_db + 60, seed=k)
            quiet = np.stack([of.field(y) for y in range(32)], axis=1) / 1e3
        noise = rng.standard_normal((2, *shape)) * np.sqrt(0.5)
        total += np.abs(quiet + noise[0] + 1j * noise[1]) ** 2
    return total / count


def bias(stack: np.ndarray, scale: str) -> tuple[float, list[str]]:
    """Mean error, pixels, and doubts."""
    layer = find_layer(stack.astype(np.float32), spacing=SPACING, scale=scale)
    error = (layer.thickness.values - SMOOTH[:32, :64]) / SPACING[0]
    return float(error.mean()), json.loads(layer.doubts)


@pytest.mark.parametrize(("count", "static"), [(2, True), (4, True), (16, True), (4, False)])
def test_averaged_frames_are_known_for_what_they_are(count, static):
    """Averaging smooths noise, and speckle if it changes, but not the shape of what is left."""
    stack = frames(count, static)
    for samples, scale in (
        (stack, "linear"),
        (np.sqrt(stack), "linear"),
        (10 * np.log10(stack), "dB"),
    ):
        off, doubts = bias(samples, scale)
        assert abs(off) < 0.2
        assert not any("scale" in doubt for doubt in doubts)
        assert doubts == [] or not static


def test_averaged_speckle_leaves_the_resolution_to_the_window():
    off, doubts = bias(frames(16, static=False), "linear")
    assert abs(off) < 0.35
    assert "does not show in the sample's speckle" in doubts[0]


@pytest.mark.parametrize("offset", [1.0, 5.0])
def test_an_offset_leaves_an_intensity_what_it_is(offset):
    off, doubts = bias(frames(1, static=True) + offset, "linear")
    assert abs(off) < 0.2
    assert doubts == []


@pytest.mark.parametrize("frame_count", [1, 16])
@pytest.mark.parametrize("black", [-20.0, 0.0, 3.0, 6.0])
def test_eight_bits_of_a_logarithm_may_hide_the_noise(frame_count, black):
    decibels = 10 * np.log10(frames(frame_count, static=True))
    stored = np.clip((decibels - black) / (45.0 - black) * 255, 0, 255).astype(np.uint8)
    off, doubts = bias(stored, "dB")
    assert abs(off) < 0.25
    assert doubts == []


def test_a_logarithm_that_is_no_decibels_is_doubted():
    assert "units of 1 dB" in bias(np.log(frames(16, static=True)), "dB")[1][0]
    assert "skewed as linear ones" in str(intensity_reader(volume(), "dB").doubt)
    decibels = 10 * np.log10(frames(4, static=True)) + 60
    assert "skewed as a logarithm" in bias(decibels, "linear")[1][0]


def test_a_stated_scale_is_not_judged():
    stack = frames(1, static=True)
    for samples, scale in ((stack, "intensity"), (np.sqrt(stack), "amplitude")):
        off, doubts = bias(samples, scale)
        assert abs(off) < 0.2
        assert doubts == []
    assert abs(bias(np.sqrt(stack), "intensity")[0]) > 0.3


@pytest.mark.parametrize("power", [1, 2])
def test_a_sample_without_speckle_is_found_and_doubted(power):
    """A smooth bright edge: the window's reflection tells the resolution."""
    rng = np.random.default_rng(3)
    sigma, truth = 5.5e-3 / FWHM, SMOOTH[:32, :64]
    z = SPACING[0] * np.arange(280)[:, None, None]
    below = z - 0.15 - truth
    edge = np.sqrt(10**2.5 * ndtr(below / sigma) * np.exp(-8.0 * np.maximum(below, 0.0)))
    line = np.sqrt(10**5.0) * np.exp(-((z - 0.15) ** 2) / (4 * sigma**2))
    noise = rng.standard_normal((2, *edge.shape)) * np.sqrt(0.5)
    off, doubts = bias(np.abs(edge + 1j * line + noise[0] + 1j * noise[1]) ** power, "linear")
    assert abs(off) < 0.5
    assert "does not show in the sample's speckle" in doubts[0]


def test_a_volume_that_shows_only_black_says_so():
    stack = np.zeros((280, 8, 64), np.uint8)
    stack[50] = 255
    with pytest.raises(InputError, match="most are 0"):
        find_layer(stack, spacing=SPACING, scale="dB")


def test_an_intensity_less_its_background_is_one_too():
    stack = frames(1, static=True, snr_db=15.0)
    off, doubts = bias(stack - 1.0, "linear")
    assert abs(off) < 0.2
    assert doubts == []
