"""Selection and ranking of texels, and the choice of few by trial attacks."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.attack_runs import LABEL, SIZE, SQUARE, SURROGATE, mean_loss, run
from tests.fakes import fake_classifier
from trompe_server.attack import (
    Budget,
    Goal,
    TexelMasks,
    best_texels,
    few_texels,
    material_texels,
    movable,
    painted_texels,
    rank_texels,
)
from trompe_server.surrogate import textures_of
from trompe_shared.errors import SpecError

# Masks


def mask_image(rows: slice, columns: slice) -> NDArray[np.uint8]:
    image = np.zeros((16, 16, 3), np.uint8)
    image[rows, columns] = 255
    return image


def test_painted_texels_are_the_white_ones_of_masked_textures() -> None:
    masks = painted_texels(SQUARE, {"m0.png": mask_image(slice(3, 5), slice(0, 7))})
    assert masks["m0.png"].sum() == 14
    assert masks["m0.png"][3:5, 0:7].all()
    assert not masks["m1.png"].any()


@pytest.mark.parametrize(
    ("images", "message"),
    [
        pytest.param({"m2.png": np.ones((16, 16, 3), np.uint8)}, r"no texture 'm2.png'.*m0.png", id="no such texture"),
        pytest.param({"m0.png": np.ones((8, 16, 3), np.uint8)}, "16 x 8 pixels, the texture 16 x 16", id="size"),
        pytest.param({"m0.png": np.full((16, 16, 3), 127, np.uint8)}, "paint white", id="nothing painted"),
        pytest.param({}, "paint white", id="no image"),
    ],
)
def test_an_unfit_mask_image_is_refused(images: dict[str, NDArray[np.uint8]], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        painted_texels(SQUARE, images)


def test_the_texels_of_a_material_are_those_of_its_texture() -> None:
    masks = material_texels(SQUARE, ["m1"])
    assert masks["m1.png"].all()
    assert not masks["m0.png"].any()


def test_an_unknown_material_is_refused() -> None:
    for wrong in (["m9"], []):
        with pytest.raises(SpecError, match=r"m0.*m1"):
            material_texels(SQUARE, wrong)


def test_a_texture_shared_by_two_materials_needs_both() -> None:
    shared = {name: replace(material, albedo="m0.png") for name, material in SQUARE.materials.items()}
    obj = replace(SQUARE, materials=shared)
    with pytest.raises(SpecError, match=r"\['m1'\] share a texture"):
        material_texels(obj, ["m0"])
    assert material_texels(obj, ["m0", "m1"])["m0.png"].all()


def test_masks_combine_with_visibility() -> None:
    budget = Budget(0.5, 0.1)
    painted = painted_texels(SQUARE, {"m0.png": mask_image(slice(0, 8), slice(0, 16))})
    other = painted_texels(SQUARE, {"m0.png": mask_image(slice(4, 16), slice(0, 16))})
    seen, both = movable(SURROGATE, budget), movable(SURROGATE, budget, within=[painted, other])
    expected = seen["m0.png"].clone()
    expected[:4], expected[8:] = False, False
    assert expected.any()
    assert torch.equal(both["m0.png"], expected)


def test_masks_without_texels_are_refused_with_a_remedy() -> None:
    behind = material_texels(SQUARE, ["m1"])
    with pytest.raises(SpecError, match="widen the texel masks, or raise `epsilon`"):
        movable(SURROGATE, Budget(0.1, 0.1), within=[behind])
    nowhere = torch.zeros(SURROGATE.n_views, *SIZE, dtype=torch.bool)
    with pytest.raises(SpecError, match=r"epsilon=0.1.*saliency `tau`.*Lower `tau`, or raise `epsilon`"):
        movable(SURROGATE, Budget(0.1, 0.1), nowhere)


# Rank


def test_a_texel_ranks_by_the_saliency_of_its_pixels() -> None:
    maps = torch.zeros(SURROGATE.n_views, *SIZE)
    maps[3, 14:18, 14:18] = 1.0
    scores = rank_texels(SURROGATE, textures_of(SQUARE), maps)
    read = SURROGATE.influence(maps > 0)
    for name, score in scores.items():
        assert score.shape == (16, 16)
        assert torch.equal(score > 0, read[name] > 0)


def test_the_scores_of_views_add_up() -> None:
    generator = torch.Generator().manual_seed(0)
    maps = [torch.rand(SURROGATE.n_views, *SIZE, generator=generator) for _ in range(2)]
    maps.append(maps[0] + maps[1])
    one, other, both = (rank_texels(SURROGATE, textures_of(SQUARE), some)["m0.png"] for some in maps)
    torch.testing.assert_close(one + other, both, atol=1e-4, rtol=1e-4)


def test_a_texel_pulled_in_opposite_directions_ranks_low() -> None:
    gradients = torch.zeros(SURROGATE.n_views, *SIZE, 3)
    gradients[3] = 1.0
    agreed = rank_texels(SURROGATE, textures_of(SQUARE), gradients)["m0.png"]
    saliency_alike = rank_texels(SURROGATE, textures_of(SQUARE), gradients[..., 0])["m0.png"]
    torch.testing.assert_close(agreed, saliency_alike)
    gradients[3, :, :, 0] = -2.0
    assert not torch.equal(rank_texels(SURROGATE, textures_of(SQUARE), gradients)["m0.png"], agreed)
    gradients[:] = 1.0
    pulled = rank_texels(SURROGATE, textures_of(SQUARE), gradients)["m0.png"]
    half = gradients.clone()
    half[SURROGATE.n_views // 2 :] = -1.0
    torn = rank_texels(SURROGATE, textures_of(SQUARE), half)["m0.png"]
    assert (torn <= pulled + 1e-4).all()
    assert torn.sum() < 0.5 * pulled.sum()


@given(keep=st.floats(0.01, 1), seed=st.integers(0, 99))
@settings(max_examples=8)
def test_the_best_texels_are_as_many_as_asked_and_the_highest(keep: float, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    scores = {"a": torch.rand(7, 9, generator=generator).round(decimals=1), "b": torch.rand(5, 4, generator=generator)}
    chosen = best_texels(scores, keep)
    inside = torch.cat([scores[name][chosen[name]] for name in scores])
    outside = torch.cat([scores[name][~chosen[name]] for name in scores])
    positive = sum(int((score > 0).sum()) for score in scores.values())
    assert len(inside) == min(round(keep * 83), positive)
    assert inside.min() > 0
    assert not len(outside) or outside.max() <= inside.min()


@pytest.mark.parametrize("keep", [0.0, -0.1, 1.5, float("nan")])
def test_an_impossible_share_is_refused(keep: float) -> None:
    with pytest.raises(SpecError, match=r"in \(0, 1\]"):
        best_texels({"a": torch.ones(2, 2)}, keep)


def test_a_share_without_texels_is_refused() -> None:
    for scores in (torch.ones(2, 2), torch.zeros(200, 2)):
        with pytest.raises(SpecError, match="keep more"):
            best_texels({"a": scores}, 0.01)


# Few texels


BUDGET = Budget(0.3, 0.1)


def gradients_of() -> torch.Tensor:
    return torch.rand(SURROGATE.n_views, *SIZE, 3, generator=torch.Generator().manual_seed(0)) - 0.5


def found(keep: float, *, gradients: torch.Tensor | None = None, **options: Any) -> TexelMasks:
    gradients = gradients_of() if gradients is None else gradients
    asked: dict[str, Any] = {"goal": Goal(LABEL), "budget": BUDGET} | options
    return few_texels(keep, textures_of(SQUARE), SURROGATE, fake_classifier(), gradients, **asked).masks


def count(masks: TexelMasks) -> int:
    return sum(int(mask.sum()) for mask in masks.values())


def test_the_same_texels_are_found_each_time_and_as_many_as_asked() -> None:
    once, again = (found(0.1) for _ in range(2))
    assert count(once) == round(0.1 * 2 * 16 * 16)
    assert all(torch.equal(once[name], again[name]) for name in once)


def test_all_texels_are_found_within_the_masks() -> None:
    upper = painted_texels(SQUARE, {"m0.png": mask_image(slice(0, 8), slice(0, 16))})
    few = found(0.1, within=[upper])
    assert count(few) == round(0.1 * 2 * 16 * 16)
    assert not few["m0.png"][8:].any()


def test_trials_get_an_attack_further_than_a_plain_ranking() -> None:
    textures, goal = textures_of(SQUARE), Goal(LABEL, safe=100.0)
    blind = best_texels(rank_texels(SURROGATE, textures, gradients_of()), 0.05)
    losses = []
    for few in (blind, found(0.05)):
        moving = movable(SURROGATE, BUDGET, within=[few])
        state = run(goal=goal, budget=BUDGET, steps=5, texels=moving)
        losses.append(mean_loss(state, goal))
    assert losses[1] > losses[0]


def test_only_masked_pixels_count() -> None:
    masks = torch.zeros(SURROGATE.n_views, *SIZE, dtype=torch.bool)
    masks[:, :, :16] = True
    loud = gradients_of()
    loud[:, :, 16:] *= 1000
    one, other = (found(0.05, gradients=gradients, masks=masks) for gradients in (gradients_of(), loud))
    assert all(torch.equal(one[name], other[name]) for name in one)
