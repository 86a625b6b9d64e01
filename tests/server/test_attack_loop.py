"""The loop as a whole on a small scene: it climbs within its budget, can be cut anywhere, and survives what is odd."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from trompe_server.array_files import pack_arrays, unpack_arrays
from trompe_server.attack import (
    AttackState,
    Budget,
    Goal,
    Step,
    ViewDistribution,
    attack,
    grid_views,
    load_state,
    movable,
    save_state,
    start,
)
from trompe_server.attack.goal import SAFE_MARGIN
from trompe_server.attack.objective import Objective
from trompe_server.attack.optimiser import OPTIMISERS as METHODS
from trompe_server.attack.optimiser import ROUND, Box, OptimiserName, Pace, Point
from trompe_server.attack.search import RISE, SAFE_ENOUGH
from trompe_server.classifiers import NetworkClassifier, fake_classifier, load_classifier
from trompe_server.surrogate import SamplingModel, Surrogate, diffuse_surrogate, prepare_geometry, textures_of
from trompe_shared.errors import SpecError
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import shipped_objects

EPS = 1e-6
SEEDS = st.integers(0, 2**31)


SIZE = (32, 32)
LABEL = 6
"""What the fake classifier takes the square for, in all of the views below."""


@pytest.fixture
def surrogate(square_surrogate: Surrogate) -> Surrogate:
    return square_surrogate


def run(
    obj: Object3D, surrogate: Surrogate, *, steps: int = 6, state: AttackState | None = None, **options: Any
) -> AttackState:
    textures = textures_of(obj)
    options = {"goal": Goal(LABEL), "budget": Budget(0.06, 0.02)} | options
    return attack(state or start(textures), textures, surrogate, fake_classifier(), steps=steps, **options)


def same(one: AttackState, other: AttackState) -> bool:
    tables = ((one.deltas, other.deltas), (one.memory, other.memory))
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
    assert seen[0].loss == pytest.approx(float(Goal(LABEL).losses(logits).mean()), abs=1e-4)
    assert seen[0].fooled == float(Goal(LABEL).reached(logits).float().mean())


def test_a_step_goes_along_the_sign_of_the_mean_gradient(square: Object3D, surrogate: Surrogate) -> None:
    leaf = textures_of(square)["m0.png"].requires_grad_()
    texels = surrogate.texels(textures_of(square) | {"m0.png": leaf})
    logits = fake_classifier().logits(surrogate.render_all(texels))
    (gradient,) = torch.autograd.grad(Goal(LABEL).losses(logits).mean(), leaf)
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


class Askew(torch.nn.Module):
    """Says class 1 the more, the brighter a small part of the image is (by ``gain``), and the darker all the rest."""

    def __init__(self, rows: slice, columns: slice, *, gain: float, offset: float = 0.0) -> None:
        super().__init__()
        weights = torch.full((1, 1, *SIZE), -0.003)
        weights[..., rows, columns] = gain
        self.weights, self.offset = torch.nn.Parameter(weights), offset

    def forward(self, images: Tensor) -> Tensor:
        said = (images * self.weights).sum((1, 2, 3)) + self.offset
        return torch.stack([torch.zeros_like(said), said], 1)


@pytest.mark.parametrize("restarts", [0, 1])
@pytest.mark.parametrize("gain", [0.001, 0.008], ids=["the loss falls", "the loss rises and a view is lost"])
def test_an_attack_through_masks_never_ends_below_the_unpainted_object(
    square: Object3D, surrogate: Surrogate, gain: float, restarts: int
) -> None:
    """The pixels that are let through pull their texels up; other views, that see them too, lose by it."""
    rows, columns = slice(12, 18), slice(20, 26)
    masks = torch.zeros(surrogate.n_views, *SIZE, dtype=torch.bool)
    masks[0, rows, columns] = True
    textures, seen = textures_of(square), list[Step]()

    def askew(offset: float) -> NetworkClassifier:
        return NetworkClassifier("askew", Askew(rows, columns, gain=gain, offset=offset), SIZE, 2)

    def said(change: Tensor) -> Tensor:
        painted = textures | {"m0.png": textures["m0.png"] + change}
        return askew(0.0).logits(surrogate.render_all(surrogate.texels(painted)))[:, 1]

    pulled = 0.06 * (surrogate.influence(masks)["m0.png"] >= 0.5 / 255 / 0.06)[..., None]
    before, after = said(torch.zeros_like(textures["m0.png"])), said(pulled)
    barely_fooled = askew(1e-4 - float(before[after < before - 1e-3].max()))
    options: dict[str, Any] = {"goal": Goal(0), "budget": Budget(0.06, 0.02), "restarts": restarts, "masks": masks}
    state = attack(start(textures), textures, surrogate, barely_fooled, steps=6, on_step=seen.append, **options)

    objective = Objective(textures, surrogate, (barely_fooled,), Goal(0), None)
    unpainted = objective.standing(torch.zeros_like(objective.source))
    assert min((step.fooled, step.loss) for step in seen) < (unpainted.fooled - 0.01, 0)
    assert (max(step.loss for step in seen) > unpainted.loss + 1e-3) == (gain == 0.008)
    assert objective.standing(objective.join(state.deltas)) >= unpainted
    compared = 2 + (restarts and restarts + 1)
    assert seen[-1].evaluations == (6 + compared) * surrogate.n_views


def test_masks_that_let_nothing_through_are_refused(square: Object3D, surrogate: Surrogate) -> None:
    masks = torch.zeros(surrogate.n_views, *SIZE, dtype=torch.bool)
    with pytest.raises(SpecError, match="Lower tau"):
        run(square, surrogate, masks=masks)


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


# State and arrays as files


@given(SEEDS, st.sampled_from(["a.png", "Straße 7.png", "x.npy", "step", "file"]))
@settings(max_examples=20)
def test_a_state_comes_back_exactly(seed: int, name: str) -> None:
    generator = torch.Generator().manual_seed(seed)
    deltas = {name: torch.randn(4, 5, 3, generator=generator), "other.png": torch.zeros(1, 1, 3)}
    memory = {name: torch.randn(20, 3, generator=generator), "count": torch.tensor(seed)}
    state = AttackState(seed, deltas, memory)
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
    return ViewDistribution(2, (0, 40), backgrounds=((0, 0, 0),)).sample(n, generator=generator)


def losses(square: Object3D, surrogate: Surrogate, **options: Any) -> list[float]:
    seen: list[Step] = []
    run(square, surrogate, steps=4, on_step=seen.append, **options)
    return [step.loss for step in seen]


def test_a_step_that_draws_views_looks_at_other_ones_than_the_next(square: Object3D, many_views: Surrogate) -> None:
    texels = many_views.texels(textures_of(square))
    with torch.no_grad():
        logits = [fake_classifier().logits(many_views.render(texels, batch)) for batch in range(3)]
    first = losses(square, many_views, views_per_step=10)[0]
    assert any(first == pytest.approx(float(Goal(LABEL).losses(some).mean()), abs=1e-4) for some in logits)
    assert first != pytest.approx(losses(square, many_views)[0], abs=1e-6)


def test_the_seed_decides_which_views_are_drawn(square: Object3D, many_views: Surrogate) -> None:
    drawn = [losses(square, many_views, views_per_step=10, seed=seed) for seed in (1, 1, 2, 3)]
    assert drawn[0] == drawn[1]
    assert drawn[2:] != [drawn[0], drawn[0]]


def test_a_run_over_a_pool_that_was_cut_off_goes_on_bit_for_bit(square: Object3D, many_views: Surrogate) -> None:
    whole = run(square, many_views, steps=5, views_per_step=10, seed=7)
    half = load_state(save_state(run(square, many_views, steps=2, total_steps=5, views_per_step=10, seed=7)))
    assert same(run(square, many_views, steps=3, state=half, views_per_step=10, seed=7), whole)


# The optimisers

OPTIMISERS = get_args(OptimiserName)
SMALL = settings(max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture])


def lengths(optimiser: str, steps: int) -> dict[str, Any]:
    """The options that give a method ``steps`` steps, which is one run each for a method of a single step."""
    return {"optimiser": optimiser, "steps": steps, "restarts": steps - 1 if optimiser == "fgsm" else 0}


def saved(obj: Object3D, state: AttackState, budget: Budget) -> Tensor:
    """Levels by which the textures that are saved differ from ``obj``'s."""
    painted = budget.repaint(obj, state.deltas)
    return torch.cat(
        [
            torch.from_numpy(painted.textures[name]).int() - torch.from_numpy(image).int()
            for name, image in obj.textures.items()
        ]
    )


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_every_method_raises_the_loss(optimiser: str, square: Object3D, surrogate: Surrogate) -> None:
    before = mean_loss(square, surrogate, start(textures_of(square)))
    state = run(square, surrogate, **lengths(optimiser, 1 if optimiser == "fgsm" else 8))
    assert mean_loss(square, surrogate, state) > before + 0.03


def mean_loss(obj: Object3D, surrogate: Surrogate, state: AttackState, goal: Goal | None = None) -> float:
    objective = Objective(textures_of(obj), surrogate, (fake_classifier(),), goal or Goal(LABEL), None)
    return objective.standing(objective.join(state.deltas)).loss


@pytest.mark.parametrize("optimiser", OPTIMISERS)
@given(epsilon=st.floats(1 / 255, 1), share=st.floats(0.05, 1), seed=st.integers(0, 99))
@SMALL
def test_every_method_keeps_the_budget_to_the_last_bit_once_it_is_saved(
    optimiser: str, square: Object3D, surrogate: Surrogate, epsilon: float, share: float, seed: int
) -> None:
    budget = Budget(epsilon, share * epsilon)
    state = run(square, surrogate, budget=budget, random_start=True, seed=seed, **lengths(optimiser, 3))
    delta, texture = state.deltas["m0.png"], textures_of(square)["m0.png"]
    assert saved(square, state, budget).abs().max() <= np.floor(epsilon * 255 + 1e-6)
    assert delta.abs().max() <= epsilon + EPS
    assert 0 <= (texture + delta).min() <= (texture + delta).max() <= 1


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_no_method_moves_a_texel_outside_of_the_mask(optimiser: str, square: Object3D, surrogate: Surrogate) -> None:
    allowed = {name: torch.zeros(16, 16, dtype=torch.bool) for name in square.textures}
    allowed["m0.png"][3:9, 4:12] = True
    options = lengths(optimiser, 4) | {"restarts": 3 if optimiser == "fgsm" else 1}
    state = run(square, surrogate, texels=allowed, random_start=True, **options)
    moved = {name: (delta != 0).any(dim=2) for name, delta in state.deltas.items()}
    assert moved["m0.png"].any()
    assert not any((moved[name] & ~allowed[name]).any() for name in moved)


@pytest.mark.parametrize("optimiser", OPTIMISERS)
@given(cut=st.integers(1, 6), restarts=st.integers(0, 2), seed=st.integers(0, 99))
@SMALL
def test_a_run_that_was_cut_anywhere_goes_on_bit_for_bit(
    optimiser: str, square: Object3D, surrogate: Surrogate, cut: int, restarts: int, seed: int
) -> None:
    options: dict[str, Any] = {"optimiser": optimiser, "seed": seed, "total_steps": 7}
    options |= {"random_start": True, "restarts": 6 if optimiser == "fgsm" else restarts}
    whole = run(square, surrogate, steps=7, **options)
    part = load_state(save_state(run(square, surrogate, steps=cut, **options)))
    assert same(run(square, surrogate, steps=7 - cut, state=part, **options), whole)


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_the_same_seed_gives_the_same_bytes(optimiser: str, square: Object3D, surrogate: Surrogate) -> None:
    options = lengths(optimiser, 3) | {"random_start": True, "seed": 1}
    assert save_state(run(square, surrogate, **options)) == save_state(run(square, surrogate, **options))


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_what_a_step_starts_from_is_left_as_it_was(optimiser: str, square: Object3D, surrogate: Surrogate) -> None:
    options = lengths(optimiser, 4) | {"steps": 2, "total_steps": 4}
    half = run(square, surrogate, **options)
    before = save_state(half)
    run(square, surrogate, state=half, **options)
    assert save_state(half) == before


class Broken(torch.nn.Module):
    """Gives logits that are no numbers, or a gradient that is none, for some images of a batch or for all."""

    def __init__(self, inner: torch.nn.Module, *, every: bool, where: str) -> None:
        super().__init__()
        self.inner, self.every, self.where = inner, every, where

    def forward(self, images: Tensor) -> Tensor:
        broken = torch.ones(len(images), 1, 1, 1, dtype=torch.bool)
        broken[: 0 if self.every else len(images) // 2] = False
        if self.where == "gradient":
            root = torch.where(broken, images - images, 1.0).sqrt()  # its gradient is 0 times infinity where broken
            return self.inner(images + torch.where(broken, root, 0.0))  # type: ignore[no-any-return]
        odd = torch.inf if self.where == "inf" else torch.nan
        return self.inner(images).masked_fill(broken[:, :, 0, 0], odd)  # type: ignore[no-any-return]


@pytest.mark.parametrize("where", ["gradient", "inf", "nan"])
@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_a_classifier_that_fails_on_some_images_never_makes_nan(
    optimiser: str, where: str, square: Object3D, surrogate: Surrogate
) -> None:
    state = attack_with_broken(square, surrogate, optimiser, every=False, where=where)
    assert all(torch.isfinite(delta).all() for delta in state.deltas.values())
    assert (state.deltas["m0.png"] != 0).any()


@pytest.mark.parametrize("where", ["gradient", "inf", "nan"])
@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_a_classifier_that_fails_on_all_images_leaves_the_object_alone(
    optimiser: str, where: str, square: Object3D, surrogate: Surrogate
) -> None:
    state = attack_with_broken(square, surrogate, optimiser, every=True, where=where)
    assert all((delta == 0).all() for delta in state.deltas.values())


def attack_with_broken(obj: Object3D, surrogate: Surrogate, optimiser: str, *, every: bool, where: str) -> AttackState:
    classifier = fake_classifier()
    broken: Any = replace(classifier, network=Broken(classifier.network, every=every, where=where))
    textures = textures_of(obj)
    options: Any = lengths(optimiser, 1 if optimiser == "fgsm" else 3)
    return attack(start(textures), textures, surrogate, broken, goal=Goal(LABEL), budget=Budget(0.1, 0.03), **options)


def won_classifier() -> NetworkClassifier:
    """One that is fooled by anything, safely."""
    last = torch.nn.Linear(3, 10)
    with torch.no_grad():
        last.bias.fill_(50.0)[LABEL] = -50.0
    return replace(
        fake_classifier(), network=torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), last)
    )


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_a_classifier_that_is_fooled_everywhere_leaves_the_object_alone(
    optimiser: str, square: Object3D, surrogate: Surrogate
) -> None:
    seen: list[Step] = []
    textures = textures_of(square)
    options: Any = lengths(optimiser, 1 if optimiser == "fgsm" else 3) | {"budget": Budget(0.1, 0.1)}
    state = attack(
        start(textures), textures, surrogate, won_classifier(), goal=Goal(LABEL), on_step=seen.append, **options
    )
    assert {step.fooled for step in seen} == {1.0}
    rise = 1.0 if optimiser == "auto" else RISE
    assert [step.loss for step in seen] == pytest.approx([SAFE_MARGIN * rise**step.step for step in seen])
    assert all((delta == 0).all() for delta in state.deltas.values())


def test_momentum_is_that_of_dong_et_al(square: Object3D, surrogate: Surrogate) -> None:
    options: dict[str, Any] = {"steps": 1, "total_steps": 3, "optimiser": "momentum"}
    one = run(square, surrogate, **options)
    two = run(square, surrogate, state=one, **options)
    sizes = [2 * 0.02 * (3 - done - 0.5) / 3 for done in (0, 1)]
    mean, name = one.memory["momentum"], "m0.png"
    assert float(mean.abs().sum()) == pytest.approx(1, abs=1e-4)
    torch.testing.assert_close(one.deltas[name].flatten(0, 1), sizes[0] * mean[:256].sign(), atol=EPS, rtol=0)
    step = (two.deltas[name] - one.deltas[name]).flatten(0, 1)
    torch.testing.assert_close(step, sizes[1] * two.memory["momentum"][:256].sign(), atol=EPS, rtol=0)


def test_nesterov_takes_the_gradient_one_momentum_step_ahead(square: Object3D, surrogate: Surrogate) -> None:
    seen: list[Step] = []
    one = run(square, surrogate, steps=1, total_steps=3, optimiser="nesterov")
    run(square, surrogate, steps=1, total_steps=3, optimiser="nesterov", state=one, on_step=seen.append)
    ahead = 0.9 * 0.02 * one.memory["momentum"][:256].sign().view(16, 16, 3)
    there = one.deltas | {"m0.png": (one.deltas["m0.png"] + ahead).clamp(-0.06, 0.06)}
    assert seen[0].loss == pytest.approx(mean_loss(square, surrogate, AttackState(1, there)), abs=1e-5)


def test_fgsm_is_one_step_of_the_whole_budget(square: Object3D, surrogate: Surrogate) -> None:
    delta = run(square, surrogate, steps=1, optimiser="fgsm").deltas["m0.png"]
    moved = delta[delta != 0].abs()
    torch.testing.assert_close(moved, torch.full_like(moved, 0.06), atol=EPS, rtol=0)


def test_auto_ends_at_the_best_point_it_has_seen(square: Object3D, surrogate: Surrogate) -> None:
    seen: list[Step] = []
    state = run(square, surrogate, steps=9, optimiser="auto", on_step=seen.append)
    assert mean_loss(square, surrogate, state) >= max(step.loss for step in seen) - 1e-5


def stepped(name: OptimiserName, gradients: list[Tensor], losses: list[float], *, length: int) -> list[Point]:
    """Where a method goes, within a budget of 0.5 around grey, along gradients of a run of ``length`` steps."""
    points = [Point(torch.zeros(4, 3), {})]
    box = Box(Budget(0.5, 0.01), torch.full((4, 3), 0.5))
    for done, (gradient, loss) in enumerate(zip(gradients, losses, strict=True)):
        points.append(METHODS[name].step(points[-1], gradient, loss, Pace(done, length), box))
    return points


def drawn_gradients(count: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(4, 3, generator=generator) for _ in range(count)]


def test_adam_is_that_of_kingma_and_ba_along_gradients_of_one_size() -> None:
    gradients, length = drawn_gradients(8), 8
    points = stepped("adam", gradients, [0.0] * 8, length=length)
    leaf = torch.zeros(4, 3, requires_grad=True)
    theirs = torch.optim.Adam([leaf], maximize=True)
    for done, gradient in enumerate(gradients):
        theirs.param_groups[0]["lr"] = 0.01 * Pace(done, length).falling
        leaf.grad = gradient * (4 / gradient.abs().sum())
        theirs.step()
        torch.testing.assert_close(points[done + 1].delta, leaf.detach(), atol=1e-6, rtol=1e-4)


def test_auto_mixes_three_quarters_of_a_step_with_a_quarter_of_the_last_one() -> None:
    first, second = drawn_gradients(2)
    points = stepped("auto", [first, second], [0.0, 1.0], length=100)
    one = 0.5 * first.sign()
    torch.testing.assert_close(points[1].delta, one)
    there = (one + 1.0 * second.sign()).clamp(-0.5, 0.5)
    expected = (one + 0.75 * (there - one) + 0.25 * (one - 0)).clamp(-0.5, 0.5)
    torch.testing.assert_close(points[2].delta, expected)


RISING = [float(k) for k in range(42)]
STUCK = [*RISING[:16], *[0.0] * 26]
OVERTAKEN_BY_NOTHING = [*(100.0 + k for k in range(23)), *RISING[:19]]


@pytest.mark.parametrize(
    ("losses", "sizes"),
    [
        pytest.param(RISING, (1.0, 1.0), id="what rises goes on"),
        pytest.param(STUCK, (0.5, 0.25), id="few rises"),
        pytest.param(OVERTAKEN_BY_NOTHING, (1.0, 0.5), id="rises that come to nothing new"),
    ],
)
def test_auto_halves_its_step_where_progress_stalls_and_goes_back_to_the_best(
    losses: list[float], sizes: tuple[float, float]
) -> None:
    points = stepped("auto", drawn_gradients(42), losses, length=100)
    assert [float(points[check + 1].memory["progress"][0]) for check in (22, 41)] == list(sizes)
    best = points[losses.index(max(losses))].delta
    assert torch.equal(points[42].memory["best"], best)
    assert torch.equal(points[42].memory["previous"], best)


def test_of_several_runs_the_best_one_wins(square: Object3D, surrogate: Surrogate) -> None:
    options: dict[str, Any] = {"optimiser": "pgd", "restarts": 2, "total_steps": 6, "seed": 3}
    ends = [run(square, surrogate, steps=2 * count, **options) for count in (1, 2, 3)]
    losses = [mean_loss(square, surrogate, state) for state in ends]
    assert len(set(losses)) > 1
    assert losses[2] >= max(losses) - 1e-6


def test_a_search_can_begin_at_a_change_that_is_known(square: Object3D, surrogate: Surrogate) -> None:
    known = run(square, surrogate, steps=4)
    again = run(square, surrogate, steps=1, state=AttackState(0, known.deltas), budget=Budget(0.06, 1e-4))
    assert (again.deltas["m0.png"] - known.deltas["m0.png"]).abs().max() <= 1e-4 + EPS


def test_every_run_looks_at_all_views_again_and_once_more_at_what_it_found(
    square: Object3D, surrogate: Surrogate
) -> None:
    seen: list[Step] = []
    textures = textures_of(square)
    options: Any = {"budget": Budget(0.1, 0.1), "steps": 4, "restarts": 1, "on_step": seen.append}
    attack(start(textures), textures, surrogate, won_classifier(), goal=Goal(LABEL), **options)
    assert [step.evaluations for step in seen] == [12, 24, 36, 48]


def test_a_random_start_fills_the_budget_of_the_texels_that_may_move(square: Object3D, surrogate: Surrogate) -> None:
    state = run(square, surrogate, steps=1, budget=Budget(0.06, 1e-6), random_start=True)
    delta = state.deltas["m0.png"]
    assert 0.055 < delta.max() <= 0.06 + EPS
    assert -0.06 - EPS <= delta.min() < -0.055
    assert (state.deltas["m1.png"] == 0).all()
    other = run(square, surrogate, steps=1, budget=Budget(0.06, 1e-6), random_start=True, seed=1)
    assert not torch.equal(other.deltas["m0.png"], delta)


# Options that contradict each other


@pytest.mark.parametrize(
    ("options", "message"),
    [
        pytest.param({"optimiser": "fgsm", "steps": 2}, "single step: ask for 1", id="two steps of a single one"),
        pytest.param({"optimiser": "sgd", "steps": 2}, "choose one of fgsm, pgd", id="an unknown method"),
        pytest.param({"restarts": 3, "steps": 3}, "too few for 3 restarts", id="more runs than steps"),
        pytest.param({"restarts": -1, "steps": 3}, "0 or more", id="fewer runs than none"),
        pytest.param({"total_steps": 2, "steps": 3}, "total_steps is 2", id="more steps than there are"),
        pytest.param({"goal": Goal(10), "steps": 1}, "10 classes", id="a class that there is not"),
    ],
)
def test_contradictions_are_refused_before_any_work(
    options: dict[str, Any], message: str, square: Object3D, surrogate: Surrogate
) -> None:
    seen: list[Step] = []
    with pytest.raises(SpecError, match=message):
        run(square, surrogate, on_step=seen.append, **options)
    assert seen == []


# Several classifiers


def ensemble(*seeds: int) -> list[NetworkClassifier]:
    return [fake_classifier(seed=seed) for seed in seeds]


def test_the_loss_of_several_classifiers_is_their_mean(square: Object3D, surrogate: Surrogate) -> None:
    textures, change = textures_of(square), torch.zeros(512, 3)
    looks = [
        Objective(textures, surrogate, tuple(members), Goal(LABEL), None).look(
            change, [0, 1], torch.ones(12, dtype=torch.bool)
        )
        for members in (ensemble(0), ensemble(1), ensemble(0, 1))
    ]
    assert looks[2].loss == pytest.approx((looks[0].loss + looks[1].loss) / 2, abs=1e-5)
    torch.testing.assert_close(looks[2].gradient, (looks[0].gradient + looks[1].gradient) / 2, atol=1e-6, rtol=1e-4)
    assert looks[2].fooled <= min(looks[0].fooled, looks[1].fooled)
    assert looks[2].images == looks[0].images == 12


def test_a_view_is_fooled_when_every_classifier_is(square: Object3D, surrogate: Surrogate) -> None:
    seen: list[Step] = []
    textures = textures_of(square)
    members = ensemble(0, 1)
    attack(
        start(textures),
        textures,
        surrogate,
        members,
        goal=Goal(LABEL),
        budget=Budget(0.1, 0.1),
        steps=1,
        on_step=seen.append,
    )
    with torch.no_grad():
        images = surrogate.render_all(surrogate.texels(textures))
        reached = [Goal(LABEL).reached(member.logits(images)) for member in members]
    assert reached[0].tolist() != reached[1].tolist()
    assert seen[0].fooled == float((reached[0] & reached[1]).float().mean())


def test_a_classifier_of_another_image_size_is_refused(square: Object3D, surrogate: Surrogate) -> None:
    textures = textures_of(square)
    members = [fake_classifier(), fake_classifier(image_size=(48, 48))]
    with pytest.raises(SpecError, match=r"\(48, 48\).*\(32, 32\)"):
        attack(start(textures), textures, surrogate, members, goal=Goal(LABEL), budget=Budget(0.1, 0.1), steps=1)
    with pytest.raises(SpecError, match="no classifier"):
        attack(start(textures), textures, surrogate, [], goal=Goal(LABEL), budget=Budget(0.1, 0.1), steps=1)


# Views: their order, and those that rest


@given(seed=st.integers(0, 99))
@SMALL
def test_the_order_of_the_views_does_not_matter_beyond_rounding(square: Object3D, seed: int) -> None:
    views = pool(13, seed=1)
    shuffled = [views[index] for index in np.random.default_rng(seed).permutation(len(views))]
    looks = [look_at_all(square, some) for some in (views, shuffled)]
    assert looks[0].loss == pytest.approx(looks[1].loss, abs=1e-5)
    assert looks[0].fooled == looks[1].fooled
    torch.testing.assert_close(looks[0].gradient, looks[1].gradient, atol=1e-5, rtol=1e-3)


def look_at_all(obj: Object3D, views: list[View]) -> Any:
    made = diffuse_surrogate(prepare_geometry(obj, views, size=SIZE, sampling=SamplingModel()), views)
    objective = Objective(textures_of(obj), made, (fake_classifier(),), Goal(LABEL), None)
    return objective.look(torch.zeros(512, 3), range(len(made.batches)), torch.ones(len(views), dtype=torch.bool))


def test_only_the_views_that_are_awake_are_looked_at(square: Object3D, surrogate: Surrogate) -> None:
    objective = Objective(textures_of(square), surrogate, (fake_classifier(),), Goal(LABEL), None)
    awake = torch.zeros(12, dtype=torch.bool)
    awake[[1, 4, 11]] = True
    change = torch.zeros(512, 3)
    some, rest = (objective.look(change, [0, 1], which) for which in (awake, ~awake))
    everything = objective.look(change, [0, 1], awake | True)
    assert (some.images, rest.images) == (3, 9)
    torch.testing.assert_close(some.gradient + rest.gradient, everything.gradient, atol=1e-5, rtol=1e-3)
    total = some.loss * 12 - 9 * SAFE_MARGIN + rest.loss * 12 - 3 * SAFE_MARGIN
    assert total / 12 == pytest.approx(everything.loss, abs=1e-5)
    none = objective.look(change, [0, 1], torch.zeros(12, dtype=torch.bool))
    assert (none.images, none.loss, none.fooled) == (0, SAFE_MARGIN, 1.0)
    assert not none.gradient.any()


def test_views_that_are_safely_won_rest_and_are_looked_at_again(square: Object3D, surrogate: Surrogate) -> None:
    seen: list[Step] = []
    textures = textures_of(square)
    attack(
        start(textures),
        textures,
        surrogate,
        won_classifier(),
        goal=Goal(LABEL),
        budget=Budget(0.1, 0.1),
        steps=5,
        on_step=seen.append,
    )
    assert [step.evaluations for step in seen] == [12, 12, 12, 24, 24]
    assert [step.fooled for step in seen] == [1.0] * 5


# The safe margin, and the end of a search


def won_run(obj: Object3D, surrogate: Surrogate, *, state: AttackState | None = None, **options: Any) -> AttackState:
    """A search on a classifier that is fooled from the beginning."""
    textures = textures_of(obj)
    options = {"goal": Goal(LABEL), "budget": Budget(0.1, 0.1)} | options
    return attack(state or start(textures), textures, surrogate, won_classifier(), **options)


def test_a_search_that_has_won_everything_safely_takes_no_further_steps(square: Object3D, surrogate: Surrogate) -> None:
    seen: list[Step] = []
    state = won_run(square, surrogate, steps=40, on_step=seen.append)
    rises = int(np.log(SAFE_ENOUGH / SAFE_MARGIN) / np.log(RISE)) + 1
    assert len(seen) == rises
    assert state.step == 40
    assert all((delta == 0).all() for delta in state.deltas.values())


@given(cut=st.integers(1, 39))
@SMALL
def test_a_search_that_ends_early_can_be_cut_anywhere(square: Object3D, surrogate: Surrogate, cut: int) -> None:
    seen: list[Step] = []
    whole = won_run(square, surrogate, steps=40)
    part = load_state(save_state(won_run(square, surrogate, steps=cut, total_steps=40, on_step=seen.append)))
    ended = won_run(square, surrogate, steps=40 - cut, state=part, on_step=seen.append)
    assert same(ended, whole)
    assert [step.step for step in seen] == list(range(len(seen)))


def test_a_goal_whose_margin_is_out_of_reach_takes_all_steps_with_that(square: Object3D, surrogate: Surrogate) -> None:
    seen: list[Step] = []
    state = won_run(square, surrogate, steps=40, goal=Goal(LABEL, safe=1000.0), on_step=seen.append)
    assert [step.step for step in seen] == list(range(40))
    assert all(90 < step.loss < 110 and step.fooled == 1 for step in seen)
    assert float(state.memory["search.safe"]) == 1000.0


def test_a_method_that_compares_losses_keeps_to_one_margin(square: Object3D, surrogate: Surrogate) -> None:
    seen: list[Step] = []
    won_run(square, surrogate, steps=30, optimiser="auto", on_step=seen.append)
    assert [step.loss for step in seen] == [SAFE_MARGIN] * 30


def test_the_margin_stays_low_while_views_are_to_be_won(square: Object3D, surrogate: Surrogate) -> None:
    state = run(square, surrogate, steps=4, budget=Budget(0.001, 0.001))
    assert float(state.memory["search.safe"]) == SAFE_MARGIN


def test_the_margin_falls_where_views_are_lost_again(square: Object3D, surrogate: Surrogate) -> None:
    known = AttackState(0, start(textures_of(square)).deltas, {"search.safe": torch.tensor(3.0)})
    state = run(square, surrogate, steps=1, state=known, budget=Budget(0.001, 0.001))
    assert float(state.memory["search.safe"]) == pytest.approx(3 / RISE)


def test_every_run_begins_with_the_low_margin(square: Object3D, surrogate: Surrogate) -> None:
    before = won_run(square, surrogate, steps=10, total_steps=20, restarts=1)
    after = won_run(square, surrogate, steps=1, total_steps=20, restarts=1, state=before)
    assert float(before.memory["search.safe"]) > 3
    assert float(after.memory["search.safe"]) == pytest.approx(SAFE_MARGIN * RISE)


@given(length=st.integers(1, 2000))
@settings(max_examples=40)
def test_the_step_falls_to_nothing_in_every_round_and_rounds_grow(length: int) -> None:
    falling = [Pace(done, length).falling for done in range(length)]
    starts = [0, *(done for done in range(1, length) if falling[done] > falling[done - 1])]
    rounds = np.diff([*starts, length])
    assert np.mean(falling) == pytest.approx(1)
    assert all(later >= 2 * sooner for sooner, later in pairwise(rounds))
    assert len(rounds) == 1 or rounds[0] == ROUND
    for begin, size in zip(starts, rounds, strict=True):
        np.testing.assert_allclose(falling[begin : begin + size], np.arange(2 * size - 1, 0, -2) / size)


# Without any server


def test_a_few_lines_attack_a_shipped_object_without_a_server(tmp_path: Path) -> None:
    entry, classifier = shipped_objects()["mug"], load_classifier("tiny")
    obj, label = load_object(entry.read()), (classifier.classes or ()).index(entry.label)
    views = grid_views(
        distance=entry.distance, elevation=entry.elevation, azimuths=3, elevations=1, background=(255,) * 3
    )
    surrogate = diffuse_surrogate(
        prepare_geometry(obj, views, size=classifier.image_size, sampling=SamplingModel()), views
    )
    seen: list[Step] = []
    textures, budget = textures_of(obj), Budget(epsilon=0.2, alpha=0.05)
    state = attack(
        start(textures), textures, surrogate, classifier, goal=Goal(label), budget=budget, steps=4, on_step=seen.append
    )
    painted = budget.repaint(obj, state.deltas)
    (tmp_path / "adversarial.zip").write_bytes(painted.to_zip())
    again = load_object(tmp_path / "adversarial.zip")
    change = np.abs(again.textures[min(again.textures)].astype(int) - obj.textures[min(obj.textures)])
    assert seen[-1].loss > seen[0].loss
    assert 0 < change.max() <= 51
