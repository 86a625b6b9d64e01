"""Image pipelines: what each operation does, what the draws depend on, and the gradient through them."""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from skimage import data, transform
from torch.nn import functional as F

from trompe_server.image_pipelines import PIPELINES, SUITE, Drawn, ImagePipeline

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
