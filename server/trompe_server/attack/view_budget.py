"""The paper's constraint on the images, |I - I'|_inf <= epsilon_view, enforced on the surrogate's views."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from trompe_server.attack.objective import Objective

__all__ = ["ViewBudget"]

Flat = Float[Tensor, "texels 3"]

TOLERANCE: Final = 1e-6
"""How far a pixel may stay beyond the bound, for the rounding of floats."""

AIM: Final = 0.98
"""Share of the bound that a pixel beyond it is brought to: a few rounds do (with 0.999 six times as many)."""

LOCAL_ROUNDS: Final = 20
"""Rounds in which only the texels behind the excess shrink; after them the whole change does."""

SAVED_ROUNDS: Final = 100
"""The same where the change is rounded to whole levels, which takes a few rounds to follow."""

SHARPNESS: Final = 8
"""Exponent of the weighted mean that stands for the maximum over the pixels that read a texel."""


@dataclass(frozen=True)
class ViewBudget:
    """No channel of a pixel of the surrogate's images changes by more than ``epsilon``, in (0, 1].

    clean: the unpainted object's colours, of each batch of views.
    """

    objective: Objective
    epsilon: float
    clean: tuple[Float[Tensor, "pixels 3"], ...]

    @classmethod
    @torch.no_grad()
    def of(cls, objective: Objective, epsilon: float) -> "ViewBudget":
        """The bound around the images of the objective's textures."""
        surrogate = objective.surrogate
        texels = surrogate.texels(objective.textures)
        return cls(objective, epsilon, tuple(surrogate.colours(texels, k)[0] for k in range(len(surrogate.batches))))

    def project(self, delta: Flat) -> Flat:
        """``delta`` with each texel's channel scaled down until all images are within the bound.

        A texel shrinks by about the most that a pixel which reads it must; texels that no such pixel reads stay.
        """
        return self._within(delta, lambda change: change, local_rounds=LOCAL_ROUNDS)

    def saved(self, delta: Flat, *, levels: int) -> Flat:
        """``delta`` where the images are within the bound once it is rounded to 8-bit levels, at most so many, as it is
        saved; else what of it is, in whole levels."""

        def rounded(change: Flat) -> Flat:
            return (change * 255).round().clamp(-levels, levels) / 255

        return self._within(delta, rounded, local_rounds=SAVED_ROUNDS)

    def _within(self, delta: Flat, shown: Callable[[Flat], Flat], *, local_rounds: int) -> Flat:
        """``delta`` where the images of what is ``shown`` of it are within the bound; else what is shown of as much of
        it as is."""
        rounds = 0
        while (shrink := self._shrink(shown(delta), local=rounds < local_rounds)) is not None:
            delta, rounds = delta * (1 - shrink), rounds + 1
        return shown(delta) if rounds else delta

    def _shrink(self, delta: Flat, *, local: bool) -> Tensor | None:
        """By how much each texel's channel must shrink, as a share of it; ``None`` where all images are within."""
        leaf = delta.clone().requires_grad_()
        texels = self.objective.texels(leaf)
        change = [self._change(texels.detach(), number) for number in range(len(self.clean))]
        beyond = [each > self.epsilon + TOLERANCE for each in change]
        if not any(each.any() for each in beyond):
            return None
        excess = [
            torch.where(which, 1 - AIM * self.epsilon / each, 0) for which, each in zip(beyond, change, strict=True)
        ]
        if not local:
            return torch.stack([each.max() for each in excess if len(each)]).max()
        return self._spread(leaf, texels, excess)

    def _spread(self, leaf: Flat, texels: Tensor, excess: list[Tensor]) -> Flat:
        """About the maximum of ``excess`` over the pixels that read each texel, through the mip levels."""
        gathers = [batch.gather for batch in self.objective.surrogate.geometry.batches]
        sums = []
        for power in (SHARPNESS + 1, SHARPNESS):
            total = torch.zeros_like(texels)
            for gather, each in zip(gathers, excess, strict=True):
                if each.any():
                    total += gather.transpose(each**power)
            (at_texels,) = torch.autograd.grad(texels, leaf, total, retain_graph=True)
            sums.append(at_texels)
        return torch.where(sums[1] > 0, sums[0] / sums[1], 0).clamp(0, 1)

    def _change(self, texels: Tensor, number: int) -> Tensor:
        return (self.objective.surrogate.colours(texels, number)[0] - self.clean[number]).abs()
