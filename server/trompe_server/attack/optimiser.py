"""Update rules of the attack: projected sign-gradient steps on the texture.

``pgd``       steps of alpha along the sign of the gradient (Madry et al. 2018); the paper's attack
``nesterov``  along the sign of accumulated gradients, the gradient taken one momentum step ahead (Lin et al. 2020).
              The step falls linearly from 2 alpha to 0; a long run repeats this in rounds, each twice as long as the
              one before (Loshchilov and Hutter 2017, SGDR). The default

Textures are one flat tensor (texels or blocks of them, 3). One without gradient does not move.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor

from trompe_server.attack.budget import Box
from trompe_server.attack.objective import Flat
from trompe_shared.api import OptimiserName

Memory = Mapping[str, Tensor]

MOMENTUM: Final = 0.9

ROUND: Final = 30
"""Steps of the first round of a run; each round is twice as long as the one before."""

TINY: Final = 1e-30


@dataclass(frozen=True)
class Iterate:
    """Current point of a run: the change of the textures, the memory of the search by name, accumulated gradients."""

    delta: Flat
    memory: Memory
    momentum: Flat | None = None


def step_factor(done: int, length: int) -> float:
    """Factor of the step after ``done`` of ``length`` steps: falls linearly from 2 to 0 in each round, with mean 1."""
    begin, size = 0, ROUND
    while begin + 3 * size <= length and done >= begin + size:
        begin, size = begin + size, 2 * size
    end = begin + size if begin + 3 * size <= length else length  # the last round takes all remaining steps
    return 2 * (end - done - 0.5) / (end - begin)


def gradient_at(optimiser: OptimiserName, point: Iterate, factor: float, box: Box) -> Flat:
    """The change at which a step of ``step_factor`` takes its gradient."""
    return point.delta if optimiser == "pgd" else box.ascend(point.delta, _momentum(point), MOMENTUM * factor)


def moved(optimiser: OptimiserName, point: Iterate, gradient: Flat, factor: float, box: Box) -> Iterate:
    """The next iterate, in new tensors, after a step of ``step_factor``."""
    if optimiser == "pgd":
        return replace(point, delta=box.ascend(point.delta, gradient))
    size = max(float(gradient.abs().sum()), TINY)
    mean = _momentum(point).mul(MOMENTUM).add_(gradient, alpha=1 / size)
    return replace(point, delta=box.ascend(point.delta, mean, factor), momentum=mean)


def _momentum(point: Iterate) -> Tensor:
    return torch.zeros_like(point.delta) if point.momentum is None else point.momentum
