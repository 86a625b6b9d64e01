"""The paper's constraint on images, |I - I'|_inf <= epsilon_view, for the surrogate's views."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from trompe_server.attack.objective import Flat, Objective

TOLERANCE: Final = 1e-6
"""Excess allowed for rounding of floats."""

AIM: Final = 0.98
"""Share of the bound to which a pixel beyond it is brought. Takes a few rounds; 0.999 takes six times as many."""

LOCAL_ROUNDS: Final = 20
"""Rounds in which only the texels behind the excess shrink; later rounds shrink the whole change."""

SAVED_ROUNDS: Final = 100
"""The same for a change rounded to whole levels, which follows only after some rounds."""

SHARPNESS: Final = 8
"""Exponent of the weighted mean that approximates the maximum over the pixels of a texel."""


@dataclass(frozen=True)
class ViewBudget:
    """Bounds the change of each channel of the surrogate's images by ``epsilon``, in (0, 1].

    clean: colours of the unpainted object by batch.
    """

    objective: Objective
    epsilon: float
    clean: tuple[Float[Tensor, "pixels 3"], ...]

    @classmethod
    @torch.no_grad()
    def of(cls, objective: Objective, epsilon: float) -> "ViewBudget":
        """The bound around the images of the unpainted textures."""
        surrogate = objective.surrogate
        texels = surrogate.texels(objective.textures)
        return cls(objective, epsilon, tuple(surrogate.colours(texels, k)[0] for k in range(len(surrogate.batches))))

    def project(self, delta: Flat) -> Flat:
        """``delta`` with each texel's channel scaled down until all images are within the bound.

        A texel shrinks by about the largest excess among its pixels; other texels stay.
        """
        return self._within(delta, lambda change: change, local_rounds=LOCAL_ROUNDS)

    def saved(self, delta: Flat, *, levels: int) -> Flat:
        """``delta`` if its images are within the bound once it is rounded to at most ``levels`` 8-bit levels; else the
        scaled-down change in whole levels."""

        def rounded(change: Flat) -> Flat:
            return (change * 255).round().clamp(-levels, levels) / 255

        return self._within(delta, rounded, local_rounds=SAVED_ROUNDS)

    def _within(self, delta: Flat, shown: Callable[[Flat], Flat], *, local_rounds: int) -> Flat:
        """``delta`` if the images of ``shown(delta)`` are within the bound; else ``shown`` of a smaller ``delta``."""
        rounds = 0
        while (shrink := self._shrink(shown(delta), local=rounds < local_rounds)) is not None:
            delta, rounds = delta * (1 - shrink), rounds + 1
        return shown(delta) if rounds else delta

    def _shrink(self, delta: Flat, *, local: bool) -> Tensor | None:
        """Share by which each texel's channel must shrink; ``None`` if all images are within the bound."""
        leaf = delta.clone().requires_grad_()
        texels = self.objective.texels(leaf)
        colours = (self.objective.surrogate.colours(texels.detach(), number)[0] for number in range(len(self.clean)))
        change = [(each - clean).abs() for each, clean in zip(colours, self.clean, strict=True)]
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
        """Approximate maximum of ``excess`` over the pixels of each texel, through the mip levels."""
        sums = []
        for power in (SHARPNESS + 1, SHARPNESS):
            total = torch.zeros_like(texels)
            for number, each in enumerate(excess):
                if each.any():
                    total += self.objective.surrogate.spread(each**power, number)
            (at_texels,) = torch.autograd.grad(texels, leaf, total, retain_graph=True)
            sums.append(at_texels)
        return torch.where(sums[1] > 0, sums[0] / sums[1], 0).clamp(0, 1)
