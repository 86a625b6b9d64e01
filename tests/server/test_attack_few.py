"""Few texels, found by trying."""

import numpy as np
import pytest
import torch

from trompe_server.attack import (
    Budget,
    FewTexels,
    Goal,
    TexelMasks,
    attack,
    best_texels,
    few_texels,
    movable,
    painted_texels,
    rank_texels,
    start,
)
from trompe_server.attack.objective import Objective
from trompe_server.classifiers import fake_classifier
from trompe_server.surrogate import Surrogate, textures_of
from trompe_shared.errors import SpecError
from trompe_shared.object3d import Object3D

LABEL = 6
BUDGET = Budget(0.3, 0.1)


def gradients_of(surrogate: Surrogate) -> torch.Tensor:
    return torch.rand(surrogate.n_views, 32, 32, 3, generator=torch.Generator().manual_seed(0)) - 0.5


def found(obj: Object3D, surrogate: Surrogate, keep: float, within: tuple[TexelMasks, ...] = ()) -> TexelMasks:
    return chosen(obj, surrogate, keep, within).masks


def chosen(obj: Object3D, surrogate: Surrogate, keep: float, within: tuple[TexelMasks, ...] = ()) -> FewTexels:
    return few_texels(
        *(keep, textures_of(obj), surrogate, fake_classifier(), gradients_of(surrogate)),
        goal=Goal(LABEL),
        budget=BUDGET,
        within=within,
    )


def count(masks: TexelMasks) -> int:
    return sum(int(mask.sum()) for mask in masks.values())


def test_no_more_texels_are_found_than_were_asked_for_and_the_same_ones_each_time(
    square: Object3D, square_surrogate: Surrogate
) -> None:
    once, again = (found(square, square_surrogate, 0.1) for _ in range(2))
    assert count(once) == round(0.1 * 2 * 16 * 16)
    assert all(torch.equal(once[name], again[name]) for name in once)


def test_only_texels_within_the_masks_are_found_and_all_that_were_asked_for(
    square: Object3D, square_surrogate: Surrogate
) -> None:
    image = np.zeros((16, 16, 3), np.uint8)
    image[:8] = 255
    upper = painted_texels(square, {"m0.png": image})
    few = found(square, square_surrogate, 0.1, (upper,))
    assert count(few) == round(0.1 * 2 * 16 * 16)
    assert not few["m0.png"][8:].any()


def test_what_is_found_by_trying_gets_an_attack_further_than_a_blind_ranking(
    square: Object3D, square_surrogate: Surrogate
) -> None:
    textures, goal = textures_of(square), Goal(LABEL, safe=100.0)
    blind = best_texels(rank_texels(square_surrogate, textures, gradients_of(square_surrogate)), 0.05)
    losses = []
    for few in (blind, found(square, square_surrogate, 0.05)):
        moving = movable(square_surrogate, BUDGET, within=[few])
        state = attack(
            *(start(textures), textures, square_surrogate, fake_classifier()),
            goal=goal,
            budget=BUDGET,
            steps=5,
            texels=moving,
        )
        objective = Objective(textures, square_surrogate, (fake_classifier(),), goal, None)
        losses.append(objective.standing(objective.join(state.deltas)).loss)
    assert losses[1] > losses[0]


@pytest.mark.parametrize("keep", [0.0, 1.5])
def test_a_share_that_is_none_is_refused(keep: float, square: Object3D, square_surrogate: Surrogate) -> None:
    with pytest.raises(SpecError, match=r"in \(0, 1\]"):
        found(square, square_surrogate, keep)


def test_only_pixels_of_the_masks_have_a_say_in_what_is_found(square: Object3D, square_surrogate: Surrogate) -> None:
    masks = torch.zeros(square_surrogate.n_views, 32, 32, dtype=torch.bool)
    masks[:, :, :16] = True
    loud = gradients_of(square_surrogate)
    loud[:, :, 16:] *= 1000
    options = {"goal": Goal(LABEL), "budget": BUDGET, "masks": masks}
    one, other = (
        few_texels(*(0.05, textures_of(square), square_surrogate, fake_classifier(), gradients), **options).masks
        for gradients in (gradients_of(square_surrogate), loud)
    )
    assert all(torch.equal(one[name], other[name]) for name in one)
