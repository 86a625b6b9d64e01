"""The attack loop on a small scene: ascent, budget, resumption, skipped views, safe margin, odd classifiers."""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from torch import Tensor

from tests.attack_runs import (
    EPS,
    LABEL,
    SIZE,
    SMALL,
    SQUARE,
    SURROGATE,
    constant_classifier,
    fooled_classifier,
    objective_of,
    run,
    same,
    steps_of,
    surrogate_of,
)
from tests.fakes import fake_classifier
from trompe_server.attack import (
    AttackState,
    Backgrounds,
    Budget,
    Goal,
    Step,
    ViewDistribution,
    attack,
    load_state,
    movable,
    save_state,
    start,
)
from trompe_server.attack.goal import SAFE_MARGIN
from trompe_server.attack.schedule import HALVINGS, PATIENCE, REACH, after_step
from trompe_server.attack.search import BEST, RISE, SAFE_ENOUGH, SCORED, finished, went_on
from trompe_server.classifiers import NetworkClassifier, load_classifier, score_based
from trompe_server.image_pipelines import PIPELINES
from trompe_server.judging.metrics import accuracy, texels_altered
from trompe_server.surrogate import SamplingModel, Surrogate, textures_of
from trompe_server.surrogate.blocks import means
from trompe_shared.errors import SpecError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import shipped_objects

BATCHES = range(len(SURROGATE.batches))


def test_a_step_reports_the_mean_over_all_views_before_it_moves() -> None:
    (step,) = steps_of(steps=1)
    logits = fake_classifier().logits(SURROGATE.render_all(SURROGATE.texels(textures_of(SQUARE))))
    assert step.loss == pytest.approx(float(Goal(LABEL, reach=REACH).losses(logits).mean()), abs=1e-4)
    assert step.fooled == float(Goal(LABEL).reached(logits).float().mean())


def test_a_step_goes_along_the_sign_of_the_mean_gradient() -> None:
    leaf = textures_of(SQUARE)["m0.png"].requires_grad_()
    texels = SURROGATE.texels(textures_of(SQUARE) | {"m0.png": leaf})
    logits = fake_classifier().logits(SURROGATE.render_all(texels))
    (gradient,) = torch.autograd.grad(Goal(LABEL, reach=REACH).losses(logits).mean(), leaf)
    clear = gradient.abs() > 1e-6
    delta = run(steps=1).deltas["m0.png"]
    assert clear.float().mean() > 0.5
    torch.testing.assert_close(delta[clear], 0.02 * gradient.sign()[clear], atol=EPS, rtol=0)


def test_a_search_can_begin_at_a_known_change() -> None:
    known = run(steps=4)
    again = run(steps=1, state=AttackState(0, known.deltas), budget=Budget(0.06, 1e-4))
    assert (again.deltas["m0.png"] - known.deltas["m0.png"]).abs().max() <= 1e-4 + EPS


# Saliency masks


def test_with_masks_only_texels_of_masked_pixels_move() -> None:
    masks = torch.zeros(SURROGATE.n_views, *SIZE, dtype=torch.bool)
    masks[:4, 12:18, 12:18] = True
    moved = (run(masks=masks).deltas["m0.png"] != 0).any(dim=2)
    read = SURROGATE.influence(masks)["m0.png"] > 0
    assert moved.any()
    assert not moved[~read].any()
    assert moved.sum() < (run().deltas["m0.png"] != 0).any(dim=2).sum()


class Askew(torch.nn.Module):
    """Class 1 grows with the brightness of a small part of the image (by ``gain``), and falls with that of the rest."""

    def __init__(self, rows: slice, columns: slice, *, gain: float, offset: float = 0.0) -> None:
        super().__init__()
        weights = torch.full((1, 1, *SIZE), -0.003)
        weights[..., rows, columns] = gain
        self.weights, self.offset = torch.nn.Parameter(weights), offset

    def forward(self, images: Tensor) -> Tensor:
        logit = (images * self.weights).sum((1, 2, 3)) + self.offset
        return torch.stack([torch.zeros_like(logit), logit], 1)


@pytest.mark.parametrize(
    ("gain", "lost_at"),
    [(0.001, 0.0), (0.004, 0.0), (0.004, 0.7)],
    ids=["the loss falls", "the loss rises and a view is lost", "the loss rises and a view is lost at the end"],
)
def test_a_masked_attack_ends_at_the_best_that_it_looked_at(gain: float, lost_at: float) -> None:
    """The unmasked pixels pull their texels up; other views of the same texels lose by it."""
    rows, columns = slice(12, 18), slice(20, 26)
    masks = torch.zeros(SURROGATE.n_views, *SIZE, dtype=torch.bool)
    masks[0, rows, columns] = True
    textures = textures_of(SQUARE)

    def askew(offset: float) -> NetworkClassifier:
        return NetworkClassifier("askew", Askew(rows, columns, gain=gain, offset=offset), SIZE, 2)

    def logits(change: Tensor) -> Tensor:
        painted = textures | {"m0.png": textures["m0.png"] + change}
        return askew(0.0).logits(SURROGATE.render_all(SURROGATE.texels(painted)))[:, 1]

    pulled = 0.06 * movable(SURROGATE, Budget(0.06, 0.02), masks)["m0.png"][..., None]
    before, after = logits(torch.zeros_like(textures["m0.png"])), logits(pulled)
    level = (before + lost_at * (after - before))[after < before - 1e-3]
    barely_fooled = askew(1e-4 - float(level.max()))
    seen: list[Step] = []
    state = run(classifier=barely_fooled, goal=Goal(0), masks=masks, budget=Budget(0.06, 0.01), on_step=seen.append)

    objective = objective_of(barely_fooled, goal=Goal(0))
    unpainted = objective.score(torch.zeros_like(objective.source))
    assert min((step.fooled, step.loss) for step in seen) < (unpainted.fooled - 0.01, 0)
    assert (max(step.loss for step in seen) > unpainted.loss + 1e-3) == (gain == 0.004)
    fooled, loss = objective.score(objective.join(state.deltas))
    best = max((step.fooled, step.loss) for step in seen)
    assert (fooled, loss) >= (best[0], best[1] - 1e-6)
    assert (best > (unpainted.fooled, unpainted.loss + 5e-4)) == (lost_at > 0)
    assert seen[-1].evaluations == (6 + 3) * SURROGATE.n_views


def test_movable_texels_change_the_views_by_four_levels() -> None:
    small, large = movable(SURROGATE, Budget(0.004, 0.004)), movable(SURROGATE, Budget(1.0, 0.1))
    influence = SURROGATE.influence()
    for name in SQUARE.textures:
        assert torch.equal(large[name], influence[name] * SURROGATE.footprint[name] >= 4 / 255)
        assert not (small[name] & ~large[name]).any()
    assert not large["m1.png"].any()


@pytest.mark.parametrize("epsilon", [0.01, 0.02, 0.05])
def test_the_same_part_of_a_picture_is_movable_at_any_resolution(epsilon: float) -> None:
    """At 32 x 32 pixels even the coarsest of these textures is finer than the pixels."""
    mug, budget, chosen = load_object(shipped_objects()["mug"].path), Budget(epsilon, epsilon), []
    views = [View(Camera(0.157, azimuth, 20)) for azimuth in (-30, 0, 30)]
    for side in (128, 256, 1024):
        fine = mug.with_textures({name: np.full((side, side, 3), 128, np.uint8) for name in mug.textures})
        mask = torch.stack(list(movable(surrogate_of(fine, views), budget).values()))
        chosen.append(torch.nn.functional.avg_pool2d(mask.float(), side // 128))
    assert 0.05 < chosen[0].mean() < 0.95
    for finer in chosen[1:]:
        assert (finer - chosen[0]).abs().mean() < 0.02


@pytest.mark.thorough
def test_a_picture_stored_at_four_sizes_is_attacked_alike() -> None:
    mug, tiny = shipped_objects()["mug"], load_classifier("tiny")
    assert isinstance(tiny, NetworkClassifier)
    obj, label = load_object(mug.path), (tiny.classes or ()).index(mug.label)
    cameras = ViewDistribution(mug.distance, mug.elevation)
    sets = [cameras.sample(12, generator=np.random.default_rng(seed)) for seed in (0, 1)]
    drops, altered = [], []
    for side in (256, 512, 1024, 2048):
        stored = {name: Image.fromarray(image).resize((side, side)) for name, image in obj.textures.items()}
        sized = obj.with_textures({name: np.array(image) for name, image in stored.items()})
        own, unseen = (surrogate_of(sized, views, size=tiny.image_size) for views in sets)
        budget, textures = Budget(0.05, 0.01), textures_of(sized)
        state = attack(start(textures), textures, own, tiny, goal=Goal(label), budget=budget, steps=6)
        painted = budget.repaint(sized, state.deltas)
        pairs = [(tiny.predict(each.images(sized)), tiny.predict(each.images(painted))) for each in (own, unseen)]
        drops.append([accuracy(before, after, label).a_drop or 0.0 for before, after in pairs])
        altered.append(texels_altered(sized.textures, painted.textures))
    assert min(drops[0]) > 0.1
    assert np.ptp(drops, axis=0).max() <= 1 / 12 + 1e-6  # one view
    assert max(altered) - min(altered) < 0.01


FRONT = [View(Camera(0.3, azimuth, 0)) for azimuth in (-40, 0, 40)]


@pytest.fixture(scope="module")
def fine_square() -> Object3D:
    """The square with a texture much finer than its views show, with black and white texels."""
    image = np.random.default_rng(0).integers(-60, 316, (256, 256, 3)).clip(0, 255).astype(np.uint8)
    return SQUARE.with_textures({"m0.png": image})


@pytest.mark.parametrize("perceptual", [False, True])
@pytest.mark.parametrize("filtered", ["encoded", "linear"])
def test_texels_that_views_do_not_tell_apart_move_together_within_the_budget(
    fine_square: Object3D, filtered: Literal["encoded", "linear"], perceptual: bool
) -> None:
    surrogate = surrogate_of(fine_square, FRONT, sampling=SamplingModel(filtered=filtered))
    budget = Budget(0.12 if perceptual else 0.06, 0.02, perceptual=perceptual)
    state = run(surrogate, obj=fine_square, budget=budget)
    side = 256 >> surrogate.spare_levels["m0.png"]
    assert state.deltas["m0.png"].shape == (side, side, 3)
    assert side < 256
    painted = textures_of(budget.repaint(fine_square, state.deltas))
    change = painted["m0.png"] - textures_of(fine_square)["m0.png"]
    assert change.abs().max() <= budget.levels / 255 + EPS
    saved = means(change, surrogate.spare_levels["m0.png"])
    assert (saved - state.deltas["m0.png"]).abs().max() <= 1.5 / 255  # rounded, and down to a whole level at the bound
    seen = [surrogate.render_all(surrogate.texels(each)) for each in (painted, textures_of(fine_square))]
    before, after = (float(Goal(LABEL).losses(fake_classifier().logits(each)).mean()) for each in reversed(seen))
    assert after > before + 0.02
    halfway = run(surrogate, obj=fine_square, budget=budget, steps=2, total_steps=6)
    assert same(run(surrogate, obj=fine_square, budget=budget, steps=4, total_steps=6, state=halfway), state)


def test_texels_that_may_not_all_move_or_whose_images_are_bounded_move_alone(fine_square: Object3D) -> None:
    surrogate = surrogate_of(fine_square, FRONT)
    bounded = run(surrogate, obj=fine_square, budget=Budget(0.06, 0.02, epsilon_view=0.03), steps=1)
    assert bounded.deltas["m0.png"].shape == (256, 256, 3)
    left = {name: torch.zeros(image.shape[:2], dtype=torch.bool) for name, image in fine_square.textures.items()}
    left["m0.png"][:, :128] = True
    halves = run(surrogate, obj=fine_square, texels=left, steps=1)
    assert len(halves.deltas["m0.png"]) < 256
    left["m0.png"][::2] = False
    state = run(surrogate, obj=fine_square, texels=left, steps=1)
    assert state.deltas["m0.png"].shape == (256, 256, 3)
    assert not state.deltas["m0.png"][~left["m0.png"]].any()


def test_an_attack_without_a_visible_texel_ends_at_once() -> None:
    far = surrogate_of(SQUARE, [View(Camera(5.0, 0, 0))])
    with pytest.raises(SpecError, match=r"epsilon=0.004. Come closer by `distance`, or raise `epsilon`"):
        run(far, budget=Budget(0.004, 0.004))


# The pool: each step evaluates some of the views


def pool(n: int, *, seed: int) -> list[View]:
    generator = np.random.default_rng(seed)
    return ViewDistribution(2, (0, 40), backgrounds=((0, 0, 0),)).sample(n, generator=generator)


@pytest.fixture(scope="module")
def many_views() -> Surrogate:
    return surrogate_of(SQUARE, pool(30, seed=5))


def losses(surrogate: Surrogate, **options: Any) -> list[float]:
    return [step.loss for step in steps_of(surrogate, steps=4, **options)]


def test_each_step_draws_other_views(many_views: Surrogate) -> None:
    texels = many_views.texels(textures_of(SQUARE))
    with torch.no_grad():
        images = [many_views.render(texels, batch) for batch in range(len(many_views.batches))]
        logits = [fake_classifier().logits(each) for each in images]
    first = losses(many_views, views_per_step=5)[0]
    assert any(first == pytest.approx(float(Goal(LABEL).losses(some).mean()), abs=1e-4) for some in logits)
    assert first != pytest.approx(losses(many_views)[0], abs=1e-6)


def test_the_seed_decides_the_drawn_views(many_views: Surrogate) -> None:
    drawn = [losses(many_views, views_per_step=10, seed=seed) for seed in (1, 1, 2, 3)]
    assert drawn[0] == drawn[1]
    assert drawn[2:] != [drawn[0], drawn[0]]


# Resumption

PICTURES = torch.tensor([0, 255], dtype=torch.uint8)[:, None, None, None].expand(2, *SIZE, 3)
RUNS: dict[str, dict[str, Any]] = {
    "pgd": {"optimiser": "pgd"},
    "nesterov": {"optimiser": "nesterov"},
    "pool": {"views_per_step": 10},
    "backgrounds": {"views_per_step": 10, "backgrounds": Backgrounds(PICTURES, [k % 2 for k in range(30)])},
    "view budget": {"budget": Budget(0.3, 0.1, 0.02)},
    "masks": {"masks": torch.rand(SURROGATE.n_views, *SIZE, generator=torch.Generator().manual_seed(0)) < 0.02},
    "masks, view budget": {"masks": torch.ones(SURROGATE.n_views, *SIZE).bool(), "budget": Budget(0.3, 0.1, 0.02)},
    "given up": {"classifier": constant_classifier(), "total_steps": 40},
    "early end": {"classifier": fooled_classifier(), "budget": Budget(0.1, 0.1), "total_steps": 40},
}


@pytest.mark.parametrize("kind", RUNS)
@given(share=st.floats(0.1, 0.9), seed=st.integers(0, 99))
@SMALL
def test_a_run_cut_anywhere_resumes_bit_for_bit(kind: str, many_views: Surrogate, share: float, seed: int) -> None:
    views = many_views if "views_per_step" in RUNS[kind] else SURROGATE
    options: dict[str, Any] = {"seed": seed, "total_steps": 7} | RUNS[kind]
    total, seen = options["total_steps"], list[Step]()
    cut = max(1, round(share * total))
    whole = run(views, steps=total, **options)
    part = load_state(save_state(run(views, steps=cut, on_step=seen.append, **options)))
    ended = run(views, steps=total - cut, state=part, on_step=seen.append, **options)
    assert same(ended, whole)
    assert [step.step for step in seen] == list(range(len(seen)))
    assert (len(seen) == total) == (kind not in ("early end", "given up"))


def test_backgrounds_change_a_run(many_views: Surrogate) -> None:
    plain, drawn = (run(many_views, steps=5, **RUNS[kind]) for kind in ("pool", "backgrounds"))
    assert save_state(plain) != save_state(drawn)


# Odd classifiers


class Broken(torch.nn.Module):
    """Infinite or NaN logits, or a NaN gradient, for half of a batch or for all of it."""

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


@pytest.mark.parametrize("every", [False, True], ids=["some images", "all images"])
@pytest.mark.parametrize("where", ["gradient", "inf", "nan"])
@pytest.mark.parametrize("optimiser", ["pgd", "nesterov"])
def test_a_failing_classifier_never_makes_nan_and_leaves_the_object_alone_if_it_fails_on_all_images(
    optimiser: str, where: str, every: bool
) -> None:
    network = Broken(fake_classifier().network, every=every, where=where)
    broken = NetworkClassifier("broken", network, SIZE, 10)
    state = run(classifier=broken, steps=3, budget=Budget(0.1, 0.03), optimiser=optimiser)
    assert all(torch.isfinite(delta).all() for delta in state.deltas.values())
    assert any((delta != 0).any() for delta in state.deltas.values()) == (not every)
    assert every or (state.deltas["m0.png"] != 0).any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        pytest.param({"optimiser": "sgd"}, "choose one of pgd, nesterov", id="unknown optimiser"),
        pytest.param({"total_steps": 2}, "total_steps is 2", id="more steps than the total"),
        pytest.param({"goal": Goal(10)}, "10 classes", id="unknown class"),
        pytest.param({"classifier": []}, "No classifier", id="no classifier"),
        pytest.param(
            {"classifier": [fake_classifier(), fake_classifier(image_size=(48, 48))]},
            r"\(48, 48\).*\(32, 32\)",
            id="another image size",
        ),
        pytest.param({"masks": torch.zeros(12, *SIZE, dtype=torch.bool)}, "Lower `tau`", id="empty masks"),
    ],
)
def test_contradictions_are_refused_before_any_work(options: dict[str, Any], message: str) -> None:
    seen: list[Step] = []
    with pytest.raises(SpecError, match=message):
        run(steps=3, on_step=seen.append, **options)
    assert seen == []


# Several classifiers


def test_the_loss_of_several_classifiers_is_their_mean() -> None:
    one, other = fake_classifier(seed=0), fake_classifier(seed=1)
    found = [
        objective_of(*members).evaluate(torch.zeros(512, 3), BATCHES, torch.ones(12, dtype=torch.bool))
        for members in ((one,), (other,), (one, other))
    ]
    assert found[2].loss == pytest.approx((found[0].loss + found[1].loss) / 2, abs=1e-5)
    mean = (found[0].gradient + found[1].gradient) / 2
    torch.testing.assert_close(found[2].gradient, mean, atol=1e-6, rtol=1e-4)
    assert found[2].fooled <= min(found[0].fooled, found[1].fooled)
    assert found[2].images == found[0].images == 12


def test_a_view_is_fooled_when_every_classifier_is() -> None:
    members = [fake_classifier(seed=0), fake_classifier(seed=1)]
    (step,) = steps_of(classifier=members, budget=Budget(0.1, 0.1), steps=1)
    with torch.no_grad():
        images = SURROGATE.render_all(SURROGATE.texels(textures_of(SQUARE)))
        reached = [Goal(LABEL).reached(member.logits(images)) for member in members]
    assert reached[0].tolist() != reached[1].tolist()
    assert step.fooled == float((reached[0] & reached[1]).float().mean())


# Skipped views


def test_only_active_views_are_evaluated() -> None:
    objective = objective_of()
    active = torch.zeros(12, dtype=torch.bool)
    active[[1, 4, 11]] = True
    change = torch.zeros(512, 3)
    some, rest = (objective.evaluate(change, BATCHES, which) for which in (active, ~active))
    everything = objective.evaluate(change, BATCHES, active | True)
    assert (some.images, rest.images) == (3, 9)
    torch.testing.assert_close(some.gradient + rest.gradient, everything.gradient, atol=1e-5, rtol=1e-3)
    total = some.loss * 12 - 9 * SAFE_MARGIN + rest.loss * 12 - 3 * SAFE_MARGIN
    assert total / 12 == pytest.approx(everything.loss, abs=1e-5)
    none = objective.evaluate(change, BATCHES, torch.zeros(12, dtype=torch.bool))
    assert (none.images, none.loss, none.fooled) == (0, SAFE_MARGIN, 1.0)
    assert not none.gradient.any()


def test_logits_before_gradients_change_nothing() -> None:
    objective, change, active = objective_of(), torch.zeros(512, 3), torch.ones(12, dtype=torch.bool)
    with torch.no_grad():
        margins = objective.goal.margins(objective.members[0].logits(SURROGATE.render_all(objective.texels(change))))
    objective = replace(objective, goal=replace(objective.goal, safe=float(margins.sort().values[5:7].mean())))
    at_once, after = (
        replace(objective, settling=settling).evaluate(change, BATCHES, active) for settling in (False, True)
    )
    assert 0 < len(at_once.settled) < 12
    torch.testing.assert_close(after.gradient, at_once.gradient, atol=1e-6, rtol=1e-4)
    assert after.settled.tolist() == at_once.settled.tolist()
    assert (after.fooled, after.images) == (at_once.fooled, 12)
    assert after.loss == pytest.approx(at_once.loss)


def test_gradients_are_asked_of_unsettled_images_alone_once_most_are_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    with_graph: list[int] = []
    classifier = fooled_classifier()
    logits = type(classifier).logits

    def counted(self: NetworkClassifier, images: Tensor) -> Tensor:
        with_graph.append(len(images) if torch.is_grad_enabled() else 0)
        return logits(self, images)

    monkeypatch.setattr(type(classifier), "logits", counted)
    state = run(classifier=classifier, budget=Budget(0.1, 0.1), steps=1, total_steps=5)
    assert sum(with_graph) == 12
    with_graph.clear()
    run(state=state, classifier=classifier, budget=Budget(0.1, 0.1), steps=4)
    assert with_graph == [0] * len(with_graph) != []


# The safe margin, and the end of a search


def fooled_run(**options: Any) -> tuple[AttackState, list[Step]]:
    """A search on a classifier that is fooled from the beginning, and its steps."""
    seen: list[Step] = []
    asked: dict[str, Any] = {"budget": Budget(0.1, 0.1)} | options
    return run(classifier=fooled_classifier(), on_step=seen.append, **asked), seen


@pytest.mark.parametrize("optimiser", ["pgd", "nesterov"])
def test_safely_won_views_are_skipped_for_two_steps_and_nothing_moves(optimiser: str) -> None:
    state, seen = fooled_run(steps=5, optimiser=optimiser)
    assert [step.evaluations for step in seen] == [12, 12, 12, 24, 24]
    assert [step.fooled for step in seen] == [1.0] * 5
    assert [step.loss for step in seen] == pytest.approx([SAFE_MARGIN * RISE**step.step for step in seen])
    assert all((delta == 0).all() for delta in state.deltas.values())


def test_a_search_ends_once_all_views_are_safely_won() -> None:
    state, seen = fooled_run(steps=40)
    assert len(seen) == int(np.log(SAFE_ENOUGH / SAFE_MARGIN) / np.log(RISE)) + 1
    assert [step.least_left for step in seen] == list(range(len(seen)))[::-1]
    assert state.step == 40
    assert all((delta == 0).all() for delta in state.deltas.values())


def test_a_goal_with_an_unreachable_margin_runs_all_steps() -> None:
    state, seen = fooled_run(steps=40, goal=Goal(LABEL, safe=1000.0))
    assert [step.step for step in seen] == list(range(40))
    assert all(90 < step.loss < 110 and step.fooled == 1 for step in seen)
    assert [step.least_left for step in seen] == list(range(40))[::-1]
    assert float(state.memory["search.safe"]) == 1000.0


def stubborn_run(surrogate: Surrogate = SURROGATE, **options: Any) -> int:
    """Steps of a search that gains nothing, of at most 50."""
    asked: dict[str, Any] = {"classifier": constant_classifier(), "total_steps": 50} | options
    return len(steps_of(surrogate, steps=50, **asked))


GIVEN_UP = 1 + PATIENCE * (HALVINGS + 1)
"""Steps of a search of which only the first gains."""


def test_a_search_that_gains_nothing_more_ends() -> None:
    assert stubborn_run(goal=Goal(LABEL, loss="cross_entropy")) == GIVEN_UP
    assert stubborn_run() == GIVEN_UP + HALVINGS  # each tries a shorter reach


@pytest.mark.parametrize("kind", ["pgd", "pool", "backgrounds", "pipeline", "queries", "the goal asks for all"])
def test_a_search_whose_steps_do_not_tell_what_they_gain_takes_them_all(kind: str, many_views: Surrogate) -> None:
    others: dict[str, dict[str, Any]] = {
        "pipeline": {"pipeline": PIPELINES["robust"]},
        "queries": {"classifier": score_based(constant_classifier(), seed=0, queries=2, sigma=0.1)},
        "the goal asks for all": {"goal": Goal(LABEL, safe=1000.0)},
    }
    options = (RUNS | others)[kind]
    assert stubborn_run(many_views if "views_per_step" in options else SURROGATE, **options) == 50


@pytest.mark.parametrize("added", [0, 2])
def test_a_search_looks_at_added_views_anew(added: int) -> None:
    given_up = {BEST: torch.zeros(3, 3), SCORED: torch.zeros(2)}
    for _ in range(GIVEN_UP):
        given_up = dict(after_step(given_up, 0.0, -3.0))
    goal = Goal(LABEL)
    assert finished(given_up, goal)
    after = went_on(given_up, goal, shown=7, added=added)
    assert finished(after, goal) == (added == 0)
    assert (BEST in after, SCORED in after) == (added == 0, added == 0)


@pytest.mark.parametrize(
    ("safe", "added", "after"), [(SAFE_MARGIN, 3, SAFE_ENOUGH / RISE**2), (SAFE_MARGIN, 0, 90.0), (90.0, 3, 90.0)]
)
def test_added_views_ask_for_more_steps_unless_the_goal_asks_for_all(safe: float, added: int, after: float) -> None:
    memory = went_on({"search.safe": torch.tensor(90.0)}, Goal(LABEL, safe=safe), shown=7, added=added)
    assert float(memory["search.safe"]) == pytest.approx(after)
    assert int(memory["search.shown"]) == 7


@pytest.mark.parametrize(
    ("before", "steps", "after"),
    [
        pytest.param(SAFE_MARGIN, 4, SAFE_MARGIN, id="stays low while views are not won"),
        pytest.param(3.0, 1, 3 / RISE, id="falls when views are lost again"),
    ],
)
def test_the_margin_follows_the_views(before: float, steps: int, after: float) -> None:
    known = AttackState(0, start(textures_of(SQUARE)).deltas, {"search.safe": torch.tensor(before)})
    seen: list[Step] = []
    state = run(steps=steps, state=known, budget=Budget(0.01, 0.001), on_step=seen.append)
    assert float(state.memory["search.safe"]) == pytest.approx(after)
    assert [step.least_left for step in seen] == [steps - step.step - 1 for step in seen]  # so few that none is spared
