"""Each step sees its views in front of other backgrounds than those they were measured with, at no further probe.

What shows through at a pixel is known from its coverage, so that one background can be exchanged for another: with a
few of them, a pool of views is worth as many pools.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from trompe_server.surrogate import Surrogate

__all__ = ["Backgrounds"]

STREAM: Final = 4
"""Keeps the random numbers of a step's backgrounds apart from those of its views."""


SELDOM: Final = 0.05
"""Added to the share of views by which a background is drawn, so that none is never drawn."""


@dataclass(frozen=True)
class Backgrounds:
    """What can stand behind the object, sRGB in 0..255, and which of it does in each of the surrogate's views.

    odds: how likely each is drawn, in proportion; by default all equally.
    """

    pictures: UInt8[Tensor, "pictures H W 3"]
    own: Sequence[int]
    odds: Sequence[float] | None = None

    def by_need(self, recognised: Sequence[bool]) -> "Backgrounds":
        """The same, drawn in proportion to the share of their own views in which the object is ``recognised``."""
        own, known = np.asarray(self.own), np.asarray(recognised)
        shares = [known[own == number].mean() if (own == number).any() else 0 for number in range(len(self.pictures))]
        return replace(self, odds=[float(share) + SELDOM for share in shares])

    def behind(self, surrogate: Surrogate, *, seed: int, step: int) -> Surrogate:
        """``surrogate`` with its views in front of backgrounds that are drawn by ``seed`` and ``step``."""
        odds = np.ones(len(self.pictures)) if self.odds is None else np.asarray(self.odds)
        generator = np.random.default_rng([seed, step, STREAM])
        drawn = generator.choice(len(odds), size=len(self.own), p=odds / odds.sum())
        parts = {field.name: getattr(surrogate, field.name) for field in fields(Surrogate) if field.init}
        pictures = self.pictures.to(surrogate.base.device)
        return _Elsewhere(**parts, pictures=pictures, was=torch.tensor(list(self.own)), now=torch.from_numpy(drawn))


@dataclass(frozen=True, kw_only=True)
class _Elsewhere(Surrogate):
    """A surrogate whose views stand in front of the pictures ``now`` instead of those they ``was`` measured with."""

    pictures: UInt8[Tensor, "pictures H W 3"]
    was: Int[Tensor, " views"]
    now: Int[Tensor, " views"]

    def render(
        self, texels: Float[Tensor, "texels 3"], batch: int, *, masks: Bool[Tensor, "views H W"] | None = None
    ) -> Float[Tensor, "batch 3 H W"]:
        """See ``Surrogate``."""
        views = self.batches[batch]
        images = super().render(texels, batch, masks=masks)
        was, now = (self._pictures(index[views.start : views.stop]) for index in (self.was, self.now))
        return images + (self._through(batch) * (now - was)).permute(0, 3, 1, 2)

    def _pictures(self, index: Int[Tensor, " n"]) -> Float[Tensor, "n H W 3"]:
        return self.pictures[index.to(self.pictures.device)] / 255

    def _through(self, batch: int) -> Float[Tensor, "n H W 1"]:
        """How much of what stands behind shows at each pixel of a batch."""
        some = self.geometry.batches[batch]
        through = torch.ones(len(some.views), *self.geometry.size, 1, device=self.base.device)
        through.view(-1, 1).index_copy_(0, some.pixel, 1 - some.coverage)
        return through
