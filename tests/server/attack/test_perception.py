"""Bounds of a perceptual budget, from the unpainted texture."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.attack_runs import run
from trompe_server.attack import Budget
from trompe_server.attack.perception import perceptual_bounds
from trompe_server.judging.visibility import perceived_change
from trompe_server.surrogate import Surrogate, textures_of
from trompe_shared.object3d import Object3D


def bound(texture: Tensor, *, footprint: float = 1.0, epsilon: float = 0.2) -> Tensor:
    height, width = texture.shape[:2]
    return perceptual_bounds(texture, (height, width), footprint=footprint, epsilon=epsilon)[..., 0]


def plain(grey: float, side: int = 16) -> Tensor:
    return torch.full((side, side, 3), grey)


def checked(low: float, high: float, side: int = 16) -> Tensor:
    squares = (torch.arange(side)[:, None] + torch.arange(side)) % 2
    return (low + (high - low) * squares)[..., None].expand(-1, -1, 3).contiguous()


@given(
    st.floats(0.004, 1), st.integers(0, 2**31), st.sampled_from([(1, 1), (1, 7), (5, 3), (16, 16)]), st.floats(1, 300)
)
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
            shown = perceived_change(clean, painted, clean[..., 0] >= 0)
            found.append(shown["delta_e"])
        return found

    greys = [0.1, 0.2, 0.4, 0.6, 0.75]
    own = seen([float(bound(plain(grey)).mean()) for grey in greys])
    same = seen([0.1] * len(greys))
    assert max(own) / min(own) < 1.4 < max(same) / min(same)


def test_an_attack_keeps_its_bounds(square: Object3D, surrogate: Surrogate) -> None:
    budget = Budget(0.1, 0.03, perceptual=True)
    state = run(square, surrogate, budget=budget, steps=8)
    clean = textures_of(square)
    bounds = {name: bound(each, footprint=surrogate.footprint[name], epsilon=0.1) for name, each in clean.items()}
    painted = textures_of(budget.repaint(square, state.deltas))
    change = {name: (painted[name] - each).abs() for name, each in clean.items()}
    assert all((change[name].amax(2) <= bounds[name] + 1e-4).all() for name in change)
    assert change["m0.png"].max() > 0.02
