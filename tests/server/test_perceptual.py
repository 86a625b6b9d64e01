"""What a person would see of a repaint: SSIM, CIEDE2000 and total variation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trompe_server.attack.perceptual import (
    ciede2000,
    lab,
    object_pixels,
    perceived_change,
    ssim_map,
    total_variation,
)

RANDOM = np.random.default_rng(7)
SHARMA = np.array(
    [
        # L*a*b* of both colours and their published difference: Sharma, Wu, Dalal (2005), table 1
        (50.0000, 2.6772, -79.7751, 50.0000, 0.0000, -82.7485, 2.0425),
        (50.0000, 3.1571, -77.2803, 50.0000, 0.0000, -82.7485, 2.8615),
        (50.0000, 2.8361, -74.0200, 50.0000, 0.0000, -82.7485, 3.4412),
        (50.0000, -1.3802, -84.2814, 50.0000, 0.0000, -82.7485, 1.0000),
        (50.0000, -1.1848, -84.8006, 50.0000, 0.0000, -82.7485, 1.0000),
        (50.0000, -0.9009, -85.5211, 50.0000, 0.0000, -82.7485, 1.0000),
        (50.0000, 0.0000, 0.0000, 50.0000, -1.0000, 2.0000, 2.3669),
        (50.0000, -1.0000, 2.0000, 50.0000, 0.0000, 0.0000, 2.3669),
        (50.0000, 2.4900, -0.0010, 50.0000, -2.4900, 0.0009, 7.1792),
        (50.0000, 2.4900, -0.0010, 50.0000, -2.4900, 0.0010, 7.1792),
        (50.0000, 2.4900, -0.0010, 50.0000, -2.4900, 0.0011, 7.2195),
        (50.0000, 2.4900, -0.0010, 50.0000, -2.4900, 0.0012, 7.2195),
        (50.0000, -0.0010, 2.4900, 50.0000, 0.0009, -2.4900, 4.8045),
        (50.0000, -0.0010, 2.4900, 50.0000, 0.0010, -2.4900, 4.8045),
        (50.0000, -0.0010, 2.4900, 50.0000, 0.0011, -2.4900, 4.7461),
        (50.0000, 2.5000, 0.0000, 50.0000, 0.0000, -2.5000, 4.3065),
        (50.0000, 2.5000, 0.0000, 73.0000, 25.0000, -18.0000, 27.1492),
        (50.0000, 2.5000, 0.0000, 61.0000, -5.0000, 29.0000, 22.8977),
        (50.0000, 2.5000, 0.0000, 56.0000, -27.0000, -3.0000, 31.9030),
        (50.0000, 2.5000, 0.0000, 58.0000, 24.0000, 15.0000, 19.4535),
        (50.0000, 2.5000, 0.0000, 50.0000, 3.1736, 0.5854, 1.0000),
        (50.0000, 2.5000, 0.0000, 50.0000, 3.2972, 0.0000, 1.0000),
        (50.0000, 2.5000, 0.0000, 50.0000, 1.8634, 0.5757, 1.0000),
        (50.0000, 2.5000, 0.0000, 50.0000, 3.2592, 0.3350, 1.0000),
        (60.2574, -34.0099, 36.2677, 60.4626, -34.1751, 39.4387, 1.2644),
        (63.0109, -31.0961, -5.8663, 62.8187, -29.7946, -4.0864, 1.2630),
        (61.2901, 3.7196, -5.3901, 61.4292, 2.2480, -4.9620, 1.8731),
        (35.0831, -44.1164, 3.7933, 35.0232, -40.0716, 1.5901, 1.8645),
        (22.7233, 20.0904, -46.6940, 23.0331, 14.9730, -42.5619, 2.0373),
        (36.4612, 47.8580, 18.3852, 36.2715, 50.5065, 21.2231, 1.4146),
        (90.8027, -2.0831, 1.4410, 91.1528, -1.6435, 0.0447, 1.4441),
        (90.9257, -0.5406, -0.9208, 88.6381, -0.8985, -0.7239, 1.5381),
        (6.7747, -0.2908, -2.4247, 5.8714, -0.0985, -2.2286, 0.6377),
        (2.0776, 0.0795, -1.1350, 0.9033, -0.0636, -0.5514, 0.9082),
    ]
)

bytes_ = st.integers(0, 255)
colours = st.tuples(bytes_, bytes_, bytes_)


# Colour difference


def test_colour_differences_are_the_published_ones_in_both_directions() -> None:
    first, second, published = SHARMA[:, :3], SHARMA[:, 3:6], SHARMA[:, 6]
    assert len(SHARMA) == 34
    np.testing.assert_allclose(ciede2000(first, second), published, atol=5.1e-5)
    np.testing.assert_allclose(ciede2000(second, first), published, atol=5.1e-5)


@given(colours, colours)
def test_a_colour_differs_from_itself_by_nothing_and_from_others_by_something(
    a: tuple[int, ...], b: tuple[int, ...]
) -> None:
    difference = ciede2000(lab(np.array(a, np.uint8)), lab(np.array(b, np.uint8)))
    assert (difference == 0) == (a == b)


def test_black_and_white_are_100_apart() -> None:
    assert ciede2000(lab(np.zeros(3, np.uint8)), lab(np.full(3, 255, np.uint8))) == pytest.approx(100, abs=1e-6)


@pytest.mark.parametrize(
    ("colour", "expected"),
    [
        pytest.param((255, 255, 255), (100, 0, 0), id="white"),
        pytest.param((0, 0, 0), (0, 0, 0), id="black"),
        pytest.param((255, 0, 0), (53.24, 80.09, 67.20), id="red"),
        pytest.param((0, 255, 0), (87.73, -86.18, 83.18), id="green"),
        pytest.param((0, 0, 255), (32.30, 79.19, -107.86), id="blue"),
        pytest.param((10, 10, 10), (2.74, 0, 0), id="the straight piece near black"),
    ],
)
def test_srgb_has_its_known_lab_values(colour: tuple[int, ...], expected: tuple[float, ...]) -> None:
    np.testing.assert_allclose(lab(np.array(colour, np.uint8)), expected, atol=0.01)


# Structural similarity


def slow_ssim(a: np.ndarray, b: np.ndarray, row: int, column: int) -> float:
    """Wang's formula at one pixel, window by window."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    window /= window.sum()
    x, y = (image[row - 5 : row + 6, column - 5 : column + 6].astype(np.float64) for image in (a, b))
    mean_x, mean_y = (window * x).sum(), (window * y).sum()
    var_x, var_y = (window * (x - mean_x) ** 2).sum(), (window * (y - mean_y) ** 2).sum()
    both = (window * (x - mean_x) * (y - mean_y)).sum()
    return float(
        (2 * mean_x * mean_y + 0.01**2)
        * (2 * both + 0.03**2)
        / ((mean_x**2 + mean_y**2 + 0.01**2) * (var_x + var_y + 0.03**2))
    )


def test_similarity_is_wangs_formula() -> None:
    a, b = RANDOM.random((2, 24, 30)).astype(np.float32)
    found = ssim_map(a, 0.7 * a + 0.3 * b)
    for row, column in ((5, 5), (12, 20), (18, 24)):
        assert found[row, column] == pytest.approx(slow_ssim(a, 0.7 * a + 0.3 * b, row, column), abs=1e-5)


def test_the_border_goes_on_as_its_mirror_image() -> None:
    a, b = RANDOM.random((2, 20, 20)).astype(np.float32)
    wide = [np.pad(image, 8, mode="symmetric") for image in (a, b)]
    np.testing.assert_allclose(ssim_map(*wide)[8:-8, 8:-8], ssim_map(a, b), atol=1e-5)


def test_two_greys_are_similar_by_luminance_alone() -> None:
    dark, light = np.full((16, 16), 0.2, np.float32), np.full((16, 16), 0.6, np.float32)
    expected = (2 * 0.2 * 0.6 + 1e-4) / (0.2**2 + 0.6**2 + 1e-4)
    np.testing.assert_allclose(ssim_map(dark, light), expected, rtol=1e-3)


def test_images_smaller_than_a_window_can_be_compared() -> None:
    a, b = RANDOM.random((2, 3, 2)).astype(np.float32)
    assert ssim_map(a, a) == pytest.approx(np.ones((3, 2)), abs=1e-5)
    assert (ssim_map(a, b) < 1).all()


# Views


def noise(level: int, *, views: int = 3) -> tuple[np.ndarray, np.ndarray]:
    before = RANDOM.integers(60, 190, (views, 24, 28, 3)).astype(np.uint8)
    change = RANDOM.choice([-level, level], before.shape)
    return before, (before + change).astype(np.uint8)


def test_what_did_not_change_is_perfect() -> None:
    before, _ = noise(0)
    found = perceived_change(before, before, np.ones(before.shape[:3], bool))
    assert found is not None
    assert (found.delta_e, found.delta_e_95) == (0, 0)
    assert (found.ssim, found.ssim_worst) == pytest.approx((1, 1), abs=1e-5)


def test_a_larger_change_is_seen_more() -> None:
    found = [perceived_change(*noise(level), np.ones((3, 24, 28), bool)) for level in (2, 8, 30)]
    similar, different = zip(*((one.ssim, one.delta_e) for one in found if one is not None), strict=True)
    assert similar[0] > similar[1] > similar[2]
    assert different[0] < different[1] < different[2]


def test_only_the_pixels_of_the_object_are_compared() -> None:
    before, after = noise(20)
    pixels = np.zeros(before.shape[:3], bool)
    pixels[:, :, :10] = True
    outside = after.copy()
    outside[:, :, 15:] = 255 - outside[:, :, 15:]
    assert perceived_change(before, after, pixels) == perceived_change(before, outside, pixels)


def test_figures_are_those_of_the_whole_map_and_of_every_pixel() -> None:
    before, after = noise(12, views=2)
    pixels = RANDOM.random((2, 24, 28)) < 0.3
    found = perceived_change(before, after, pixels)
    assert found is not None
    grey = [image @ np.array([0.299, 0.587, 0.114]) / 255 for image in (before, after)]
    similar = [ssim_map(old, new)[mask] for old, new, mask in zip(*grey, pixels, strict=True)]
    differences = ciede2000(lab(before), lab(after))[pixels]
    assert found.ssim == pytest.approx(np.concatenate(similar).mean(), abs=1e-4)
    assert found.ssim_worst == pytest.approx(min(view.mean() for view in similar), abs=1e-4)
    assert found.delta_e == pytest.approx(differences.mean(), abs=1e-4)
    assert found.delta_e_95 == pytest.approx(np.percentile(differences, 95), abs=1e-3)


def test_views_without_the_object_do_not_count_and_without_any_there_is_nothing_to_say() -> None:
    before, after = noise(12)
    pixels = np.ones(before.shape[:3], bool)
    pixels[1:] = False
    assert perceived_change(before, after, pixels) == perceived_change(before[:1], after[:1], pixels[:1])
    assert perceived_change(before, after, pixels & False) is None


def test_the_object_is_what_differs_from_the_background_before_or_after() -> None:
    before = np.full((2, 4, 4, 3), 255, np.uint8)
    before[1] = 0
    after = before.copy()
    before[0, 0, 0, 2] = 254
    after[1, 3, 3] = (0, 1, 0)
    behind = np.array([[255] * 3, [0] * 3], np.uint8)[:, None, None]
    assert np.argwhere(object_pixels(before, after, behind)).tolist() == [[0, 0, 0], [1, 3, 3]]
    assert object_pixels(before, after, np.zeros((4, 4, 3), np.uint8)).sum() == 16 + 1


# Roughness


def changed(delta: np.ndarray) -> float:
    before = np.full((*delta.shape, 3), 100, np.uint8)
    return total_variation({"a.png": before}, {"a.png": (before + delta[..., None]).astype(np.uint8)})


def test_roughness_tells_a_tint_from_noise_and_noise_from_a_checkerboard() -> None:
    checkerboard = 12 * (1 - 2 * (np.indices((64, 64)).sum(axis=0) % 2))
    assert changed(np.zeros((64, 64), int)) == 0
    assert changed(np.full((64, 64), 12)) == 0
    assert changed(RANDOM.choice([-12, 12], (64, 64))) == pytest.approx(12 / 255, rel=0.05)
    assert changed(checkerboard) == pytest.approx(24 / 255)


def test_texels_that_stayed_do_not_make_a_change_smoother() -> None:
    delta = np.zeros((40, 40), int)
    delta[10, 10] = 20
    small = delta[8:13, 8:13]
    assert changed(delta) == changed(small) == pytest.approx(20 / 255)


def test_roughness_is_over_all_textures_together() -> None:
    before = {"a.png": np.zeros((1, 2, 3), np.uint8), "b.png": np.zeros((3, 1, 3), np.uint8)}
    after = {name: texture.copy() for name, texture in before.items()}
    after["a.png"][0, 0] = 30
    after["b.png"][1, 0, 0] = 60
    assert total_variation(before, after) == pytest.approx((3 * 30 + 60 + 60) / 9 / 255)
