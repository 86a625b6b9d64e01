"""The budget: projection, steps and 8-bit quantisation, each against its formula."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.attack_runs import EPS
from trompe_server.attack import Budget
from trompe_server.attack.budget import HUE
from trompe_shared.errors import SpecError

BUDGETS = st.floats(1 / 255, 1).flatmap(lambda e: st.builds(Budget, st.just(e), st.floats(e / 1000, e)))
SEEDS = st.integers(0, 2**31)


def random_tensor(seed: int, *, low: float, high: float) -> Tensor:
    return torch.empty(4, 5, 3).uniform_(low, high, generator=torch.Generator().manual_seed(seed))


def random_texture(seed: int) -> Tensor:
    """8-bit colours in [0, 1], black and white among them."""
    return (random_tensor(seed, low=-0.3, high=1.3).clamp(0, 1) * 255).round() / 255


@given(BUDGETS, SEEDS)
@settings(max_examples=60)
def test_a_projected_change_keeps_the_budget_and_the_colours_that_exist(budget: Budget, seed: int) -> None:
    texture = random_texture(seed)
    delta = budget.box(texture).project(random_tensor(seed + 1, low=-2, high=2))
    assert delta.abs().max() <= budget.epsilon + EPS
    assert (texture + delta).min() >= 0
    assert (texture + delta).max() <= 1
    torch.testing.assert_close(budget.box(texture).project(delta), delta, atol=EPS, rtol=0)


@given(BUDGETS, SEEDS)
@settings(max_examples=60)
def test_the_projection_is_the_nearest_change_that_is_allowed(budget: Budget, seed: int) -> None:
    texture, wish = random_texture(seed), random_tensor(seed + 1, low=-2, high=2)
    low, high = (-texture).clamp(min=-budget.epsilon), (1 - texture).clamp(max=budget.epsilon)
    torch.testing.assert_close(
        budget.box(texture).project(wish), torch.maximum(low, torch.minimum(high, wish)), atol=EPS, rtol=0
    )


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


@pytest.mark.parametrize("epsilon_view", [0.0, -0.1, 1.1, float("nan")])
def test_an_impossible_view_budget_is_refused(epsilon_view: float) -> None:
    with pytest.raises(SpecError, match=r"epsilon_view must be in \(0, 1\]"):
        Budget(0.1, 0.1, epsilon_view)
