"""The attack's parts, each against its formula, and the loop as a whole on a small scene."""

from collections.abc import Callable, Mapping
from typing import Any, get_args

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from torch import Tensor

from trompe_server.attack import (
    Budget,
    Goal,
    ViewDistribution,
    grid_views,
    image_gradients,
    rescale_each_view,
    saliency,
    saliency_masks,
)
from trompe_server.classifiers import NetworkClassifier, fake_classifier
from trompe_shared.api import SaliencyScope
from trompe_shared.errors import SpecError
from trompe_shared.geometry import FIELD_OF_VIEW, Camera, Light, View, framing_distance
from trompe_shared.object3d import Object3D

Make = Callable[..., Any]
Textures = Mapping[str, Tensor]
EPS = 1e-6
BUDGETS = st.floats(1 / 255, 1).flatmap(lambda e: st.builds(Budget, st.just(e), st.floats(e / 1000, e)))
SEEDS = st.integers(0, 2**31)


def random_tensor(seed: int, *, low: float, high: float) -> Tensor:
    return torch.empty(4, 5, 3).uniform_(low, high, generator=torch.Generator().manual_seed(seed))


def random_texture(seed: int) -> Tensor:
    """8-bit colours in [0, 1], black and white among them."""
    return (random_tensor(seed, low=-0.3, high=1.3).clamp(0, 1) * 255).round() / 255


# The budget


@given(BUDGETS, SEEDS)
@settings(max_examples=60)
def test_a_projected_change_keeps_the_budget_and_the_colours_that_exist(budget: Budget, seed: int) -> None:
    texture = random_texture(seed)
    delta = budget.project(random_tensor(seed + 1, low=-2, high=2), texture)
    assert delta.abs().max() <= budget.epsilon + EPS
    assert (texture + delta).min() >= 0
    assert (texture + delta).max() <= 1
    torch.testing.assert_close(budget.project(delta, texture), delta, atol=EPS, rtol=0)


@given(BUDGETS, SEEDS)
@settings(max_examples=60)
def test_the_projection_is_the_nearest_change_that_is_allowed(budget: Budget, seed: int) -> None:
    texture, wish = random_texture(seed), random_tensor(seed + 1, low=-2, high=2)
    low, high = (-texture).clamp(min=-budget.epsilon), (1 - texture).clamp(max=budget.epsilon)
    torch.testing.assert_close(
        budget.project(wish, texture), torch.maximum(low, torch.minimum(high, wish)), atol=EPS, rtol=0
    )


@given(BUDGETS, SEEDS, st.integers(1, 12))
@settings(max_examples=60)
def test_a_gradient_of_constant_sign_walks_straight_to_the_bound(budget: Budget, seed: int, steps: int) -> None:
    texture, gradient = random_texture(seed), random_tensor(seed + 1, low=-1, high=1)
    sign, delta = gradient.sign(), torch.zeros_like(texture)
    reach = torch.where(sign > 0, (1 - texture).clamp(max=budget.epsilon), texture.clamp(max=budget.epsilon))
    for step in range(1, steps + 1):
        delta = budget.ascend(delta, gradient * step, texture)
        expected = sign * torch.minimum(torch.tensor(step * budget.alpha), reach)
        torch.testing.assert_close(delta, expected, atol=step * EPS, rtol=0)


def test_texels_without_gradient_stay_where_they_are() -> None:
    texture, gradient = torch.full((1, 3, 3), 0.5), torch.tensor([[[0.0] * 3, [-0.0] * 3, [1e-30] * 3]])
    delta = Budget(0.1, 0.1).ascend(torch.full((1, 3, 3), 0.02), gradient, texture)
    torch.testing.assert_close(delta[0, :, 0], torch.tensor([0.02, 0.02, 0.1]))


@given(st.floats(1 / 255, 1), SEEDS)
@settings(max_examples=100)
def test_the_texture_that_is_saved_keeps_the_budget_in_whole_levels(epsilon: float, seed: int) -> None:
    budget, texture = Budget(epsilon, epsilon), (random_texture(seed) * 255).round().byte()
    delta = budget.project(random_tensor(seed + 1, low=-2, high=2), texture.float() / 255)
    saved = budget.quantise(delta, texture)
    change = (saved.int() - texture.int()).abs()
    assert saved.dtype == torch.uint8
    assert change.max() <= np.floor(epsilon * 255 + 1e-6)
    assert (saved - (texture.float() + delta * 255)).abs().max() <= 1 + 1e-3


def test_a_change_of_nothing_saves_the_texture_as_it_is() -> None:
    texture = torch.arange(60, dtype=torch.uint8).view(4, 5, 3)
    assert torch.equal(Budget(0.5, 0.1).quantise(torch.zeros(4, 5, 3), texture), texture)


@pytest.mark.parametrize("epsilon", [0.05, 0.1, 0.2, 0.5, 1.0])
def test_the_whole_of_a_budget_can_be_saved(epsilon: float) -> None:
    saved = Budget(epsilon, 0.01).quantise(torch.full((1, 1, 3), epsilon), torch.zeros(1, 1, 3, dtype=torch.uint8))
    assert int(saved[0, 0, 0]) == int(np.floor(round(epsilon * 255, 6)))


@pytest.mark.parametrize(
    ("epsilon", "alpha"), [(0.1, 0.0), (0.1, -0.1), (0.1, 0.2), (0.0, 0.0), (1.5, 0.1), (float("nan"), 0.1)]
)
def test_an_impossible_budget_is_refused(epsilon: float, alpha: float) -> None:
    with pytest.raises(SpecError, match="0 < alpha <= epsilon <= 1"):
        Budget(epsilon, alpha)


# Saliency


def test_saliency_is_scaled_over_all_views_to_end_at_zero_and_one() -> None:
    images = np.random.default_rng(0).integers(0, 256, (13, 32, 32, 3), dtype=np.uint8)
    classifier = fake_classifier()
    maps = saliency(images, classifier, goal=Goal(3))
    assert maps.shape == (13, 32, 32)
    assert (float(maps.min()), float(maps.max())) == (0.0, 1.0)
    gradients = []
    for image in images:
        leaf = (torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255).requires_grad_()
        (gradient,) = torch.autograd.grad(Goal(3).margins(classifier.logits(leaf)).sum(), leaf)
        gradients.append(gradient[0].abs().mean(0))
    expected = torch.stack(gradients)
    torch.testing.assert_close(maps, (expected - expected.min()) / (expected.max() - expected.min()), atol=1e-4, rtol=0)


def test_image_gradients_are_those_of_the_loss_with_their_sign() -> None:
    images = np.random.default_rng(1).integers(0, 256, (11, 32, 32, 3), dtype=np.uint8)
    classifier, goal = fake_classifier(), Goal(3, loss="cross_entropy")
    found = image_gradients(images, classifier, goal=goal)
    leaf = (torch.from_numpy(images).float() / 255).requires_grad_()
    (expected,) = torch.autograd.grad(goal.losses(classifier.logits(leaf.permute(0, 3, 1, 2))).sum(), leaf)
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-4)
    maps = saliency(images, classifier, goal=goal)
    torch.testing.assert_close((maps == 1).nonzero(), (found.abs().mean(3) == found.abs().mean(3).max()).nonzero())


def test_saliency_of_a_classifier_that_does_not_care_is_zero() -> None:
    last = torch.nn.Linear(12, 2)
    torch.nn.init.zeros_(last.weight)
    deaf = torch.nn.Sequential(torch.nn.Flatten(), last)
    maps = saliency(np.zeros((2, 2, 2, 3), np.uint8), NetworkClassifier("deaf", deaf, (2, 2), 2), goal=Goal(0))
    assert (maps == 0).all()


def test_masks_are_the_pixels_of_at_least_tau() -> None:
    maps = torch.tensor([[[0.0, 0.05, 0.2, 1.0]]])
    assert saliency_masks(maps, 0.05).tolist() == [[[False, True, True, True]]]
    assert saliency_masks(maps, 0.0).all()


MAPS = (
    st.integers(1, 5)
    .flatmap(lambda views: arrays(np.float32, (views, 3, 4), elements=st.floats(0, 1, width=32)))
    .map(torch.from_numpy)
)
TAUS = st.floats(0.01, 0.999)


@given(MAPS, TAUS, st.integers(-120, 0))
@settings(max_examples=100)
def test_each_view_alone_gives_its_most_sensitive_pixels_however_little_that_is(
    maps: Tensor, tau: float, exponent: int
) -> None:
    maps[0] *= 2.0**exponent
    rescaled = rescale_each_view(maps)
    assert ((rescaled >= 0) & (rescaled <= 1)).all()
    for view, own in zip(maps, rescaled.half().float(), strict=True):  # as jobs keep it
        assert (own[view == view.max()] >= tau).all() == bool(view.any())
        assert (own >= tau).any() == bool(view.any())


@given(MAPS, TAUS, st.integers(-60, 60))
@settings(max_examples=100)
def test_each_view_alone_knows_nothing_of_how_sensitive_the_others_are(maps: Tensor, tau: float, exponent: int) -> None:
    maps = torch.where(maps < 1e-6, 0, maps)  # what is less may be lost when it is scaled
    before = rescale_each_view(maps)
    factors = torch.ones(len(maps), 1, 1)
    factors[-1] = 2.0**exponent
    assert torch.equal(rescale_each_view(maps * factors), before)
    for view, own in zip(maps, before, strict=True):
        assert torch.equal(rescale_each_view(view[None])[0], own)


class Steep(torch.nn.Module):
    """Logits whose gradient is a high power of the image: dark views are hardly sensitive."""

    def forward(self, images: Tensor) -> Tensor:
        steep = (images**9).sum((1, 2, 3))
        return torch.stack([-steep, 0 * steep], 1)


STEEP = NetworkClassifier("steep", Steep(), (4, 4), 2)
GREYS = st.integers(1, 5).flatmap(lambda views: arrays(np.uint8, (views, 4, 4)))


def grey_images(levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.repeat(levels[..., None], 3, axis=3)


@given(GREYS, TAUS)
@settings(max_examples=60)
def test_saliency_over_all_views_is_what_it_is_where_nothing_is_said(levels: NDArray[np.uint8], tau: float) -> None:
    gradients = image_gradients(grey_images(levels), STEEP, goal=Goal(0)).abs().mean(3)
    expected = (gradients - gradients.min()) / (gradients.max() - gradients.min()).clamp(min=1e-30)
    for found in (
        saliency(grey_images(levels), STEEP, goal=Goal(0)),
        saliency(grey_images(levels), STEEP, goal=Goal(0), scope="all_views"),
    ):
        assert torch.equal(found, expected)


@given(arrays(np.uint8, (1, 4, 4)))
def test_of_a_single_view_both_scopes_are_the_same(levels: NDArray[np.uint8]) -> None:
    alone, together = (
        saliency(grey_images(levels), STEEP, goal=Goal(0), scope=scope) for scope in get_args(SaliencyScope)
    )
    assert torch.equal(alone, together)


def test_a_dark_view_gives_pixels_in_each_view_alone_where_half_precision_would_lose_them() -> None:
    levels = np.zeros((3, 4, 4), np.uint8)
    levels[0, :2], levels[1, 1:3] = 255, 2  # the second view is 255 / 2 to the eighth, 7e16, times less sensitive
    together, alone = (
        saliency(grey_images(levels), STEEP, goal=Goal(0), scope=scope).half().float()
        for scope in get_args(SaliencyScope)
    )
    assert saliency_masks(together, 0.2).any(2).tolist() == [[True, True, False, False], [False] * 4, [False] * 4]
    masks = saliency_masks(alone, 0.2)
    assert masks.all(2).tolist() == [[True, True, False, False], [False, True, True, False], [False] * 4]
    assert torch.equal(masks.any(2), masks.all(2))


def test_views_that_are_sensitive_nowhere_leave_nothing_in_either_scope() -> None:
    for scope in get_args(SaliencyScope):
        maps = saliency(np.zeros((2, 4, 4, 3), np.uint8), STEEP, goal=Goal(0), scope=scope)
        assert (maps == 0).all()
        with pytest.raises(SpecError, match=r"tau=0.01.*lower tau"):
            saliency_masks(maps, 0.01)


# The views


def test_the_grid_is_the_papers() -> None:
    views = grid_views(distance=2.0, elevation=(10, 50), azimuths=6, elevations=10, background=(1, 2, 3))
    assert len(views) == 60
    assert {view.camera.azimuth for view in views} == {0, 72, 144, 216, 288, 360}
    assert sorted({view.camera.elevation for view in views}) == pytest.approx(np.linspace(10, 50, 10))
    assert len({view.camera for view in views}) == 60
    assert {(view.camera.distance, view.light, view.background) for view in views} == {
        (2.0, Light(azimuth=0, elevation=75), (1, 2, 3))
    }


def test_a_grid_of_one_is_the_first_end_of_both_ranges() -> None:
    (view,) = grid_views(distance=1, elevation=(20, 40), azimuths=1, elevations=1, background=(0, 0, 0))
    assert view.camera == Camera(1, 0, 20)


def held_out(n: int, seed: int) -> list[View]:
    generator = np.random.default_rng(seed)
    return ViewDistribution(2.0, (-10.0, 45.0), backgrounds=((9, 9, 9),)).sample(n, generator=generator)


def test_held_out_views_fill_their_ranges_and_nothing_else() -> None:
    views = held_out(400, 0)
    for values, low, high in (
        ([view.camera.distance for view in views], 1.8, 2.2),
        ([view.camera.azimuth for view in views], 0, 360),
        ([view.camera.elevation for view in views], -10, 45),
        ([view.light.azimuth for view in views], -70, 70),
        ([view.light.elevation for view in views], 35, 88),
    ):
        assert low <= min(values) < low + (high - low) * 0.05
        assert high - (high - low) * 0.05 < max(values) <= high
    assert {view.background for view in views} == {(9, 9, 9)}


def test_the_seed_determines_the_held_out_views() -> None:
    assert held_out(5, 1) == held_out(5, 1) != held_out(5, 2)
    assert held_out(9, 1)[:5] == held_out(5, 1)
    assert held_out(0, 1) == []


@given(st.floats(0, 360), st.floats(-90, 90))
@settings(max_examples=30)
def test_from_the_framing_distance_all_of_the_object_is_seen(mug: Object3D, azimuth: float, elevation: float) -> None:
    matrix = Camera(framing_distance(mug.radius), azimuth, elevation).world_to_camera()
    points = np.concatenate([part.vertices for part in mug.parts]) @ matrix[:3, :3].T + matrix[:3, 3]
    reach = np.abs(points[:, :2] / -points[:, 2:]) / np.tan(np.radians(FIELD_OF_VIEW / 2))
    assert (points[:, 2] < 0).all()
    assert reach.max() < 1
