"""The attack's parts, each against its formula, and the loop as a whole on a small scene."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from trompe_server.array_files import pack_arrays, unpack_arrays
from trompe_server.attack import (
    AttackState,
    Budget,
    Step,
    attack,
    fooled,
    framing_distance,
    grid_views,
    load_state,
    margin,
    margin_loss,
    movable,
    random_views,
    saliency,
    saliency_masks,
    save_state,
    start,
)
from trompe_server.attack.goal import SAFE_MARGIN
from trompe_server.classifiers import NetworkClassifier, fake_classifier
from trompe_server.surrogate import SamplingModel, Surrogate, diffuse_surrogate, prepare_geometry, textures_of
from trompe_shared.errors import SpecError
from trompe_shared.geometry import FIELD_OF_VIEW, Camera, Light, View
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
@settings(max_examples=60, deadline=None)
def test_a_projected_change_keeps_the_budget_and_the_colours_that_exist(budget: Budget, seed: int) -> None:
    texture = random_texture(seed)
    delta = budget.project(random_tensor(seed + 1, low=-2, high=2), texture)
    assert delta.abs().max() <= budget.epsilon + EPS
    assert (texture + delta).min() >= 0
    assert (texture + delta).max() <= 1
    torch.testing.assert_close(budget.project(delta, texture), delta, atol=EPS, rtol=0)


@given(BUDGETS, SEEDS)
@settings(max_examples=60, deadline=None)
def test_the_projection_is_the_nearest_change_that_is_allowed(budget: Budget, seed: int) -> None:
    texture, wish = random_texture(seed), random_tensor(seed + 1, low=-2, high=2)
    low, high = (-texture).clamp(min=-budget.epsilon), (1 - texture).clamp(max=budget.epsilon)
    torch.testing.assert_close(
        budget.project(wish, texture), torch.maximum(low, torch.minimum(high, wish)), atol=EPS, rtol=0
    )


@given(BUDGETS, SEEDS, st.integers(1, 12))
@settings(max_examples=60, deadline=None)
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
@settings(max_examples=100, deadline=None)
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


# The goal

LOGITS = st.lists(st.lists(st.floats(-50, 50, width=32), min_size=4, max_size=4), min_size=1, max_size=6)


@given(LOGITS, st.integers(0, 3))
@settings(max_examples=100, deadline=None)
def test_the_margin_is_the_best_other_logit_minus_the_true_one(rows: list[list[float]], label: int) -> None:
    logits = torch.tensor(rows)
    others = [max(row[:label] + row[label + 1 :]) for row in rows]
    margins = torch.tensor([other - row[label] for other, row in zip(others, rows, strict=True)])
    torch.testing.assert_close(margin(logits, label), margins)
    torch.testing.assert_close(margin_loss(logits, label), margins.clamp(max=SAFE_MARGIN))
    assert fooled(logits, label)[margins > 0].all()
    assert not fooled(logits, label)[margins < 0].any()
    assert torch.equal(logits, torch.tensor(rows))


@pytest.mark.parametrize("size", [1.0, 1e4, 1e30])
def test_loss_and_gradient_are_finite_even_when_every_view_is_fooled(size: float) -> None:
    for logits, moves in ((torch.tensor([[0.0, 9], [0, 99]]), False), (torch.tensor([[9.0, 0], [99, 0]]), True)):
        leaf = (logits * size).requires_grad_()
        loss = margin_loss(leaf, 0)
        (gradient,) = torch.autograd.grad(loss.sum(), leaf)
        assert torch.isfinite(loss).all()
        assert torch.isfinite(gradient).all()
        assert bool((gradient != 0).any()) is moves


# Saliency


def test_saliency_is_scaled_over_all_views_to_end_at_zero_and_one() -> None:
    images = np.random.default_rng(0).integers(0, 256, (13, 32, 32, 3), dtype=np.uint8)
    classifier = fake_classifier()
    maps = saliency(images, classifier, 3)
    assert maps.shape == (13, 32, 32)
    assert (float(maps.min()), float(maps.max())) == (0.0, 1.0)
    gradients = []
    for image in images:
        leaf = (torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255).requires_grad_()
        (gradient,) = torch.autograd.grad(margin(classifier.logits(leaf), 3).sum(), leaf)
        gradients.append(gradient[0].abs().mean(0))
    expected = torch.stack(gradients)
    torch.testing.assert_close(maps, (expected - expected.min()) / (expected.max() - expected.min()), atol=1e-4, rtol=0)


def test_saliency_of_a_classifier_that_does_not_care_is_zero() -> None:
    last = torch.nn.Linear(12, 2)
    torch.nn.init.zeros_(last.weight)
    deaf = torch.nn.Sequential(torch.nn.Flatten(), last)
    maps = saliency(np.zeros((2, 2, 2, 3), np.uint8), NetworkClassifier("deaf", deaf, (2, 2), 2), 0)
    assert (maps == 0).all()


def test_masks_are_the_pixels_of_at_least_tau() -> None:
    maps = torch.tensor([[[0.0, 0.05, 0.2, 1.0]]])
    assert saliency_masks(maps, 0.05).tolist() == [[[False, True, True, True]]]
    assert saliency_masks(maps, 0.0).all()


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
    return list(random_views(n, distance=2, elevation=(-10, 45), background=(9, 9, 9), generator=generator))


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
@settings(max_examples=30, deadline=None)
def test_from_the_framing_distance_all_of_the_object_is_seen(mug: Object3D, azimuth: float, elevation: float) -> None:
    matrix = Camera(framing_distance(mug), azimuth, elevation).world_to_camera()
    points = np.concatenate([part.vertices for part in mug.parts]) @ matrix[:3, :3].T + matrix[:3, 3]
    reach = np.abs(points[:, :2] / -points[:, 2:]) / np.tan(np.radians(FIELD_OF_VIEW / 2))
    assert (points[:, 2] < 0).all()
    assert reach.max() < 1


# The loop

SIZE = (32, 32)
LABEL = 6
"""What the fake classifier takes the square for, in all of the views below."""


@pytest.fixture(scope="module")
def square(make_object: Make, make_quad: Make) -> Object3D:
    """A square that all views see from the front, and one behind the cameras that none sees."""
    random = np.random.default_rng(0)
    textures = [random.integers(40, 216, (16, 16, 3), dtype=np.uint8) for _ in range(2)]
    obj: Object3D = make_object(make_quad(textures[0]), make_quad(textures[1], z=9.0))
    return obj


@pytest.fixture(scope="module")
def surrogate(square: Object3D) -> Surrogate:
    views = [View(Camera(0.3, azimuth, elevation)) for azimuth in (-40, -10, 20, 45) for elevation in (-20, 0, 30)]
    return diffuse_surrogate(prepare_geometry(square, views, size=SIZE, sampling=SamplingModel()), views)


def run(
    obj: Object3D, surrogate: Surrogate, *, steps: int = 6, state: AttackState | None = None, **options: Any
) -> AttackState:
    textures = textures_of(obj)
    return attack(
        state or start(textures),
        textures,
        surrogate,
        fake_classifier(),
        LABEL,
        budget=Budget(0.06, 0.02),
        steps=steps,
        **options,
    )


def same(one: AttackState, other: AttackState) -> bool:
    tables = ((one.deltas, other.deltas), (one.momenta, other.momenta))
    return one.step == other.step and all(
        mine.keys() == theirs.keys() and all(torch.equal(mine[name], theirs[name]) for name in mine)
        for mine, theirs in tables
    )


def test_the_attack_raises_the_margin_within_its_budget(square: Object3D, surrogate: Surrogate) -> None:
    seen: list[Step] = []
    state = run(square, surrogate, on_step=seen.append)
    assert [step.step for step in seen] == list(range(6))
    assert seen[-1].loss > seen[0].loss + 0.01
    assert all(0 <= step.fooled <= 1 for step in seen)
    assert state.step == 6
    delta, texture = state.deltas["m0.png"], textures_of(square)["m0.png"]
    assert 0.059 < delta.abs().max() <= 0.06 + EPS
    assert (texture + delta).min() >= 0
    assert (texture + delta).max() <= 1


def test_what_a_step_reports_is_the_mean_over_all_views_before_it_moved(square: Object3D, surrogate: Surrogate) -> None:
    seen: list[Step] = []
    run(square, surrogate, steps=1, on_step=seen.append)
    texels = surrogate.texels(textures_of(square))
    logits = fake_classifier().logits(surrogate.render_all(texels))
    assert seen[0].loss == pytest.approx(float(margin_loss(logits, LABEL).mean()), abs=1e-4)
    assert seen[0].fooled == float(fooled(logits, LABEL).float().mean())


def test_a_step_goes_along_the_sign_of_the_mean_gradient(square: Object3D, surrogate: Surrogate) -> None:
    leaf = textures_of(square)["m0.png"].requires_grad_()
    texels = surrogate.texels(textures_of(square) | {"m0.png": leaf})
    logits = fake_classifier().logits(surrogate.render_all(texels))
    (gradient,) = torch.autograd.grad(margin_loss(logits, LABEL).mean(), leaf)
    clear = gradient.abs() > 1e-6
    delta = run(square, surrogate, steps=1).deltas["m0.png"]
    assert clear.float().mean() > 0.5
    torch.testing.assert_close(delta[clear], 0.02 * gradient.sign()[clear], atol=EPS, rtol=0)


def test_texels_that_no_view_sees_do_not_move(square: Object3D, surrogate: Surrogate) -> None:
    assert (run(square, surrogate).deltas["m1.png"] == 0).all()


def test_two_chunks_are_one_run_bit_for_bit(square: Object3D, surrogate: Surrogate) -> None:
    whole = run(square, surrogate, steps=5)
    half = load_state(save_state(run(square, surrogate, steps=2, total_steps=5)))
    assert same(run(square, surrogate, steps=3, state=half), whole)


def test_the_same_inputs_give_the_same_bytes(square: Object3D, surrogate: Surrogate) -> None:
    assert save_state(run(square, surrogate)) == save_state(run(square, surrogate))


def test_with_masks_only_texels_that_masked_pixels_read_move(square: Object3D, surrogate: Surrogate) -> None:
    masks = torch.zeros(surrogate.n_views, *SIZE, dtype=torch.bool)
    masks[:4, 12:18, 12:18] = True
    moved = (run(square, surrogate, masks=masks).deltas["m0.png"] != 0).any(dim=2)
    read = surrogate.influence(masks)["m0.png"] > 0
    assert moved.any()
    assert not moved[~read].any()
    assert moved.sum() < (run(square, surrogate).deltas["m0.png"] != 0).any(dim=2).sum()


def test_masks_that_let_nothing_through_move_nothing(square: Object3D, surrogate: Surrogate) -> None:
    masks = torch.zeros(surrogate.n_views, *SIZE, dtype=torch.bool)
    assert all((delta == 0).all() for delta in run(square, surrogate, masks=masks).deltas.values())


def test_only_the_texels_that_are_allowed_move(square: Object3D, surrogate: Surrogate) -> None:
    allowed = {name: torch.zeros(16, 16, dtype=torch.bool) for name in square.textures}
    allowed["m0.png"][3:9, 4:12] = True
    moved = (run(square, surrogate, texels=allowed).deltas["m0.png"] != 0).any(dim=2)
    assert moved.any()
    assert not (moved & ~allowed["m0.png"]).any()


def test_movable_are_the_texels_whose_whole_budget_is_worth_half_a_level(
    square: Object3D, surrogate: Surrogate
) -> None:
    small, large = movable(surrogate, Budget(0.001, 0.001)), movable(surrogate, Budget(1.0, 0.1))
    influence = surrogate.influence()
    for name in square.textures:
        assert torch.equal(large[name], influence[name] >= 0.5 / 255)
        assert not (small[name] & ~large[name]).any()
    assert not large["m1.png"].any()


def test_a_classifier_that_is_fooled_everywhere_stops_the_attack_without_nan(
    square: Object3D, surrogate: Surrogate
) -> None:
    last = torch.nn.Linear(3, 10)
    network = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), last)
    with torch.no_grad():
        last.bias.fill_(50.0)[LABEL] = -50.0
    seen: list[Step] = []
    textures = textures_of(square)
    classifier = replace(fake_classifier(), network=network)
    state = attack(
        start(textures), textures, surrogate, classifier, LABEL, budget=Budget(0.1, 0.1), steps=2, on_step=seen.append
    )
    assert [step.fooled for step in seen] == [1.0, 1.0]
    assert [step.loss for step in seen] == [SAFE_MARGIN] * 2
    assert all((delta == 0).all() for delta in state.deltas.values())


# State and arrays as files


@given(SEEDS, st.sampled_from(["a.png", "Straße 7.png", "x.npy", "step", "file"]))
@settings(max_examples=20, deadline=None)
def test_a_state_comes_back_exactly(seed: int, name: str) -> None:
    deltas = {name: random_tensor(seed, low=-1, high=1), "other.png": torch.zeros(1, 1, 3)}
    momenta = {name: random_tensor(seed + 1, low=-9, high=9), "other.png": torch.ones(1, 1, 3)}
    state = AttackState(seed, deltas, momenta)
    again = load_state(save_state(state))
    assert list(again.deltas) == list(state.deltas)
    assert same(again, state)


def test_arrays_come_back_as_they_were() -> None:
    arrays: dict[str, np.ndarray] = {
        "images": np.arange(24, dtype=np.uint8).reshape(2, 3, 4),
        "half": np.array([0.1, np.nan], np.float16),
        "none": np.zeros((0, 3)),
    }
    again = unpack_arrays(pack_arrays(arrays))
    assert list(again) == list(arrays)
    for name, array in arrays.items():
        assert again[name].dtype == array.dtype
        np.testing.assert_array_equal(again[name], array)


PACKED = pack_arrays({"a": np.arange(100), "b": np.zeros(3)})


@pytest.mark.parametrize(
    "data", [b"", b"no archive", PACKED[: len(PACKED) // 2], PACKED[:60] + b"\xff" * 40 + PACKED[100:]], ids=len
)
def test_damaged_bytes_are_an_error_that_can_be_caught(data: bytes) -> None:
    for read in (unpack_arrays, load_state):
        with pytest.raises((ValueError, OSError)):
            read(data)


def test_arrays_that_are_no_state_are_damaged_too() -> None:
    with pytest.raises(ValueError, match="step"):
        load_state(PACKED)


# The pool: each step looks at some of the views


@pytest.fixture(scope="module")
def many_views(square: Object3D) -> Surrogate:
    views = pool(30, seed=5)
    return diffuse_surrogate(prepare_geometry(square, views, size=SIZE, sampling=SamplingModel()), views)


def pool(n: int, *, seed: int) -> list[View]:
    generator = np.random.default_rng(seed)
    return list(random_views(n, distance=2, elevation=(0, 40), background=(0, 0, 0), generator=generator))


def losses(square: Object3D, surrogate: Surrogate, **options: Any) -> list[float]:
    seen: list[Step] = []
    run(square, surrogate, steps=4, on_step=seen.append, **options)
    return [step.loss for step in seen]


def test_a_step_that_draws_views_looks_at_other_ones_than_the_next(square: Object3D, many_views: Surrogate) -> None:
    texels = many_views.texels(textures_of(square))
    with torch.no_grad():
        logits = [fake_classifier().logits(many_views.render(texels, batch)) for batch in range(3)]
    first = losses(square, many_views, views_per_step=10)[0]
    assert any(first == pytest.approx(float(margin_loss(some, LABEL).mean()), abs=1e-4) for some in logits)
    assert first != pytest.approx(losses(square, many_views)[0], abs=1e-6)


def test_the_seed_decides_which_views_are_drawn(square: Object3D, many_views: Surrogate) -> None:
    drawn = [losses(square, many_views, views_per_step=10, seed=seed) for seed in (1, 1, 2, 3)]
    assert drawn[0] == drawn[1]
    assert drawn[2:] != [drawn[0], drawn[0]]


def test_a_run_over_a_pool_that_was_cut_off_goes_on_bit_for_bit(square: Object3D, many_views: Surrogate) -> None:
    whole = run(square, many_views, steps=5, views_per_step=10, seed=7)
    half = load_state(save_state(run(square, many_views, steps=2, total_steps=5, views_per_step=10, seed=7)))
    assert same(run(square, many_views, steps=3, state=half, views_per_step=10, seed=7), whole)
