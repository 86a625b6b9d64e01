"""Image pipelines: what each operation does, the matrices of resampling, what the draws depend on, the gradient."""

import io
import weakref
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.ndimage import gaussian_filter1d
from skimage import data, transform
from torch.nn import functional as F

from trompe_server.image_pipelines import PIPELINES, SUITE, Drawn, ImagePipeline
from trompe_server.image_pipelines.resampling import blurred, placed, resampled, resized

EVERYTHING = ImagePipeline(
    often=0.7,
    mirrored=0.5,
    zoom=(0.8, 1.2),
    shift=(-0.1, 0.1),
    resize=(0.4, 1),
    blur=(0, 1.5),
    gamma=(0.7, 1.4),
    gain=(0.8, 1.2),
    filmic=(0, 1),
    noise=(0, 0.05),
    jpeg=(30, 90),
)
PHOTO = np.round(255 * transform.resize(data.astronaut(), (64, 64), anti_aliasing=True)).astype(np.uint8)
PHOTOS = np.stack([PHOTO, PHOTO[:, ::-1], PHOTO[::-1]])
IMAGES = torch.from_numpy(PHOTOS).permute(0, 3, 1, 2).float() / 255


def levels(image: np.ndarray) -> np.ndarray:
    rounded: np.ndarray = np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)
    return rounded


# What the operations do


def test_without_operations_nothing_happens() -> None:
    np.testing.assert_array_equal(ImagePipeline().shown(PHOTOS), PHOTOS)
    assert Drawn(ImagePipeline(), 0, 0).apply(IMAGES, range(3)) is IMAGES


def test_half_size_and_back_is_what_torch_resizes() -> None:
    small = F.interpolate(IMAGES, (32, 32), mode="bilinear", antialias=True)
    back = F.interpolate(small, (64, 64), mode="bilinear").permute(0, 2, 3, 1).numpy()
    found = ImagePipeline(resize=(0.5, 0.5)).shown(PHOTOS)
    assert np.abs(found.astype(int) - levels(back)).max() <= 1


@pytest.mark.parametrize("quality", [75, 30])
def test_jpeg_is_pillows(quality: int) -> None:
    packed = io.BytesIO()
    Image.fromarray(PHOTO).save(packed, "JPEG", quality=quality)
    found = ImagePipeline(jpeg=(quality, quality)).shown(PHOTOS)[0]
    np.testing.assert_array_equal(found, np.array(Image.open(packed)))


@pytest.mark.parametrize(
    ("operation", "curve"),
    [
        ({"gamma": (1.25, 1.25)}, lambda x: x**1.25),
        ({"gamma": (0.8, 0.8)}, lambda x: x**0.8),
        ({"gain": (0.7, 0.7)}, lambda x: 0.7 * x),
        ({"gain": (1.5, 1.5)}, lambda x: np.minimum(1.5 * x, 1)),
    ],
    ids=["gamma 1.25", "gamma 0.8", "darker", "brighter"],
)
def test_tone(operation: dict[str, Any], curve: Any) -> None:
    found = ImagePipeline(**operation).shown(PHOTOS)
    assert np.abs(found.astype(int) - levels(curve(PHOTOS / 255))).max() <= 1


def test_a_filmic_curve_has_an_s_shape() -> None:
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, 2).repeat(8, 0)[None]
    found = ImagePipeline(filmic=(1, 1)).shown(ramp)[0, 0, :, 0].astype(int)
    assert (np.diff(found) >= 0).all()
    assert found[128] > 128 + 20  # brighter middle
    assert np.diff(found)[-60:].mean() < 0.6  # a shoulder


def test_grain_is_noise_of_mean_zero_within_its_range() -> None:
    grey = np.full((2, 64, 64, 3), 128, np.uint8)
    found = ImagePipeline(noise=(0.05, 0.05)).shown(grey).astype(int) - 128
    assert np.abs(found).max() in {12, 13}
    assert abs(found.mean()) < 0.2
    assert found.std() == pytest.approx(255 * 0.05 / np.sqrt(3), rel=0.05)
    assert not np.array_equal(found[0], found[1])


@pytest.mark.parametrize("name", SUITE)
def test_each_pipeline_of_the_suite_changes_a_photograph_and_keeps_what_it_shows(name: str) -> None:
    found = SUITE[name].shown(PHOTOS)
    change = np.abs(found.astype(float) - PHOTOS)
    assert found.shape == PHOTOS.shape
    assert 0.5 < change.mean() < 45
    assert np.corrcoef(found.ravel(), PHOTOS.ravel())[0, 1] > 0.6
    np.testing.assert_array_equal(SUITE[name].shown(PHOTOS), found)
    np.testing.assert_array_equal(SUITE[name].shown(PHOTOS[::-2], [2, 0]), found[::-2])


# Draws


def test_the_draws_depend_on_seed_step_and_view_alone() -> None:
    drawn = Drawn(EVERYTHING, 3, 7)
    first = drawn.apply(IMAGES, [4, 9, 2])
    torch.testing.assert_close(drawn.apply(IMAGES[1:], [9, 2]), first[1:])
    for other in (replace(drawn, seed=4), replace(drawn, step=8)):
        assert all(not torch.equal(a, b) for a, b in zip(other.apply(IMAGES, [4, 9, 2]), first, strict=True))
    same = drawn.apply(IMAGES[:1].expand(3, -1, -1, -1), [4, 9, 2])
    assert not torch.equal(same[0], same[1])


@pytest.mark.parametrize("often", [0.0, 0.25, 1.0])
def test_an_operation_happens_as_often_as_asked(often: float) -> None:
    pipeline = ImagePipeline(often=often, gain=(0.5, 0.5))
    shown = Drawn(pipeline, 0, 0).apply(torch.ones(400, 3, 2, 2), range(400))
    assert float((shown[:, 0, 0, 0] < 0.75).float().mean()) == pytest.approx(often, abs=0.07)


def test_spared_images_stay_as_they_are() -> None:
    drawn = Drawn(replace(EVERYTHING, spared=0.4, often=1), 0, 0)
    images = IMAGES[:1].expand(200, -1, -1, -1)
    same = (drawn.apply(images, range(200)) - images).abs().amax((1, 2, 3)) < 1e-5
    assert float(same.float().mean()) == pytest.approx(0.4, abs=0.1)


def test_strengths_fill_their_range() -> None:
    shown = Drawn(ImagePipeline(gain=(0.4, 0.9)), 1, 2).apply(torch.ones(300, 3, 1, 1), range(300))[:, 0, 0, 0]
    assert 0.4 <= float(shown.min()) < 0.42
    assert 0.88 < float(shown.max()) <= 0.9


def test_operations_are_drawn_apart() -> None:
    """An operation that is left out changes no other one's draws."""
    both = Drawn(ImagePipeline(often=0.5, resize=(0.3, 0.9), gain=(0.2, 0.8)), 0, 0)
    alone = replace(both, pipeline=replace(both.pipeline, resize=None))
    white = torch.ones(50, 3, 8, 8)
    torch.testing.assert_close(both.apply(white, range(50)), alone.apply(white, range(50)))


# Gradient


@pytest.mark.parametrize("name", [*PIPELINES, "everything"])
def test_the_gradient_predicts_a_small_change(name: str) -> None:
    pipeline = replace(PIPELINES.get(name, EVERYTHING), jpeg=None)
    images = (0.2 + 0.6 * IMAGES).double().requires_grad_()
    drawn, luck = Drawn(pipeline, 5, 1), torch.Generator().manual_seed(2)
    weights, step = (torch.randn(images.shape, generator=luck, dtype=torch.double) for _ in range(2))
    (gradient,) = torch.autograd.grad((drawn.apply(images, range(3)) * weights).sum(), images)
    with torch.no_grad():
        ends = [float((drawn.apply(images + k * 1e-5 * step, range(3)) * weights).sum()) for k in (-1, 1)]
    assert float((gradient * step).sum()) == pytest.approx((ends[1] - ends[0]) / 2e-5, rel=1e-3)


def test_jpeg_passes_the_gradient_of_the_unchanged_image() -> None:
    images = IMAGES.clone().requires_grad_()
    shown = Drawn(ImagePipeline(jpeg=(40, 40)), 0, 0).apply(images, range(3))
    assert not torch.allclose(shown, images)
    (gradient,) = torch.autograd.grad(shown.sum(), images)
    assert torch.equal(gradient, torch.ones_like(images))


def test_black_and_white_have_finite_gradients() -> None:
    images = torch.cat([torch.zeros(5, 3, 8, 8), torch.ones(5, 3, 8, 8)]).requires_grad_()
    (gradient,) = torch.autograd.grad(Drawn(EVERYTHING, 0, 0).apply(images, range(10)).sum(), images)
    assert torch.isfinite(gradient).all()


# Matrices of resampling: sizes, placement and blur of one axis

OBLONG = torch.rand((2, 3, 24, 20), generator=torch.Generator().manual_seed(0))
SIDES = st.integers(4, 40)


@given(side=SIDES, zoom=st.floats(0.5, 2), shift=st.floats(-0.2, 0.2), mirrored=st.booleans(), sigma=st.floats(0, 3))
def test_an_even_image_stays_even(side: int, zoom: float, shift: float, mirrored: bool, sigma: float) -> None:
    matrices = (placed(side, zoom=zoom, shift=shift, mirrored=mirrored), blurred(side, sigma), resized(side, side // 2))
    for axis in matrices:
        torch.testing.assert_close(axis.sum(1), torch.ones(side))


@pytest.mark.parametrize("size", [5, 10, 15, 20])
def test_reduced_and_enlarged_as_torch_does_it(size: int) -> None:
    found = resampled(OBLONG[:1], resized(24, size), resized(20, size))
    small = F.interpolate(OBLONG[:1], (size, size), mode="bilinear", antialias=True)
    torch.testing.assert_close(found, F.interpolate(small, (24, 20), mode="bilinear"), rtol=1e-4, atol=1e-5)


def test_resampling_keeps_little_memory() -> None:
    matrices = [weakref.ref(resized(600, size)) for size in range(240, 601, 3)]
    kept = [matrix for each in matrices if (matrix := each()) is not None]
    assert 0 < sum(matrix.untyped_storage().nbytes() for matrix in kept) < 100 * 2**20, "all 121 take 166 MiB"


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
    # a tent between two pixels
    torch.testing.assert_close((placed(41, zoom=0.8) @ row)[inner], row[inner] / 0.8, rtol=0, atol=0.005)


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
    mirrored = resampled(OBLONG, placed(24), placed(20, mirrored=True))
    torch.testing.assert_close(mirrored, OBLONG.flip(3))
    torch.testing.assert_close(resampled(OBLONG, placed(24, mirrored=True), placed(20)), OBLONG.flip(2))
