"""The goal: each loss against its formula, and extreme logits."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import cross_entropy

from trompe_server.attack import Goal
from trompe_server.attack.goal import SAFE_MARGIN
from trompe_shared.errors import SpecError

CLASSES = 5
LOGITS = st.lists(st.lists(st.floats(-50, 50, width=32), min_size=5, max_size=5), min_size=1, max_size=6)
LOSSES = ("margin", "cross_entropy")
KINDS: dict[str, dict[str, Any]] = {
    "untargeted": {"label": 0},
    "targeted": {"label": 0, "target": 3},
    "top-3": {"label": 0, "top_k": 3},
    "several classes": {"label": (0, 2)},
    "several classes, top-3": {"label": (0, 2), "top_k": 3},
}
GOALS = {f"{loss}, {kind}": Goal(**KINDS[kind] | {"loss": loss}) for loss in LOSSES for kind in KINDS}
every_goal = pytest.mark.parametrize("goal", GOALS.values(), ids=GOALS)
SETS = st.permutations(range(5)).flatmap(lambda order: st.integers(1, 4).map(lambda n: tuple(order[:n])))
"""Some of the five classes, but not all."""


@given(LOGITS, st.integers(0, 3))
@settings(max_examples=100)
def test_a_targeted_goal_is_reached_where_the_target_is_the_best_class(rows: list[list[float]], target: int) -> None:
    goal, logits = Goal(4, target=target), torch.tensor(rows)
    margins = goal.margins(logits)
    for row, margin, reached in zip(rows, margins, goal.reached(logits), strict=True):
        assert float(margin) == pytest.approx(row[target] - max(row[:target] + row[target + 1 :]), abs=1e-5)
        assert bool(reached) == (row.index(max(row)) == target)


@given(LOGITS, SETS, st.integers(1, 4))
@settings(max_examples=100)
def test_each_class_of_a_set_counts_as_the_object(rows: list[list[float]], labels: tuple[int, ...], k: int) -> None:
    k = min(k, CLASSES - len(labels))
    goal, logits = Goal(labels, top_k=k), torch.tensor(rows)
    for row, margin, reached in zip(rows, goal.margins(logits), goal.reached(logits), strict=True):
        best, others = max(row[label] for label in labels), [x for j, x in enumerate(row) if j not in labels]
        assert float(margin) == pytest.approx(sorted(others, reverse=True)[k - 1] - best, abs=1e-5)
        assert bool(reached) is (margin > 0).item() or margin == 0
    torch.testing.assert_close(goal.losses(logits), goal.margins(logits).clamp(max=SAFE_MARGIN))
    assert torch.equal(logits, torch.tensor(rows))
    shares = logits.softmax(1)[:, list(labels)].sum(1)
    torch.testing.assert_close((-Goal(labels, loss="cross_entropy").losses(logits)).exp(), shares, atol=1e-6, rtol=1e-4)


@given(LOGITS, st.integers(0, 4), st.sampled_from(LOSSES))
@settings(max_examples=100)
def test_a_set_of_one_class_gives_the_bytes_of_the_formula(rows: list[list[float]], label: int, loss: Any) -> None:
    leaf, same = (torch.tensor(rows).requires_grad_() for _ in range(2))
    losses = Goal((label,), loss=loss).losses(leaf, clamped=False)
    others = same.clone()
    others[:, label] = -torch.inf
    wanted = {
        "margin": lambda: others.topk(1, dim=1).values[:, -1] - same[:, label],
        "cross_entropy": lambda: cross_entropy(same, torch.full((len(rows),), label), reduction="none"),
    }[loss]()
    assert torch.equal(losses, wanted)
    assert torch.equal(*(torch.autograd.grad(each.sum(), x)[0] for each, x in ((losses, leaf), (wanted, same))))


def test_cross_entropy_is_that_of_the_class_one_leaves_or_minus_that_of_the_target() -> None:
    logits = torch.tensor([[1.0, 2.0, 0.0, -1.0, 0.5], [30.0, -30.0, 0.0, 0.0, 0.0]])
    log_shares = logits.log_softmax(1)
    torch.testing.assert_close(Goal(1, loss="cross_entropy").losses(logits), -log_shares[:, 1])
    torch.testing.assert_close(Goal(1, target=0, loss="cross_entropy").losses(logits), log_shares[:, 0])


@every_goal
def test_a_small_step_along_the_gradient_raises_the_loss(goal: Goal) -> None:
    logits = torch.tensor([[4.0, 1.0, 2.5, -1.0, 0.0]])
    leaf = logits.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(goal.losses(leaf).sum(), leaf)
    assert goal.losses(logits + 1e-3 * gradient.sign()) > goal.losses(logits)


EXTREME = [
    [0.0, 9.0, 1.0, 2.0, 3.0],
    [9.0, 0.0, 1.0, 2.0, 3.0],
    [9.0, -9.0, 1.0, 2.0, 3.0],
    [0.0] * 5,
    [9.0, 9.0, 9.0, 9.0, 0.0],
]


@pytest.mark.parametrize("size", [1.0, 1e4, 1e30])
@every_goal
def test_saturated_and_equal_logits_give_finite_losses_and_gradients(goal: Goal, size: float) -> None:
    check_finite(goal, torch.tensor(EXTREME) * size)


@every_goal
@pytest.mark.parametrize("odd", [torch.inf, -torch.inf, torch.nan])
def test_logits_that_are_not_finite_give_finite_losses_and_gradients(goal: Goal, odd: float) -> None:
    for count in range(1, CLASSES + 1):
        logits = torch.tensor(EXTREME)
        logits[:, :count] = odd
        check_finite(goal, logits)
        check_finite(goal, logits.flip(1))


def check_finite(goal: Goal, logits: Tensor) -> None:
    leaf = logits.clone().requires_grad_()
    losses = goal.losses(leaf)
    (gradient,) = torch.autograd.grad(losses.sum(), leaf)
    assert torch.isfinite(losses).all()
    assert torch.isfinite(gradient).all()
    assert torch.isfinite(goal.margins(logits)).all()


def test_the_loss_of_a_lost_view_flattens_beyond_the_reach_and_never_quite() -> None:
    away = torch.tensor([0.5, -1e-4, -0.5, -2.0, -8.0, -80.0])
    logits = torch.stack([torch.zeros(6), away], 1).requires_grad_()
    (gradient,) = torch.autograd.grad(Goal(0, reach=2.0).losses(logits).sum(), logits)
    weights = gradient[:, 1]
    assert weights[:2].tolist() == pytest.approx([1, 1.001])
    assert (weights[1:-1] > weights[2:]).all()
    assert weights[3] < 0.5
    assert 0.001 <= weights[-1] < 0.0011
    far = Goal(0).losses(logits)
    assert torch.autograd.grad(far.sum(), logits)[0][:, 1].tolist() == [1] * 6
    torch.testing.assert_close(far, Goal(0).margins(logits))


def test_only_a_margin_that_is_safe_settles_a_view_and_its_gradient_is_zero() -> None:
    logits = torch.tensor([[0.0, SAFE_MARGIN + 0.1, 0, 0, 0], [0.0, SAFE_MARGIN - 0.1, 0, 0, 0]])
    assert Goal(0).settled(logits).tolist() == [True, False]
    assert not Goal(0, loss="cross_entropy").settled(logits * 100).any()
    leaf = logits.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(Goal(0).losses(leaf).sum(), leaf)
    assert gradient.any(1).tolist() == [False, True]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        pytest.param({"target": 2}, "the object's own class", id="the target is the true class"),
        pytest.param({"label": (1, 4), "target": 4}, "the object's own class", id="the target is one of several"),
        pytest.param({"top_k": 0}, "at least 1", id="no best class"),
        pytest.param({"target": 1, "top_k": 2}, "use one of the two", id="towards one class and away from many"),
        pytest.param({"loss": "hinge"}, "margin, cross_entropy", id="an unknown loss"),
    ],
)
def test_a_goal_that_contradicts_itself_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        Goal(**{"label": 2} | options)


@pytest.mark.parametrize(
    ("goal", "n_classes", "message"),
    [
        pytest.param(Goal(5), 5, "label 5 .* 5 classes", id="no such class"),
        pytest.param(Goal(-1), 5, "label -1", id="a negative class"),
        pytest.param(Goal(0, target=5), 5, "target class 5", id="no such target"),
        pytest.param(Goal(0, top_k=5), 5, "other than the object's, 4; got 5", id="every class is among the best"),
        pytest.param(Goal((0, 1), top_k=4), 5, "other than the object's, 3; got 4", id="every other class is"),
        pytest.param(Goal((0, 3, 0)), 5, "0 and 0 are the same class, 0", id="a class twice"),
        pytest.param(Goal((2, 0, 1)), 3, "3 of the classifier's 3 classes", id="no other class"),
        pytest.param(Goal(()), 3, "0 of the classifier's 3 classes", id="no class"),
    ],
)
def test_a_goal_that_the_classifier_cannot_have_is_refused(goal: Goal, n_classes: int, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        goal.check(n_classes)


def test_a_class_may_be_a_number_of_numpy() -> None:
    assert Goal(np.int64(3)) == Goal(3)
    assert torch.equal(Goal(np.int64(3)).margins(torch.eye(5)), Goal(3).margins(torch.eye(5)))


def test_a_goal_that_the_classifier_can_have_is_accepted() -> None:
    for goal in (Goal(4), Goal(0, target=4), Goal(0, top_k=4), Goal((3, 1), top_k=3)):
        goal.check(5)
