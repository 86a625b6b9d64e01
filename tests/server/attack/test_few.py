"""Choice of few texels by trial attacks."""

from typing import Any

import numpy as np
import pytest
import torch

from tests.attack_runs import LABEL, SIZE, mean_loss, run
from tests.fakes import fake_classifier
from trompe_server.attack import (
    Budget,
    Goal,
    TexelMasks,
    best_texels,
    few_texels,
    movable,
    painted_texels,
    rank_texels,
)
from trompe_server.surrogate import Surrogate, textures_of
from trompe_shared.errors import SpecError
from trompe_shared.object3d import Object3D

BUDGET = Budget(0.3, 0.1)


def gradients_of(surrogate: Surrogate) -> torch.Tensor:
    return torch.rand(surrogate.n_views, *SIZE, 3, generator=torch.Generator().manual_seed(0)) - 0.5


def found(
    obj: Object3D, surrogate: Surrogate, keep: float, *, gradients: torch.Tensor | None = None, **options: Any
) -> TexelMasks:
    gradients = gradients_of(surrogate) if gradients is None else gradients
    asked: dict[str, Any] = {"goal": Goal(LABEL), "budget": BUDGET} | options
    return few_texels(keep, textures_of(obj), surrogate, fake_classifier(), gradients, **asked).masks


def count(masks: TexelMasks) -> int:
    return sum(int(mask.sum()) for mask in masks.values())


def test_the_same_texels_are_found_each_time_and_as_many_as_asked(square: Object3D, surrogate: Surrogate) -> None:
    once, again = (found(square, surrogate, 0.1) for _ in range(2))
    assert count(once) == round(0.1 * 2 * 16 * 16)
    assert all(torch.equal(once[name], again[name]) for name in once)


def test_all_texels_are_found_within_the_masks(square: Object3D, surrogate: Surrogate) -> None:
    image = np.zeros((16, 16, 3), np.uint8)
    image[:8] = 255
    upper = painted_texels(square, {"m0.png": image})
    few = found(square, surrogate, 0.1, within=[upper])
    assert count(few) == round(0.1 * 2 * 16 * 16)
    assert not few["m0.png"][8:].any()


def test_trials_get_an_attack_further_than_a_plain_ranking(square: Object3D, surrogate: Surrogate) -> None:
    textures, goal = textures_of(square), Goal(LABEL, safe=100.0)
    blind = best_texels(rank_texels(surrogate, textures, gradients_of(surrogate)), 0.05)
    losses = []
    for few in (blind, found(square, surrogate, 0.05)):
        moving = movable(surrogate, BUDGET, within=[few])
        state = run(square, surrogate, goal=goal, budget=BUDGET, steps=5, texels=moving)
        losses.append(mean_loss(square, surrogate, state, goal))
    assert losses[1] > losses[0]


@pytest.mark.parametrize("keep", [0.0, 1.5])
def test_an_impossible_share_is_refused(keep: float, square: Object3D, surrogate: Surrogate) -> None:
    with pytest.raises(SpecError, match=r"in \(0, 1\]"):
        found(square, surrogate, keep)


def test_only_masked_pixels_count(square: Object3D, surrogate: Surrogate) -> None:
    masks = torch.zeros(surrogate.n_views, *SIZE, dtype=torch.bool)
    masks[:, :, :16] = True
    loud = gradients_of(surrogate)
    loud[:, :, 16:] *= 1000
    one, other = (
        found(square, surrogate, 0.05, gradients=gradients, masks=masks)
        for gradients in (gradients_of(surrogate), loud)
    )
    assert all(torch.equal(one[name], other[name]) for name in one)
