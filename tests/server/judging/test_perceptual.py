"""What a person would see of a repaint: SSIM, CIEDE2000 and total variation."""

from typing import Any

import numpy as np
import pytest

from trompe_server.judging.visibility import object_pixels, perceived_change, total_variation
from trompe_shared.api import Visibility

RANDOM = np.random.default_rng(7)


def noise(level: int, *, views: int = 3) -> tuple[np.ndarray, np.ndarray]:
    before = RANDOM.integers(60, 190, (views, 24, 28, 3)).astype(np.uint8)
    change = RANDOM.choice([-level, level], before.shape)
    return before, (before + change).astype(np.uint8)


def flat(colour: tuple[int, ...], size: tuple[int, int] = (16, 16)) -> np.ndarray:
    return np.full((1, *size, 3), colour, np.uint8)


def compared(before: np.ndarray, after: np.ndarray, pixels: np.ndarray | None = None) -> Any:
    """The change of ``pixels`` (views, H, W), by default of all."""
    found = perceived_change(before, after, np.ones(before.shape[:3], bool) if pixels is None else pixels)
    assert found
    return Visibility(**found)


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        # CIEDE2000 of two sRGB colours under D65
        pytest.param((0, 0, 0), (255, 255, 255), 100.0, id="black and white"),
        pytest.param((255, 0, 0), (0, 255, 0), 86.61, id="red and green"),
        pytest.param((255, 0, 0), (0, 0, 255), 52.88, id="red and blue"),
        pytest.param((0, 0, 0), (10, 10, 10), 1.59, id="near black"),
        pytest.param((120, 130, 140), (120, 130, 140), 0.0, id="equal"),
    ],
)
def test_colours_differ_by_ciede2000(one: tuple[int, ...], other: tuple[int, ...], expected: float) -> None:
    for before, after in ((one, other), (other, one)):
        found = compared(flat(before), flat(after))
        assert (found.delta_e, found.delta_e_95) == pytest.approx((expected, expected), abs=0.01)


def slow_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Wang's formula at the middle of two images (11, 11)."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    window /= window.sum()
    mean_a, mean_b = (window * a).sum(), (window * b).sum()
    var_a, var_b = (window * (a - mean_a) ** 2).sum(), (window * (b - mean_b) ** 2).sum()
    both = (window * (a - mean_a) * (b - mean_b)).sum()
    return float(
        (2 * mean_a * mean_b + 0.01**2)
        * (2 * both + 0.03**2)
        / ((mean_a**2 + mean_b**2 + 0.01**2) * (var_a + var_b + 0.03**2))
    )


def test_similarity_is_wangs_formula_on_luminance_with_mirrored_borders() -> None:
    before, after = noise(12, views=1)
    grey = [np.pad(image[0] @ np.array([0.299, 0.587, 0.114]) / 255, 5, mode="symmetric") for image in (before, after)]
    for row, column in ((0, 0), (5, 27), (12, 20), (23, 24)):
        pixels = np.zeros((1, 24, 28), bool)
        pixels[0, row, column] = True
        found = compared(before, after, pixels)
        window = (slice(row, row + 11), slice(column, column + 11))
        assert found.ssim == pytest.approx(slow_ssim(*(image[window] for image in grey)), abs=1e-4)


def test_images_smaller_than_a_window_can_be_compared() -> None:
    found = compared(flat((51, 51, 51), (3, 2)), flat((153, 153, 153), (3, 2)))
    assert found.ssim == pytest.approx((2 * 0.2 * 0.6 + 1e-4) / (0.2**2 + 0.6**2 + 1e-4), rel=1e-3)


def test_what_did_not_change_is_perfect() -> None:
    before, _ = noise(0)
    found = compared(before, before)
    assert (found.delta_e, found.delta_e_95) == (0, 0)
    assert (found.ssim, found.ssim_worst) == pytest.approx((1, 1), abs=1e-5)


def test_only_the_pixels_of_the_object_are_compared() -> None:
    before, after = noise(20)
    pixels = np.zeros(before.shape[:3], bool)
    pixels[:, :, :10] = True
    outside = after.copy()
    outside[:, :, 15:] = 255 - outside[:, :, 15:]
    assert perceived_change(before, after, pixels) == perceived_change(before, outside, pixels)


def test_the_figures_are_a_mean_over_pixels_the_worst_view_and_a_percentile() -> None:
    before, after = np.concatenate([flat((0, 0, 0))] * 2), np.concatenate([flat((0, 0, 0))] * 2)
    after[1, :8] = 255
    found = compared(before, after)
    assert found.delta_e == pytest.approx(25, abs=0.01)
    assert found.delta_e_95 == pytest.approx(100, abs=0.01)
    assert found.ssim == pytest.approx((1 + found.ssim_worst) / 2, abs=1e-5)


def test_views_without_the_object_do_not_count_and_without_any_there_is_nothing_to_say() -> None:
    before, after = noise(12)
    pixels = np.ones(before.shape[:3], bool)
    pixels[1:] = False
    assert perceived_change(before, after, pixels) == perceived_change(before[:1], after[:1], pixels[:1])
    assert perceived_change(before, after, pixels & False) == {}


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
