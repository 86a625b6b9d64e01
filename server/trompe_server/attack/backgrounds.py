"""Other backgrounds behind the attacked views in each step, without further probes.

The coverage of each pixel tells how much of the background shows through, so one background can replace another. With
a few backgrounds, a pool of views is worth as many pools.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from trompe_server.surrogate import AnySurrogate, JointSurrogate, Surrogate, joined

STREAM: Final = 4
"""Separates the random numbers of a step's backgrounds from those of its views."""

MIN_WEIGHT: Final = 0.05
"""Added to the weight of each background, so that all are drawn sometimes."""


@dataclass(frozen=True)
class Backgrounds:
    """Backgrounds to draw from, sRGB in 0..255.

    own: index of each view's own background. weights: relative frequency of each in the draw; equal by default.
    """

    pictures: UInt8[Tensor, "pictures H W 3"]
    own: Sequence[int]
    weights: Sequence[float] | None = None

    def weighted(self, recognised: Sequence[bool]) -> "Backgrounds":
        """The same, weighted by the share of each background's views in which the object is ``recognised``, as far as
        that is told: of the first views."""
        known = np.asarray(recognised)
        own = np.asarray(self.own)[: len(known)]
        shares = [known[own == number].mean() if (own == number).any() else 0 for number in range(len(self.pictures))]
        return replace(self, weights=[float(share) + MIN_WEIGHT for share in shares])

    def drawn(self, *, seed: int, step: int) -> Int[Tensor, " views"]:
        """Index of the background drawn for each view by ``seed`` and ``step``."""
        weights = np.ones(len(self.pictures)) if self.weights is None else np.asarray(self.weights)
        generator = np.random.default_rng([seed, step, STREAM])
        return torch.from_numpy(generator.choice(len(weights), size=len(self.own), p=weights / weights.sum()))

    def behind(self, surrogate: AnySurrogate, *, seed: int, step: int) -> AnySurrogate:
        """``surrogate`` in front of the backgrounds ``drawn``."""
        own, now = torch.tensor(list(self.own)), self.drawn(seed=seed, step=step)
        parts = surrogate.parts if isinstance(surrogate, JointSurrogate) else (surrogate,)
        counts = [part.n_views for part in parts]
        views = zip(parts, torch.split(own, counts), torch.split(now, counts), strict=True)
        return joined([self._composed(*each) for each in views])

    def _composed(
        self, surrogate: Surrogate, own: Int[Tensor, " views"], drawn: Int[Tensor, " views"]
    ) -> "_ComposedSurrogate":
        parts = {field.name: getattr(surrogate, field.name) for field in fields(Surrogate) if field.init}
        pictures = self.pictures.to(surrogate.device)
        return _ComposedSurrogate(**parts, pictures=pictures, measured=own, drawn=drawn)


@dataclass(frozen=True, kw_only=True)
class _ComposedSurrogate(Surrogate):
    """A surrogate whose views show the ``drawn`` pictures in place of the ``measured`` ones."""

    pictures: UInt8[Tensor, "pictures H W 3"]
    measured: Int[Tensor, " views"]
    drawn: Int[Tensor, " views"]

    def render(
        self, texels: Float[Tensor, "texels 3"], batch: int, *, masks: Bool[Tensor, "views H W"] | None = None
    ) -> Float[Tensor, "batch 3 H W"]:
        """The views of a batch; arguments as for ``Surrogate.render``."""
        views = self.batches[batch]
        images = super().render(texels, batch, masks=masks)
        measured, drawn = (self._pictures(index[views.start : views.stop]) for index in (self.measured, self.drawn))
        return images + (self._transparency(batch) * (drawn - measured)).permute(0, 3, 1, 2)

    def _pictures(self, index: Int[Tensor, " n"]) -> Float[Tensor, "n H W 3"]:
        return self.pictures[index.to(self.pictures.device)] / 255

    def _transparency(self, batch: int) -> Float[Tensor, "n H W 1"]:
        """Share of the background in each pixel of a batch."""
        some = self.geometry.batches[batch]
        share = torch.ones(len(some.views), *self.geometry.size, 1, device=self.base.device)
        share.view(-1, 1).index_copy_(0, some.pixel, 1 - some.coverage)
        return share
