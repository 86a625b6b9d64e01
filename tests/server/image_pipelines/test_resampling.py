"""Matrices of resampling: sizes, placement and blur of one axis."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d
from torch.nn import functional as F

from trompe_server.image_pipelines.resampling import blurred, placed, resampled, resized

IMAGES = torch.rand((2, 3, 24, 20), generator=torch.Generator().manual_seed(0))
SIDES = st.integers(4, 40)


@given(side=SIDES, zoom=st.floats(0.5, 2), shift=st.floats(-0.2, 0.2), mirrored=st.booleans(), sigma=st.floats(0, 3))
def test_an_even_image_stays_even(side: int, zoom: float, shift: float, mirrored: bool, sigma: float) -> None:
    for axis in (
        placed(side, zoom=zoom, shift=shift, mirrored=mirrored),
        blurred(side, sigma),
        resized(side, side // 2),
    ):
        torch.testing.assert_close(axis.sum(1), torch.ones(side))


@pytest.mark.parametrize("size", [5, 10, 15, 20])
def test_reduced_and_enlarged_as_torch_does_it(size: int) -> None:
    found = resampled(IMAGES[:1], resized(24, size), resized(20, size))
    small = F.interpolate(IMAGES[:1], (size, size), mode="bilinear", antialias=True)
    torch.testing.assert_close(found, F.interpolate(small, (24, 20), mode="bilinear"), rtol=1e-4, atol=1e-5)


@given(side=SIDES)
def test_nothing_moves_without_zoom_and_shift(side: int) -> None:
    torch.testing.assert_close(placed(side), torch.eye(side))
    torch.testing.assert_close(placed(side, mirrored=True), torch.eye(side).flip(0))
    torch.testing.assert_close(blurred(side, 0.0), torch.eye(side))


def test_a_shift_moves_the_picture_and_repeats_its_edge() -> None:
    row = torch.arange(10.0)
    assert (placed(10, shift=0.2) @ row).tolist() == pytest.approx([0, 0, 0, 1, 2, 3, 4, 5, 6, 7])
    assert (placed(10, shift=-0.1) @ row).tolist() == pytest.approx([1, 2, 3, 4, 5, 6, 7, 8, 9, 9])


def test_a_zoom_magnifies_about_the_middle() -> None:
    row = torch.linspace(-1, 1, 41)
    inner = slice(12, -12)
    torch.testing.assert_close((placed(41, zoom=2) @ row)[inner], row[inner] / 2)
    torch.testing.assert_close(
        (placed(41, zoom=0.8) @ row)[inner], row[inner] / 0.8, rtol=0, atol=0.005
    )  # a tent between two pixels


def test_a_reduction_averages_what_it_cannot_show() -> None:
    stripes = torch.tensor([0.0, 1.0]).repeat(20)
    shown = (placed(40, zoom=0.5) @ stripes)[12:-12]
    assert float((shown - 0.5).abs().max()) < 0.05


@pytest.mark.parametrize("sigma", [0.7, 1.0, 2.0])
def test_blur_is_gaussian(sigma: float) -> None:
    row = torch.rand(60, generator=torch.Generator().manual_seed(1))
    expected = torch.from_numpy(gaussian_filter1d(row.numpy(), sigma, truncate=6))
    torch.testing.assert_close((blurred(60, sigma) @ row)[15:-15], expected[15:-15], rtol=1e-4, atol=1e-5)


def test_each_axis_has_its_own_matrix() -> None:
    mirrored = resampled(IMAGES, placed(24), placed(20, mirrored=True))
    torch.testing.assert_close(mirrored, IMAGES.flip(3))
    torch.testing.assert_close(resampled(IMAGES, placed(24, mirrored=True), placed(20)), IMAGES.flip(2))
