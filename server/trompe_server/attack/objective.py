"""What the search asks at each step: how a change of the textures looks to the classifiers, and where it should go.

Textures are one flat tensor here, (texels, 3): those texels of all of the object's that may move, in the order of the
surrogate's canvas.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from trompe_server.attack.goal import Goal
from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.surrogate import Canvas, Surrogate
from trompe_shared.errors import SpecError

__all__ = ["Look", "Objective", "Standing", "Textures", "members_of"]

Textures = Mapping[str, Float[Tensor, "H W 3"]]
Flat = Float[Tensor, "texels 3"]


def members_of(
    classifier: WhiteBoxClassifier | Sequence[WhiteBoxClassifier], goal: Goal
) -> tuple[WhiteBoxClassifier, ...]:
    """One classifier or several as a tuple. Raises ``SpecError`` where there is none or ``goal`` does not fit one."""
    members = tuple(classifier) if isinstance(classifier, Sequence) else (classifier,)
    if not members:
        raise SpecError("There is no classifier to attack; give at least one.")
    for member in members:
        goal.check(member.n_classes)
    return members


@dataclass(frozen=True)
class Look:
    """What one look at some views saw.

    gradient: of the summed loss by each texel. loss: its mean, and fooled: the share of views that every classifier is
    fooled on; views that were left out count as safely won. settled: views (of all) whose loss has no gradient for any
    classifier. images: how many each classifier was shown.
    """

    gradient: Flat
    loss: float
    fooled: float
    settled: Int[Tensor, " _"]
    images: int


class Standing(NamedTuple):
    """How well a change does on all views: the share of them that every classifier is fooled on, and the mean loss.
    Compared by the share first."""

    fooled: float
    loss: float


@dataclass(frozen=True)
class Objective:
    """The expected loss of a goal over a surrogate's views; of several classifiers, their mean.

    ``masks`` (saliency) let only those pixels' gradients through. ``part``: the texels that a change may touch, by
    default all. Raises ``SpecError`` for a classifier that takes images of another size than the surrogate's.
    """

    textures: Textures
    surrogate: Surrogate
    members: tuple[WhiteBoxClassifier, ...]
    goal: Goal
    masks: Bool[Tensor, "views H W"] | None
    part: Canvas | None = None

    def __post_init__(self) -> None:
        size = self.surrogate.geometry.size
        for member in self.members:
            if tuple(member.image_size) != tuple(size):
                raise SpecError(
                    f"The classifier {member.name!r} takes images of {tuple(member.image_size)}, the surrogate's are "
                    f"{tuple(size)}: prepare the surrogate for that size, or resize the images for the classifier."
                )

    @property
    def canvas(self) -> Canvas:
        """The texels that may move."""
        return self._whole if self.part is None else self.part

    @cached_property
    def _whole(self) -> Canvas:
        return self.surrogate.canvas(self.textures, {name: t[..., 0] >= 0 for name, t in self.textures.items()})

    @property
    def source(self) -> Flat:
        """The unpainted textures."""
        return self.canvas.source

    def join(self, tables: Mapping[str, Tensor]) -> Tensor:
        """One tensor (texels, ...) of what stands in tables (H, W, ...) by the textures' names."""
        return self.canvas.join([tables[name] for name in self.surrogate.geometry.textures])

    def split(self, everything: Tensor) -> dict[str, Tensor]:
        """The reverse of ``join``; zero where nothing may move."""
        names = self.surrogate.geometry.textures
        tables = dict(zip(names, self.canvas.split(everything), strict=True))
        return {name: tables[name] for name in self.textures}

    def texels(self, change: Flat) -> Float[Tensor, "reads 3"]:
        """What the views read of the textures with a ``change``. Differentiable."""
        return self.canvas.read(self.source + change)

    def look(self, change: Flat, batches: Sequence[int], awake: Bool[Tensor, " views"]) -> Look:
        """Loss and gradient at ``change`` over the views of ``batches``, of which only those ``awake`` are looked at.

        A gradient that is not finite counts as zero.
        """
        leaf = (self.source + change).requires_grad_()
        texels = self.canvas.read(leaf)
        collected = texels.detach().requires_grad_()
        losses, won, settled, images = 0.0, 0, [], 0
        for batch in batches:
            views = self.surrogate.batches[batch]
            chosen = awake[views.start : views.stop].nonzero()[:, 0]
            resting = len(views) - len(chosen)
            losses, won = losses + resting * self.goal.safe, won + resting
            if len(chosen):
                loss, reached, safe = self._pull(collected, batch, chosen)
                losses, won, images = losses + loss, won + reached, images + len(chosen)
                settled.append(chosen[safe] + views.start)
        count = sum(len(self.surrogate.batches[batch]) for batch in batches)
        return Look(
            self._way_back(texels, leaf, collected.grad),
            losses / count,
            won / count,
            torch.cat(settled) if settled else awake.new_zeros(0, dtype=torch.long),
            images,
        )

    def _pull(
        self, collected: Float[Tensor, "texels 3"], batch: int, chosen: Int[Tensor, " chosen"]
    ) -> tuple[float, int, Bool[Tensor, " chosen"]]:
        """Add the gradient of some views of a batch to ``collected``.

        Returns their summed loss, how many are fooled, and which are settled.
        """
        shown = self.surrogate.render(collected, batch, masks=self.masks)
        everything = len(chosen) == len(shown)
        seen = (shown.detach() if everything else _rows(shown.detach(), chosen)).requires_grad_()
        logits = [member.logits(seen) for member in self.members]
        loss = torch.stack([self.goal.losses(each).sum() for each in logits]).mean()
        (pull,) = torch.autograd.grad(loss, seen)
        back = pull if everything else torch.zeros_like(shown).index_copy_(0, chosen, pull)
        shown.backward(back)  # type: ignore[no-untyped-call]
        reached = torch.stack([self.goal.reached(each) for each in logits]).all(0)
        settled = torch.stack([self.goal.settled(each) for each in logits]).all(0)
        return float(loss.detach()), int(reached.sum()), settled

    def _way_back(self, texels: Tensor, leaf: Flat, gathered: Tensor | None) -> Flat:
        """The gradient by the textures, from that by what the views read of them."""
        if gathered is None:
            return torch.zeros_like(leaf)
        (gradient,) = torch.autograd.grad(texels, leaf, gathered)
        return gradient.nan_to_num_(0, 0, 0)

    @torch.no_grad()
    def standing(self, change: Flat) -> Standing:
        """How well a ``change`` does on all views, masks or not; no gradient."""
        texels, won, total = self.texels(change), 0, 0.0
        for batch in range(len(self.surrogate.batches)):
            images = self.surrogate.render(texels, batch)
            logits = [member.logits(images) for member in self.members]
            won += int(torch.stack([self.goal.reached(each) for each in logits]).all(0).sum())
            total += float(torch.stack([self.goal.losses(each).sum() for each in logits]).mean())
        return Standing(won / self.surrogate.n_views, total / self.surrogate.n_views)


def _rows(images: Float[Tensor, "n 3 H W"], chosen: Int[Tensor, " chosen"]) -> Float[Tensor, "chosen 3 H W"]:
    """Some of the images, channels last in memory as they all are."""
    return images.permute(0, 2, 3, 1).index_select(0, chosen).permute(0, 3, 1, 2)
