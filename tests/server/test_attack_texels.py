"""Which texels move, how they are ranked, and the bound on the images that the texels answer for."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from trompe_server.attack import (
    AttackState,
    Budget,
    Goal,
    attack,
    best_texels,
    load_state,
    material_texels,
    movable,
    painted_texels,
    rank_texels,
    saliency_masks,
    save_state,
    start,
)
from trompe_server.classifiers import fake_classifier
from trompe_server.surrogate import SamplingModel, Surrogate, diffuse_surrogate, prepare_geometry, textures_of
from trompe_shared.errors import SpecError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D

Make = Callable[..., Any]
LABEL = 6
SMALL = settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])


# Masks


def mask_image(rows: slice, columns: slice) -> np.ndarray:
    image = np.zeros((16, 16, 3), np.uint8)
    image[rows, columns] = 255
    return image


def test_painted_texels_are_the_white_ones_of_the_textures_that_have_a_mask(square: Object3D) -> None:
    masks = painted_texels(square, {"m0.png": mask_image(slice(3, 5), slice(0, 7))})
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
def test_a_mask_image_that_does_not_fit_is_refused(
    images: dict[str, np.ndarray], message: str, square: Object3D
) -> None:
    with pytest.raises(SpecError, match=message):
        painted_texels(square, images)


def test_the_texels_of_a_material_are_those_of_its_texture(square: Object3D) -> None:
    masks = material_texels(square, ["m1"])
    assert masks["m1.png"].all()
    assert not masks["m0.png"].any()


def test_a_material_that_there_is_not_is_refused(square: Object3D) -> None:
    for wrong in (["m9"], []):
        with pytest.raises(SpecError, match=r"m0.*m1"):
            material_texels(square, wrong)


def test_a_texture_that_two_materials_share_cannot_be_had_by_one_of_them(square: Object3D) -> None:
    shared = {name: replace(material, albedo="m0.png") for name, material in square.materials.items()}
    obj = replace(square, materials=shared)
    with pytest.raises(SpecError, match=r"\['m1'\] share a texture"):
        material_texels(obj, ["m0"])
    assert material_texels(obj, ["m0", "m1"])["m0.png"].all()


def test_masks_combine_with_what_is_visible(square: Object3D, square_surrogate: Surrogate) -> None:
    budget = Budget(0.5, 0.1)
    painted = painted_texels(square, {"m0.png": mask_image(slice(0, 8), slice(0, 16))})
    other = painted_texels(square, {"m0.png": mask_image(slice(4, 16), slice(0, 16))})
    seen, both = movable(square_surrogate, budget), movable(square_surrogate, budget, within=[painted, other])
    expected = seen["m0.png"].clone()
    expected[:4], expected[8:] = False, False
    assert expected.any()
    assert torch.equal(both["m0.png"], expected)


def test_masks_that_leave_nothing_are_refused_with_the_way_out(square: Object3D, square_surrogate: Surrogate) -> None:
    behind = material_texels(square, ["m1"])
    with pytest.raises(SpecError, match="widen the texel masks, or raise epsilon"):
        movable(square_surrogate, Budget(0.1, 0.1), within=[behind])
    nowhere = torch.zeros(square_surrogate.n_views, 32, 32, dtype=torch.bool)
    with pytest.raises(SpecError, match=r"epsilon=0.1.*saliency tau.*Lower tau, or raise epsilon"):
        movable(square_surrogate, Budget(0.1, 0.1), nowhere)
    with pytest.raises(SpecError, match=r"tau=0.5.*lower tau"):
        saliency_masks(torch.zeros(2, 4, 4), 0.5)


# Rank


def test_a_texel_ranks_by_the_saliency_of_the_pixels_that_show_it(
    square: Object3D, square_surrogate: Surrogate
) -> None:
    maps = torch.zeros(square_surrogate.n_views, 32, 32)
    maps[3, 14:18, 14:18] = 1.0
    scores = rank_texels(square_surrogate, textures_of(square), maps)
    read = square_surrogate.influence(maps > 0)
    for name, score in scores.items():
        assert score.shape == (16, 16)
        assert torch.equal(score > 0, read[name] > 0)
    twice = rank_texels(square_surrogate, textures_of(square), 2 * maps)
    torch.testing.assert_close(twice["m0.png"], 2 * scores["m0.png"])


def test_the_scores_of_views_add_up(square: Object3D, square_surrogate: Surrogate) -> None:
    generator = torch.Generator().manual_seed(0)
    maps = [torch.rand(square_surrogate.n_views, 32, 32, generator=generator) for _ in range(2)]
    one, other, both = (
        rank_texels(square_surrogate, textures_of(square), some)["m0.png"] for some in (*maps, maps[0] + maps[1])
    )
    torch.testing.assert_close(one + other, both, atol=1e-4, rtol=1e-4)


def test_a_texel_that_views_pull_to_and_fro_ranks_last(square: Object3D, square_surrogate: Surrogate) -> None:
    gradients = torch.zeros(square_surrogate.n_views, 32, 32, 3)
    gradients[3] = 1.0
    agreed = rank_texels(square_surrogate, textures_of(square), gradients)["m0.png"]
    saliency_alike = rank_texels(square_surrogate, textures_of(square), gradients[..., 0])["m0.png"]
    torch.testing.assert_close(agreed, saliency_alike)
    gradients[3, :, :, 0] = -2.0
    assert not torch.equal(rank_texels(square_surrogate, textures_of(square), gradients)["m0.png"], agreed)
    gradients[:] = 1.0
    pulled = rank_texels(square_surrogate, textures_of(square), gradients)["m0.png"]
    half = gradients.clone()
    half[square_surrogate.n_views // 2 :] = -1.0
    torn = rank_texels(square_surrogate, textures_of(square), half)["m0.png"]
    assert (torn <= pulled + 1e-4).all()
    assert torn.sum() < 0.5 * pulled.sum()


@given(keep=st.floats(0.01, 1), seed=st.integers(0, 99))
@SMALL
def test_the_best_texels_are_as_many_as_asked_for_and_none_beats_them(keep: float, seed: int) -> None:
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
def test_a_share_that_is_none_is_refused(keep: float) -> None:
    with pytest.raises(SpecError, match=r"in \(0, 1\]"):
        best_texels({"a": torch.ones(2, 2)}, keep)


def test_a_share_that_leaves_nothing_is_refused() -> None:
    for scores in (torch.ones(2, 2), torch.zeros(200, 2)):
        with pytest.raises(SpecError, match="keep more"):
            best_texels({"a": scores}, 0.01)


# The bound on the images


def images_of(surrogate: Surrogate, textures: dict[str, Tensor]) -> Tensor:
    with torch.no_grad():
        return surrogate.render_all(surrogate.texels(textures))


def attacked(
    obj: Object3D, surrogate: Surrogate, epsilon_view: float | None, **options: Any
) -> tuple[dict[str, Tensor], float]:
    """The deltas of an attack, and the largest change of its images, of the textures that are saved too."""
    textures = textures_of(obj)
    budget = Budget(0.3, 0.1, epsilon_view)
    state = attack(
        start(textures), textures, surrogate, fake_classifier(), goal=Goal(LABEL), budget=budget, steps=3, **options
    )
    painted = {name: textures[name] + delta for name, delta in state.deltas.items()}
    clean, saved = images_of(surrogate, textures), textures_of(budget.repaint(obj, state.deltas))
    change = max(float((images_of(surrogate, each) - clean).abs().max()) for each in (painted, saved))
    return dict(state.deltas), change


@pytest.mark.parametrize("optimiser", ["pgd", "momentum", "nesterov", "adam", "auto"])
@given(epsilon_view=st.floats(0.002, 0.3), seed=st.integers(0, 9))
@SMALL
def test_no_pixel_of_the_surrogate_changes_by_more_than_is_allowed(
    optimiser: str, square: Object3D, square_surrogate: Surrogate, epsilon_view: float, seed: int
) -> None:
    options: dict[str, Any] = {"optimiser": optimiser, "random_start": True, "seed": seed}
    _, change = attacked(square, square_surrogate, epsilon_view, **options)
    assert change <= epsilon_view + 1e-5
    _, free = attacked(square, square_surrogate, None, **options)
    assert free > 0.02


def test_the_bound_is_used_up_and_costs_no_more_than_it_must(square: Object3D, square_surrogate: Surrogate) -> None:
    bounded, change = attacked(square, square_surrogate, 0.05)
    free, largest = attacked(square, square_surrogate, None)
    assert largest > 0.1
    assert 0.045 < change <= 0.05 + 1e-5
    assert bounded["m0.png"].abs().mean() > 0.8 * free["m0.png"].abs().mean() * 0.05 / largest


@pytest.mark.parametrize("filtered", ["linear", "encoded"])
def test_the_bound_holds_for_textures_that_are_seen_from_afar(
    filtered: Any, make_object: Make, make_quad: Make
) -> None:
    random = np.random.default_rng(1)
    obj: Object3D = make_object(make_quad(random.integers(0, 256, (64, 64, 3), dtype=np.uint8)))
    views = [View(Camera(distance, azimuth, 10)) for distance in (0.3, 1.5) for azimuth in (-80, 0, 30)]
    sampling = SamplingModel(filtered=filtered)
    surrogate = diffuse_surrogate(prepare_geometry(obj, views, size=(32, 32), sampling=sampling), views)
    for epsilon_view in (0.01, 0.03):
        assert attacked(obj, surrogate, epsilon_view)[1] <= epsilon_view + 1e-5


def test_a_bounded_run_that_was_cut_goes_on_bit_for_bit(square: Object3D, square_surrogate: Surrogate) -> None:
    textures, budget = textures_of(square), Budget(0.3, 0.1, 0.02)

    def on(state: AttackState, steps: int) -> AttackState:
        return attack(
            *(state, textures, square_surrogate, fake_classifier()),
            goal=Goal(LABEL),
            budget=budget,
            steps=steps,
            total_steps=4,
        )

    whole, parts = on(start(textures), 4), on(load_state(save_state(on(start(textures), 3))), 1)
    assert all(torch.equal(whole.deltas[name], parts.deltas[name]) for name in textures)


def test_a_bound_that_is_never_reached_changes_nothing(square: Object3D, square_surrogate: Surrogate) -> None:
    bounded, _ = attacked(square, square_surrogate, 1.0)
    free, _ = attacked(square, square_surrogate, None)
    assert all(torch.equal(bounded[name], free[name]) for name in free)


@pytest.mark.parametrize("epsilon_view", [0.0, -0.1, 1.1, float("nan")])
def test_an_impossible_bound_is_refused(epsilon_view: float) -> None:
    with pytest.raises(SpecError, match=r"epsilon_view must be in \(0, 1\]"):
        Budget(0.1, 0.1, epsilon_view)
