"""The step size and the end of a search, as figures alone."""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trompe_server.attack.schedule import (
    GAIN,
    HALVINGS,
    PATIENCE,
    ROUND,
    Memory,
    after_step,
    by_gain,
    in_rounds,
    stalled,
)

LONG = 10_000


def after(steps: Iterable[tuple[float, float]], memory: Memory | None = None) -> Memory:
    """Memory after steps with such shares of fooled views and losses."""
    for fooled, loss in steps:
        memory = after_step(memory or {}, fooled, loss)
    return memory or {}


@given(length=st.integers(1, 2000))
@settings(max_examples=40)
def test_the_step_falls_to_nothing_in_every_round_and_rounds_grow(length: int) -> None:
    falling = [in_rounds(done, length) for done in range(length)]
    starts = [0, *(done for done in range(1, length) if falling[done] > falling[done - 1])]
    rounds = np.diff([*starts, length])
    assert np.mean(falling) == pytest.approx(1)
    assert all(later >= 2 * sooner for sooner, later in pairwise(rounds))
    assert len(rounds) == 1 or rounds[0] == ROUND
    for begin, size in zip(starts, rounds, strict=True):
        np.testing.assert_allclose(falling[begin : begin + size], np.arange(2 * size - 1, 0, -2) / size)


@given(length=st.integers(1, 300))
@settings(max_examples=40)
def test_a_step_of_a_search_that_gains_stays_large_and_falls_to_nothing_at_the_end(length: int) -> None:
    factors = [by_gain({}, done, length) for done in range(length)]
    fall = min(length, ROUND)
    assert factors[:-fall] == [2.0] * (length - fall)
    np.testing.assert_allclose(factors[-fall:], np.arange(2 * fall - 1, 0, -2) / fall)


def test_the_step_halves_whenever_nothing_is_gained_until_the_search_ends() -> None:
    memory, factors = after([(0.5, 0.1)]), list[float]()
    while not stalled(memory):
        factors.append(by_gain(memory, 100, LONG))
        memory = after([(0.5, 0.1)], memory)
    assert factors == [2 / 2**halved for halved in range(HALVINGS + 1) for _ in range(PATIENCE)]


@pytest.mark.parametrize(
    ("figures", "gains"),
    [
        pytest.param((0.51, -1.0), True, id="another view is fooled"),
        pytest.param((0.5, 0.1 + 1.01 * GAIN), True, id="the loss rises"),
        pytest.param((0.5, 0.1 + 0.99 * GAIN), False, id="the loss hardly rises"),
        pytest.param((0.49, -9.0), False, id="a loss"),
    ],
)
def test_one_more_view_or_a_higher_loss_is_a_gain(figures: tuple[float, float], gains: bool) -> None:
    waited = after([(0.5, -2.0), (0.5, 0.1), *[(0.5, 0.1)] * (PATIENCE - 1)])  # one step before a halving
    factor = by_gain(after([figures], waited), 100, LONG)
    assert factor == (2.0 if gains else 1.0)
    assert by_gain(after([figures, *[(0.0, -9.0)] * (PATIENCE - 1)], waited), 100, LONG) == factor


@pytest.mark.parametrize("scale", [1.0, 1e-3], ids=["usual logits", "small logits"])
@pytest.mark.parametrize(("share", "ends"), [(1.3, False), (0.7, True)])
def test_small_gains_add_up(share: float, ends: bool, scale: float) -> None:
    """A slow search goes on if its gains within the patience add up to one."""
    rise = share * GAIN / PATIENCE
    memory = after((0.0, scale * (-2 + rise * step)) for step in range(200))
    assert stalled(memory) == ends
