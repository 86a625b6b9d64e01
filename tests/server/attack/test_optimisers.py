"""The update rules, each on a small scene and against its formula."""

from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.attack_runs import EPS, LABEL, SMALL, SQUARE, mean_loss, random_state, run, steps_of
from trompe_server.attack import AttackState, Budget, Goal, save_state, start
from trompe_server.attack.schedule import REACH
from trompe_server.surrogate import textures_of
from trompe_shared.api import OptimiserName

every_optimiser = pytest.mark.parametrize("optimiser", get_args(OptimiserName))


@every_optimiser
def test_every_optimiser_raises_the_loss(optimiser: str) -> None:
    before = mean_loss(start(textures_of(SQUARE)))
    state = run(steps=8, optimiser=optimiser)
    assert mean_loss(state) > before + 0.03


@every_optimiser
@given(epsilon=st.floats(1 / 255, 1), share=st.floats(0.05, 1), seed=st.integers(0, 99))
@SMALL
def test_every_optimiser_keeps_the_budget_once_saved(optimiser: str, epsilon: float, share: float, seed: int) -> None:
    budget = Budget(epsilon, share * epsilon)
    begin = random_state(budget, seed)
    state = run(steps=3, state=begin, budget=budget, seed=seed, optimiser=optimiser)
    delta, texture = state.deltas["m0.png"], textures_of(SQUARE)["m0.png"]
    painted = budget.repaint(SQUARE, state.deltas).textures
    for name, image in SQUARE.textures.items():
        assert np.abs(painted[name].astype(int) - image).max() <= np.floor(epsilon * 255 + 1e-6)
    assert delta.abs().max() <= epsilon + EPS
    assert 0 <= (texture + delta).min() <= (texture + delta).max() <= 1


@every_optimiser
def test_no_optimiser_moves_a_texel_outside_of_the_mask(optimiser: str) -> None:
    allowed = {name: torch.zeros(16, 16, dtype=torch.bool) for name in SQUARE.textures}
    allowed["m0.png"][3:9, 4:12] = True
    state = run(steps=4, texels=allowed, optimiser=optimiser)
    moved = {name: (delta != 0).any(dim=2) for name, delta in state.deltas.items()}
    assert moved["m0.png"].any()
    assert not any((moved[name] & ~allowed[name]).any() for name in moved)


@every_optimiser
def test_the_same_arguments_give_the_same_bytes_and_leave_the_state_alone(optimiser: str) -> None:
    half = run(steps=2, total_steps=4, seed=1, optimiser=optimiser)
    before = save_state(half)
    once, again = (save_state(run(steps=2, total_steps=4, seed=1, optimiser=optimiser, state=half)) for _ in range(2))
    assert once == again != before
    assert save_state(half) == before


def test_one_pgd_step_of_the_whole_budget_is_fgsm() -> None:
    state = run(steps=1, optimiser="pgd", budget=Budget(0.06, 0.06))
    moved = state.deltas["m0.png"][state.deltas["m0.png"] != 0].abs()
    torch.testing.assert_close(moved, torch.full_like(moved, 0.06), atol=EPS, rtol=0)


def test_nesterov_steps_along_the_sign_of_momentum_one_momentum_step_ahead() -> None:
    one = run(steps=1, total_steps=3, optimiser="nesterov")
    two = run(steps=1, total_steps=3, optimiser="nesterov", state=one)
    sizes = [2 * 0.02 * (3 - done - 0.5) / 3 for done in (0, 1)]
    mean, delta = one.momentum["m0.png"], one.deltas["m0.png"]
    assert float(mean.abs().sum()) == pytest.approx(1, abs=1e-4)
    torch.testing.assert_close(delta, sizes[0] * mean.sign(), atol=EPS, rtol=0)
    step = two.deltas["m0.png"] - delta
    torch.testing.assert_close(step, sizes[1] * two.momentum["m0.png"].sign(), atol=EPS, rtol=0)

    (seen,) = steps_of(steps=1, total_steps=3, optimiser="nesterov", state=one)
    ahead = 0.9 * 0.02 * mean.sign()
    there = {**one.deltas, "m0.png": (delta + ahead).clamp(-0.06, 0.06)}
    assert seen.loss == pytest.approx(mean_loss(AttackState(1, there), Goal(LABEL, reach=REACH)), abs=1e-5)
