"""Update rules of the attack: projected sign-gradient steps on the texture.

``pgd``       steps of alpha along the sign of the gradient (Madry et al. 2018); the paper's attack
``nesterov``  along the sign of accumulated gradients, the gradient taken one momentum step ahead (Lin et al. 2020);
              ``schedule`` has its step size. The default

Textures are one flat tensor (texels or blocks of them, 3). One without gradient does not move.
"""

from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor

from trompe_server.attack.budget import Box
from trompe_server.attack.objective import Flat
from trompe_server.attack.schedule import Memory
from trompe_shared.api import OptimiserName

MOMENTUM: Final = 0.9

TINY: Final = 1e-30


@dataclass(frozen=True)
class Iterate:
    """Current point of a run: the change of the textures, the memory of the search by name, accumulated gradients."""

    delta: Flat
    memory: Memory
    momentum: Flat | None = None


def gradient_at(optimiser: OptimiserName, point: Iterate, factor: float, box: Box) -> Flat:
    """The change at which a step of ``factor`` alpha takes its gradient."""
    return point.delta if optimiser == "pgd" else box.ascend(point.delta, _momentum(point), MOMENTUM * factor)


def moved(optimiser: OptimiserName, point: Iterate, gradient: Flat, factor: float, box: Box) -> Iterate:
    """The next iterate, in new tensors, after a step of ``factor`` alpha."""
    if optimiser == "pgd":
        return replace(point, delta=box.ascend(point.delta, gradient))
    size = max(float(gradient.abs().sum()), TINY)
    mean = _momentum(point).mul(MOMENTUM).add_(gradient, alpha=1 / size)
    return replace(point, delta=box.ascend(point.delta, mean, factor), momentum=mean)


def _momentum(point: Iterate) -> Tensor:
    return torch.zeros_like(point.delta) if point.momentum is None else point.momentum
