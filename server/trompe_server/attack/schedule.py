"""Step size of the default optimiser, as a factor of alpha, and the end of a search that gains nothing more.

Steps that all look at the same images tell what they gain. Their factor is 2, halves whenever ``PATIENCE`` steps gained
nothing (as in Auto-PGD, Croce and Hein 2020), and the search ends instead of the fourth halving. Towards the last step
it falls to 0. Their loss is flat for hopeless views (``reach``), which would outvote those within reach.

Steps that draw their views or what happens to them tell little. Their factor falls linearly from 2 to 0; a long run
repeats this in rounds, each twice as long as the one before (Loshchilov and Hutter 2017, SGDR).
"""

import math
from collections.abc import Mapping
from typing import Final

import torch
from torch import Tensor

Memory = Mapping[str, Tensor]

ROUND: Final = 30
"""Steps of the first round of a run, and of the fall at the end of one without rounds."""

PATIENCE: Final = 8
"""Steps without a gain after which the factor halves."""

GAIN: Final = 0.05
"""Least gain in mean loss, a difference of logits. One more view fooled is a gain, too."""

SHARE: Final = 0.025
"""The same as a share of the first loss, if that is less: a network may have small logits."""

HALVINGS: Final = 3
"""Halvings of the factor before the end."""

REACH: Final = 1.5
"""Margin, a difference of logits, beyond which a lost view counts less and less."""

SHORTER: Final = 0.7
"""Factor of the reach after a halving."""

BEST, WAITED, HALVED = "schedule.best", "schedule.waited", "schedule.halved"
"""Memory: highest share of fooled views, highest loss and least gain; steps since the last gain; halvings so far."""


def in_rounds(done: int, length: int) -> float:
    """Factor of the step after ``done`` of ``length`` steps that draw their views; mean 1."""
    begin, size = 0, ROUND
    while begin + 3 * size <= length and done >= begin + size:
        begin, size = begin + size, 2 * size
    end = begin + size if begin + 3 * size <= length else length  # the last round takes all remaining steps
    return 2 * (end - done - 0.5) / (end - begin)


def by_gain(memory: Memory, done: int, length: int) -> float:
    """Factor of the step after ``done`` of ``length`` steps that look at the same images."""
    fall = min(1.0, (length - done - 0.5) / min(length, ROUND))
    halved = int(memory.get(HALVED, 0))
    return 2 * fall * 0.5**halved


def reach(memory: Memory) -> float:
    """Reach of the goal (``Goal.reach``) of a step of that kind: shorter after each halving, once the easy views are
    won."""
    return REACH * SHORTER ** int(memory.get(HALVED, 0))


def after_step(memory: Memory, fooled: float, loss: float) -> Memory:
    """Memory after a step with such figures."""
    first = -1.0, -math.inf, min(GAIN, SHARE * abs(loss))
    most_fooled, best, least = memory[BEST].tolist() if BEST in memory else first
    rose = loss > best + least
    waited = 0 if rose or fooled > most_fooled else int(memory[WAITED]) + 1
    halved = int(memory.get(HALVED, 0))
    if waited == PATIENCE:
        waited, halved = 0, halved + 1
    now = [max(fooled, most_fooled), loss if rose else best, least]
    return {
        **memory,
        BEST: torch.tensor(now, dtype=torch.float64),
        WAITED: torch.tensor(waited),
        HALVED: torch.tensor(halved),
    }


def anew(memory: Memory) -> Memory:
    """Memory without what earlier steps gained: others are to be looked at."""
    return {key: value for key, value in memory.items() if key not in (BEST, WAITED, HALVED)}


def stalled(memory: Memory) -> bool:
    """Whether further steps would gain nothing."""
    return int(memory.get(HALVED, 0)) > HALVINGS
