"""How a step moves: the family of projected gradient methods, each a function of where one stands and the gradient.

``fgsm``      one step of epsilon along the sign (Goodfellow et al. 2015)
``pgd``       steps of alpha along the sign (Madry et al. 2018)
``momentum``  along the sign of accumulated gradients, the step falling linearly from 2 alpha to 0 (Dong et al. 2018);
              a long run falls so again and again, each time for twice as long (Loshchilov and Hutter 2017, SGDR)
``nesterov``  the same, the gradient taken one momentum step ahead (Lin et al. 2020)
``adam``      Adam's step (Kingma and Ba 2015), its size falling likewise, projected
``auto``      steps halved when progress stalls, back to the best point so far; no alpha (Croce and Hein 2020, APGD)

``nesterov`` is the default. At equal steps it ends at a higher loss than ``momentum`` on every object measured, and
than ``auto`` on most; ``auto`` needs no alpha, but twice the memory and two more looks at all views without gradient.

Textures are one flat tensor (texels, 3) here. A texel without gradient stays where it is.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Final, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from trompe_server.attack.budget import Budget

__all__ = ["OPTIMISERS", "Box", "Memory", "Optimiser", "OptimiserName", "Pace", "Point"]

OptimiserName = Literal["fgsm", "pgd", "momentum", "nesterov", "adam", "auto"]

Flat = Float[Tensor, "texels 3"]
Memory = Mapping[str, Tensor]

MOMENTUM: Final = 0.9
ADAM_BETAS: Final = (0.9, 0.999)
AUTO_MOMENTUM: Final = 0.75
AUTO_PROGRESS: Final = 0.75
"""Share of an interval's steps that must raise the loss, or the step is halved."""

ROUND: Final = 30
"""Steps of a run's first round; each round is twice as long as the one before."""

TINY: Final = 1e-30


@dataclass(frozen=True)
class Point:
    """Where a run stands: the change of the textures, and what the method remembers of the way there, by name."""

    delta: Flat
    memory: Memory


@dataclass(frozen=True)
class Pace:
    """How far a run is: ``done`` of its ``length`` steps."""

    done: int
    length: int

    @property
    def falling(self) -> float:
        """Factor of the step that falls linearly from 2 to 0 in each round; its mean is 1."""
        begin, end = self._round
        return 2 * (end - self.done - 0.5) / (end - begin)

    @property
    def _round(self) -> tuple[int, int]:
        """The first step of this round, and the first one after it. The last round takes all that is left."""
        begin, length = 0, ROUND
        while begin + 3 * length <= self.length and self.done >= begin + length:
            begin, length = begin + length, 2 * length
        return begin, begin + length if begin + 3 * length <= self.length else self.length


@dataclass(frozen=True)
class Box:
    """The changes that are allowed: the budget's, around ``texture``."""

    budget: Budget
    texture: Flat

    def ascend(self, delta: Flat, direction: Flat, scale: float = 1.0) -> Flat:
        """``scale`` times alpha along the sign of ``direction``, projected."""
        return self.budget.ascend(delta, direction, self.texture, scale=scale)

    def project(self, delta: Flat) -> Flat:
        """The nearest change that is allowed."""
        return self.budget.project(delta, self.texture)


def _stands(point: Point, pace: Pace, box: Box) -> Flat:
    return point.delta


@dataclass(frozen=True)
class Optimiser:
    """A method.

    step: the next point, from this one, the gradient and the mean loss at ``looks_at``. Returns new tensors.
    looks_at: the change at which the gradient is wanted. The memory's ``best``, where there is one, is the best change
    that a run has seen. compares: the losses of different steps, so that all of them must be of one kind.
    """

    step: Callable[[Point, Flat, float, Pace, Box], Point]
    looks_at: Callable[[Point, Pace, Box], Flat] = _stands
    compares: bool = False


def _fgsm(point: Point, gradient: Flat, loss: float, pace: Pace, box: Box) -> Point:
    return Point(box.ascend(point.delta, gradient, box.budget.epsilon / box.budget.alpha), {})


def _pgd(point: Point, gradient: Flat, loss: float, pace: Pace, box: Box) -> Point:
    return Point(box.ascend(point.delta, gradient), {})


def _momentum(point: Point, gradient: Flat, loss: float, pace: Pace, box: Box) -> Point:
    mean = _remembered(point, "momentum").mul(MOMENTUM).add_(gradient, alpha=1 / _size(gradient))
    return Point(box.ascend(point.delta, mean, pace.falling), {"momentum": mean})


def _ahead(point: Point, pace: Pace, box: Box) -> Flat:
    return box.ascend(point.delta, _remembered(point, "momentum"), MOMENTUM * pace.falling)


def _adam(point: Point, gradient: Flat, loss: float, pace: Pace, box: Box) -> Point:
    first, second = ADAM_BETAS
    scaled = gradient * (len(gradient) / _size(gradient))
    mean = _remembered(point, "mean").mul(first).add_(scaled, alpha=1 - first)
    square = _remembered(point, "square").mul(second).addcmul_(scaled, scaled, value=1 - second)
    steps = int(_remembered(point, "steps", torch.zeros((), dtype=torch.long))) + 1
    spread = square.div(1 - second**steps).sqrt_().add_(1e-8)
    size = box.budget.alpha * pace.falling / (1 - first**steps)
    delta = box.project(torch.addcdiv(point.delta, mean, spread, value=size))
    return Point(delta, {"mean": mean, "square": square, "steps": torch.tensor(steps)})


@dataclass(frozen=True)
class _Progress:
    """APGD's bookkeeping: the step's size and whether the last check halved it, losses, rises since that check."""

    size: float
    best: float
    best_at_check: float
    last: float
    rises: int = 0
    halved: bool = False

    @classmethod
    def of(cls, memory: Memory) -> "_Progress":
        size, best, best_at_check, last, rises, halved = memory["progress"].tolist()
        return cls(size, best, best_at_check, last, int(rises), bool(halved))

    def tensor(self) -> Tensor:
        return torch.tensor(list(vars(self).values()), dtype=torch.float64)

    def seen(self, loss: float) -> "_Progress":
        rises = self.rises + (loss > self.last)
        return _Progress(self.size, max(self.best, loss), self.best_at_check, loss, rises, self.halved)

    def checked(self, interval: int) -> "_Progress":
        """After a check at the end of ``interval`` steps."""
        few = self.rises < AUTO_PROGRESS * interval
        stale = not self.halved and self.best <= self.best_at_check
        halved = few or stale
        return _Progress(self.size / 2 if halved else self.size, self.best, self.best, self.last, 0, halved)


def _auto(point: Point, gradient: Flat, loss: float, pace: Pace, box: Box) -> Point:
    here, sign = point.delta, gradient.sign()
    if not point.memory:
        memory: Memory = {"best": here, "best_sign": sign.to(torch.int8), "previous": here}
        progress = _Progress(2 * box.budget.epsilon, loss, -math.inf, loss)
    else:
        memory, progress = point.memory, _Progress.of(point.memory)
        if loss > progress.best:
            memory = {"best": here, "best_sign": sign.to(torch.int8), "previous": memory["previous"]}
        progress = progress.seen(loss)
    previous, interval = memory["previous"], _checks(pace.length).get(pace.done)
    if interval:
        progress = progress.checked(interval)
        if progress.halved:
            here, previous, sign = memory["best"], memory["best"], memory["best_sign"].to(here.dtype)
    delta = box.ascend(here, sign, progress.size / box.budget.alpha)
    if pace.done:
        delta = box.project(here + AUTO_MOMENTUM * (delta - here) + (1 - AUTO_MOMENTUM) * (here - previous))
    kept = {"best": memory["best"], "best_sign": memory["best_sign"], "previous": here}
    return Point(delta, kept | {"progress": progress.tensor()})


@cache
def _checks(length: int) -> Mapping[int, int]:
    """The steps at which progress is checked, and how many steps after the check before (APGD's schedule)."""
    shares = [0.0, 0.22]
    while shares[-1] < 1:
        shares.append(shares[-1] + max(shares[-1] - shares[-2] - 0.03, 0.06))
    steps = [math.ceil(share * length) for share in shares]
    return {now: now - before for before, now in pairwise(steps) if now > before}


def _remembered(point: Point, name: str, nothing: Tensor | None = None) -> Tensor:
    """What the point remembers by a name; at the beginning of a run nothing, zeros by default."""
    zeros = torch.zeros_like(point.delta) if nothing is None else nothing
    return point.memory.get(name, zeros)


def _size(gradient: Flat) -> float:
    """L1 norm, never zero."""
    return max(float(gradient.abs().sum()), TINY)


OPTIMISERS: Final[Mapping[OptimiserName, Optimiser]] = {
    "fgsm": Optimiser(_fgsm),
    "pgd": Optimiser(_pgd),
    "momentum": Optimiser(_momentum),
    "nesterov": Optimiser(_momentum, _ahead),
    "adam": Optimiser(_adam),
    "auto": Optimiser(_auto, compares=True),
}
