"""The budget: projection, steps, 8-bit quantisation, perceptual bounds and the bound on images, against formulas."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from tests.attack_runs import EPS, SMALL, SQUARE, SURROGATE, random_state, run, same, surrogate_of
from tests.surfaces import object_of, quad
from trompe_server.attack import Budget, start
from trompe_server.attack.budget import HUE
from trompe_server.attack.perception import perceptual_bounds
from trompe_server.judging.visibility import perceived_change
from trompe_server.surrogate import SamplingModel, Surrogate, textures_of
from trompe_server.surrogate.blocks import means
from trompe_shared.errors import SpecError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D

BUDGETS = st.floats(1 / 255, 1).flatmap(lambda e: st.builds(Budget, st.just(e), st.floats(e / 1000, e)))
SEEDS = st.integers(0, 2**31)


def random_tensor(seed: int, *, low: float, high: float) -> Tensor:
    return torch.empty(4, 5, 3).uniform_(low, high, generator=torch.Generator().manual_seed(seed))


def random_texture(seed: int) -> Tensor:
    """8-bit colours in [0, 1], black and white among them."""
    return (random_tensor(seed, low=-0.3, high=1.3).clamp(0, 1) * 255).round() / 255


@given(BUDGETS, SEEDS)
@settings(max_examples=60)
def test_the_projection_is_the_nearest_change_that_is_allowed(budget: Budget, seed: int) -> None:
    texture, wish = random_texture(seed), random_tensor(seed + 1, low=-2, high=2)
    low, high = (-texture).clamp(min=-budget.epsilon), (1 - texture).clamp(max=budget.epsilon)
    delta = budget.box(texture).project(wish)
    torch.testing.assert_close(delta, torch.maximum(low, torch.minimum(high, wish)), atol=EPS, rtol=0)
    assert 0 <= (texture + delta).min() <= (texture + delta).max() <= 1


@given(BUDGETS, SEEDS, st.integers(1, 12))
@settings(max_examples=60)
def test_a_gradient_of_constant_sign_walks_straight_to_the_bound(budget: Budget, seed: int, steps: int) -> None:
    texture, gradient = random_texture(seed), random_tensor(seed + 1, low=-1, high=1)
    sign, delta = gradient.sign(), torch.zeros_like(texture)
    reach = torch.where(sign > 0, (1 - texture).clamp(max=budget.epsilon), texture.clamp(max=budget.epsilon))
    for step in range(1, steps + 1):
        delta = budget.box(texture).ascend(delta, gradient * step)
        expected = sign * torch.minimum(torch.tensor(step * budget.alpha), reach)
        torch.testing.assert_close(delta, expected, atol=step * EPS, rtol=0)


@given(st.floats(0.02, 1), SEEDS)
@settings(max_examples=60)
def test_a_perceptual_budget_bounds_each_texel_and_its_hue(epsilon: float, seed: int) -> None:
    texture, wish = random_texture(seed), random_tensor(seed + 1, low=-2, high=2)
    share = torch.empty(4, 5, 1).uniform_(0, 1, generator=torch.Generator().manual_seed(seed))
    budget, bound = Budget(epsilon, epsilon), (share * epsilon * 255).floor() / 255
    delta = budget.box(texture, bound=bound).project(wish)
    assert (delta.abs() <= bound + EPS).all()
    assert -EPS <= (texture + delta).min() <= (texture + delta).max() <= 1 + EPS
    assert (delta.amax(-1) - delta.amin(-1) <= HUE * bound[..., 0] + EPS).all()
    torch.testing.assert_close(budget.box(texture, bound=bound).project(delta), delta, atol=EPS, rtol=0)
    grey = wish[..., :1].expand(-1, -1, 3).clamp(-epsilon, epsilon)
    inside = ((texture + grey - 0.5).abs() <= 0.5).all(-1) & (grey.abs() <= bound).all(-1)
    torch.testing.assert_close(budget.box(texture, bound=bound).project(grey)[inside], grey[inside], atol=EPS, rtol=0)


def test_a_perceptual_step_is_as_large_as_the_bound_allows() -> None:
    texture, bound = torch.full((1, 2, 3), 0.5), torch.tensor([[[0.1], [0.02]]])
    delta = Budget(0.1, 0.05).box(texture, bound=bound).ascend(torch.zeros(1, 2, 3), torch.ones(1, 2, 3))
    torch.testing.assert_close(delta[0, :, 0], torch.tensor([0.05, 0.01]))


def test_a_perceptual_step_moves_the_texels_with_the_most_gradient_for_what_is_seen_of_them() -> None:
    gradient = torch.tensor([5.0, 8.0, 0.2, -6.0, 0.0, 1.0])
    weight = torch.tensor([1.0, 8.0, 1.0, 2.0, 9.0, 8.0])  # 20 with a gradient: a share of 0.3 is 6
    before = torch.tensor([-0.01, 0.03, 0.01, 0.02, 0.02, -0.03])
    flat, bound = torch.full((1, 6, 3), 0.5), torch.full((1, 6, 1), 0.1)
    box = replace(Budget(0.1, 0.02).box(flat, bound=bound), weight=weight.view(1, 6, 1))
    delta, direction = (each.view(1, 6, 1).expand(-1, -1, 3) for each in (before, gradient))
    after = box.ascend(delta, direction)
    torch.testing.assert_close(after[0, :, 0], torch.tensor([0.01, 0.05, 0.0, 0.0, 0.02, -0.01]))
    assert torch.equal(after[0, :, 0], after[0, :, 2])


def test_texels_without_gradient_stay_where_they_are() -> None:
    texture, gradient = torch.full((1, 3, 3), 0.5), torch.tensor([[[0.0] * 3, [-0.0] * 3, [1e-30] * 3]])
    delta = Budget(0.1, 0.1).box(texture).ascend(torch.full((1, 3, 3), 0.02), gradient)
    torch.testing.assert_close(delta[0, :, 0], torch.tensor([0.02, 0.02, 0.1]))


@given(st.floats(1 / 255, 1), SEEDS)
@settings(max_examples=100)
def test_the_texture_that_is_saved_keeps_the_budget_in_whole_levels(epsilon: float, seed: int) -> None:
    budget, texture = Budget(epsilon, epsilon), (random_texture(seed) * 255).round().byte()
    delta = budget.box(texture.float() / 255).project(random_tensor(seed + 1, low=-2, high=2))
    saved = budget.quantise(delta, texture)
    change = (saved.int() - texture.int()).abs()
    assert saved.dtype == torch.uint8
    assert change.max() <= np.floor(epsilon * 255 + 1e-6)
    assert (saved - (texture.float() + delta * 255)).abs().max() <= 1 + 1e-3


@given(st.integers(1, 2), st.floats(2 / 255, 1), SEEDS)
@settings(max_examples=60)
def test_blocks_are_saved_with_the_means_that_the_attack_found(count: int, epsilon: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    texture = torch.from_numpy(random.integers(-80, 336, (8, 12, 3)).clip(0, 255).astype(np.uint8))  # many saturated
    budget = Budget(epsilon, epsilon)
    wish = torch.from_numpy(random.uniform(-1.5 * epsilon, 1.5 * epsilon, (8 >> count, 12 >> count, 3))).float()
    delta = budget.box(texture.float() / 255, count).project(wish)
    change = budget.quantise(delta, texture).float() - texture.float()
    assert change.abs().max() <= budget.levels
    assert (means(change, count) - 255 * delta).abs().max() <= 1.5  # rounded, and down to a whole level at the bound


@pytest.mark.parametrize("view", [np.asarray, lambda image: np.asarray(Image.fromarray(image))])
def test_a_flipped_or_read_only_texture_is_a_texture(view: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> None:
    flipped, copied = (
        SQUARE.with_textures({name: make(image[::-1]) for name, image in SQUARE.textures.items()})
        for make in (view, np.array)
    )
    change = {name: torch.full(image.shape, 0.02) for name, image in SQUARE.textures.items()}
    assert same(start(textures_of(flipped)), start(textures_of(copied)))
    assert (SURROGATE.images(flipped) == SURROGATE.images(copied)).all()
    assert Budget(0.1, 0.1).repaint(flipped, change).files == Budget(0.1, 0.1).repaint(copied, change).files


def test_a_change_of_nothing_saves_the_texture_as_it_is() -> None:
    texture = torch.arange(60, dtype=torch.uint8).view(4, 5, 3)
    assert torch.equal(Budget(0.5, 0.1).quantise(torch.zeros(4, 5, 3), texture), texture)


@pytest.mark.parametrize("epsilon", [0.05, 0.1, 0.2, 0.5, 1.0])
def test_the_whole_of_a_budget_can_be_saved(epsilon: float) -> None:
    saved = Budget(epsilon, 0.01).quantise(torch.full((1, 1, 3), epsilon), torch.zeros(1, 1, 3, dtype=torch.uint8))
    assert int(saved[0, 0, 0]) == int(np.floor(round(epsilon * 255, 6)))


NAN = float("nan")
IMPOSSIBLE: dict[str, list[Any]] = {
    "0 < alpha <= epsilon <= 1": [(0.1, 0.0), (0.1, -0.1), (0.1, 0.2), (0.0, 0.0), (1.5, 0.1), (NAN, 0.1)],
    "epsilon must be at least 1/255, .*; got 0.0001: use 0.004 or more": [(0.0001, 0.0001)],
    "epsilon must be at least 1/255, .*; got 0.0039: use 0.004 or more": [(0.0039, 0.0039)],
    r"epsilon_view must be in \(0, 1\]": [(0.1, 0.1, view) for view in (0.0, -0.1, 1.1, NAN)],
}


@pytest.mark.parametrize(("values", "words"), [(each, words) for words, some in IMPOSSIBLE.items() for each in some])
def test_an_impossible_budget_is_refused(values: Any, words: str) -> None:
    with pytest.raises(SpecError, match=words):
        Budget(*values)


# Perceptual bounds, from the unpainted texture


def bound(texture: Tensor, *, footprint: float = 1.0, epsilon: float = 0.2) -> Tensor:
    height, width = texture.shape[:2]
    return perceptual_bounds(texture, (height, width), footprint=footprint, epsilon=epsilon)[..., 0]


def plain(grey: float, side: int = 16) -> Tensor:
    return torch.full((side, side, 3), grey)


def checked(low: float, high: float, side: int = 16) -> Tensor:
    squares = (torch.arange(side)[:, None] + torch.arange(side)) % 2
    return (low + (high - low) * squares)[..., None].expand(-1, -1, 3).contiguous()


@given(st.floats(0.004, 1), SEEDS, st.sampled_from([(1, 1), (1, 7), (5, 3), (16, 16)]), st.floats(1, 300))
@settings(max_examples=40)
def test_a_bound_is_in_whole_levels_from_one_to_epsilon(
    epsilon: float, seed: int, size: tuple[int, int], footprint: float
) -> None:
    texture = torch.rand(*size, 3, generator=torch.Generator().manual_seed(seed))
    levels = bound(texture, footprint=footprint, epsilon=epsilon) * 255
    assert levels.shape == size
    assert torch.allclose(levels, levels.round(), atol=1e-3)
    assert 1 <= round(float(levels.min())) <= round(float(levels.max())) <= max(1, math.floor(epsilon * 255 + 1e-3))


def test_texture_hides_a_change_and_plain_areas_show_it() -> None:
    assert (bound(checked(0.4, 0.6)) > 1.3 * bound(plain(0.5))).all()
    assert bound(plain(0.0)).min() == bound(checked(0.0, 0.2)).max() == pytest.approx(0.2)


def test_middle_greys_show_more_than_black_and_white() -> None:
    black, middle, white = (float(bound(plain(grey)).mean()) for grey in (0.0, 0.47, 1.0))
    assert middle < 0.7 * black
    assert middle < 0.7 * white


def test_a_texture_finer_than_the_pixels_of_the_views_counts_as_plain() -> None:
    fine = checked(0.3, 0.7, side=64)
    assert torch.equal(bound(fine, footprint=16), bound(plain(0.5, side=64), footprint=16))


def test_the_same_picture_has_the_same_bounds_at_any_resolution() -> None:
    coarse = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
    fine = coarse.repeat_interleave(4, 0).repeat_interleave(4, 1)
    shown = bound(fine, footprint=16).unfold(0, 4, 4).unfold(1, 4, 4).mean((2, 3))
    assert (shown - bound(coarse)).abs().mean() <= 0.01


def test_equal_bounds_are_about_equally_visible() -> None:
    """The mean CIEDE2000 of greys changed by their bounds varies less than for the same change of all."""

    def seen(change: list[float]) -> list[float]:
        found = []
        for grey, step in zip(greys, change, strict=True):
            before = (plain(grey)[None] * 255).round()
            clean, painted = (each.byte().numpy() for each in (before, before + round(step * 255)))
            found.append(perceived_change(clean, painted, clean[..., 0] >= 0)["delta_e"])
        return found

    greys = [0.1, 0.2, 0.4, 0.6, 0.75]
    own = seen([float(bound(plain(grey)).mean()) for grey in greys])
    same = seen([0.1] * len(greys))
    assert max(own) / min(own) < 1.4 < max(same) / min(same)


def test_an_attack_keeps_its_bounds() -> None:
    budget = Budget(0.1, 0.03, perceptual=True)
    state = run(budget=budget, steps=8)
    clean = textures_of(SQUARE)
    bounds = {name: bound(each, footprint=SURROGATE.footprint[name], epsilon=0.1) for name, each in clean.items()}
    painted = textures_of(budget.repaint(SQUARE, state.deltas))
    change = {name: (painted[name] - each).abs() for name, each in clean.items()}
    assert all((change[name].amax(2) <= bounds[name] + 1e-4).all() for name in change)
    assert change["m0.png"].max() > 0.02


# The bound on the surrogate's images


def images_of(surrogate: Surrogate, textures: dict[str, Tensor]) -> Tensor:
    with torch.no_grad():
        return surrogate.render_all(surrogate.texels(textures))


def attacked(
    epsilon_view: float | None, *, obj: Object3D = SQUARE, surrogate: Surrogate = SURROGATE, **options: Any
) -> tuple[dict[str, Tensor], float]:
    """The deltas of an attack, and the largest change of its images, for floats and for saved textures."""
    textures, budget = textures_of(obj), Budget(0.3, 0.1, epsilon_view)
    state = run(surrogate, obj=obj, budget=budget, steps=3, **options)
    painted = {name: textures[name] + delta for name, delta in state.deltas.items()}
    clean, saved = images_of(surrogate, textures), textures_of(budget.repaint(obj, state.deltas))
    change = max(float((images_of(surrogate, each) - clean).abs().max()) for each in (painted, saved))
    return dict(state.deltas), change


@pytest.mark.parametrize("optimiser", ["pgd", "nesterov"])
@given(epsilon_view=st.floats(0.002, 0.3), seed=st.integers(0, 9))
@SMALL
def test_no_pixel_changes_by_more_than_the_bound(optimiser: str, epsilon_view: float, seed: int) -> None:
    begin = random_state(Budget(0.3, 0.1), seed)
    _, change = attacked(epsilon_view, optimiser=optimiser, state=begin)
    assert change <= epsilon_view + 1e-5


def test_the_bound_is_used_up_at_no_needless_cost() -> None:
    bounded, change = attacked(0.05)
    free, largest = attacked(None)
    assert largest > 0.1
    assert 0.045 < change <= 0.05 + 1e-5
    assert bounded["m0.png"].abs().mean() > 0.8 * free["m0.png"].abs().mean() * 0.05 / largest


@pytest.mark.parametrize("filtered", ["linear", "encoded"])
def test_the_bound_holds_for_textures_seen_from_afar(filtered: Any) -> None:
    obj = object_of(quad(np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)))
    views = [View(Camera(distance, azimuth, 10)) for distance in (0.3, 1.5) for azimuth in (-80, 0, 30)]
    surrogate = surrogate_of(obj, views, sampling=SamplingModel(filtered=filtered))
    for epsilon_view in (0.01, 0.03):
        assert attacked(epsilon_view, obj=obj, surrogate=surrogate)[1] <= epsilon_view + 1e-5


def test_an_unreached_bound_changes_nothing() -> None:
    bounded, _ = attacked(1.0)
    free, _ = attacked(None)
    assert all(torch.equal(bounded[name], free[name]) for name in free)
