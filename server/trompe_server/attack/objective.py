"""Loss and gradient of a change of the textures, over a surrogate's views.

All textures are one flat tensor (texels, 3) here: the texels, or blocks of them, that may move, in the order of the
surrogate's canvas.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from trompe_server.attack.goal import Goal
from trompe_server.classifiers import ScoreBasedClassifier, WhiteBoxClassifier
from trompe_server.classifiers.protocol import AT_ONCE
from trompe_server.image_pipelines import Drawn
from trompe_server.surrogate import AnyCanvas, AnySurrogate
from trompe_server.system.threads import in_parts
from trompe_shared.errors import ClassifierError, SpecError

Textures = Mapping[str, Float[Tensor, "H W 3"]]
Flat = Float[Tensor, "texels 3"]
Rows = Mapping[int, Int[Tensor, " _"]]
"""Rows of each batch that has any."""


def members_of(
    classifier: WhiteBoxClassifier | Sequence[WhiteBoxClassifier], goal: Goal
) -> tuple[WhiteBoxClassifier, ...]:
    """One or several classifiers as a tuple. Raises ``SpecError`` for none, or for one that does not fit ``goal``."""
    members = tuple(classifier) if isinstance(classifier, Sequence) else (classifier,)
    if not members:
        raise SpecError("No classifier to attack; give at least one.")
    for member in members:
        goal.check(member.n_classes)
    return members


@dataclass(frozen=True)
class Evaluation:
    """Loss and gradient over some views.

    gradient: of the summed loss. loss: mean over the views. fooled: share of views on which all classifiers are fooled.
    Skipped views count as safely won in both. settled: indices of views with zero gradient for all classifiers.
    images: number shown to each classifier.
    """

    gradient: Flat
    loss: float
    fooled: float
    settled: Int[Tensor, " _"]
    images: int


class Score(NamedTuple):
    """Quality of a change over all views, ordered by the share of fooled views, then by mean loss."""

    fooled: float
    loss: float


class _Part(NamedTuple):
    """Gradient of the texels that are read, summed loss, fooled and settled views, and images of some groups."""

    gradient: Float[Tensor, "reads 3"]
    loss: float
    won: int
    settled: Int[Tensor, " _"]
    images: int


@dataclass(frozen=True)
class Objective:
    """Expected loss of a goal over a surrogate's views, averaged over the classifiers.

    masks: pixels (saliency) that pass gradients; all by default. canvas: the texels that may move. pipeline: what
    happens to the images before the classifiers; nothing by default. settling: most images are expected to be safely
    won; saves time, changes nothing else. Raises ``SpecError`` if a classifier's image size differs from the
    surrogate's.
    """

    textures: Textures
    surrogate: AnySurrogate
    members: tuple[WhiteBoxClassifier, ...]
    goal: Goal
    masks: Bool[Tensor, "views H W"] | None
    canvas: AnyCanvas
    pipeline: Drawn | None = None
    settling: bool = False

    def __post_init__(self) -> None:
        size = self.surrogate.size
        for member in self.members:
            if tuple(member.image_size) != tuple(size):
                raise SpecError(
                    f"The classifier {member.name!r} takes images of {tuple(member.image_size)}, the surrogate renders "
                    f"{tuple(size)}: prepare the surrogate for that size, or resize the images for the classifier."
                )

    @property
    def source(self) -> Flat:
        """The unpainted textures."""
        return self.canvas.source

    def join(self, tables: Mapping[str, Tensor]) -> Tensor:
        """One tensor (texels, ...) from tables (H, W, ...) by texture name."""
        return self.canvas.join([tables[name] for name in self.surrogate.textures])

    def split(self, everything: Tensor) -> dict[str, Tensor]:
        """The inverse of ``join``; zero for fixed texels."""
        names = self.surrogate.textures
        tables = dict(zip(names, self.canvas.split(everything), strict=True))
        return {name: tables[name] for name in self.textures}

    def texels(self, change: Flat) -> Float[Tensor, "reads 3"]:
        """The texels that the views read after a ``change``. Differentiable."""
        return self.canvas.read(self.source + change)

    def evaluate(self, change: Flat, batches: Sequence[int], active: Bool[Tensor, " views"]) -> Evaluation:
        """Loss and gradient at ``change`` over the ``active`` views of ``batches``.

        A gradient that is not finite counts as zero.
        """
        leaf = (self.source + change).requires_grad_()
        texels = self.canvas.read(leaf)
        chosen = [rows for group in self._groups(batches) if (rows := _chosen(group, active))]
        part = partial(self._part, texels.detach())
        parts = in_parts(part, chosen, split=self._plain)
        count, images = sum(len(self.surrogate.batches[batch]) for batch in batches), sum(part.images for part in parts)
        gradient = torch.zeros_like(leaf)
        if images:
            at_texels = reduce(torch.add, (part.gradient for part in parts))
            gradient = torch.autograd.grad(texels, leaf, at_texels)[0].nan_to_num_(0, 0, 0)
        skipped = count - images
        return Evaluation(
            gradient,
            (sum(part.loss for part in parts) + skipped * self.goal.safe) / count,
            (sum(part.won for part in parts) + skipped) / count,
            torch.cat([active.new_zeros(0, dtype=torch.long), *(part.settled for part in parts)]),
            images,
        )

    @property
    def estimated(self) -> bool:
        """Whether any gradient is estimated from many scores."""
        return any(isinstance(member, ScoreBasedClassifier) for member in self.members)

    @property
    def _on_cpu(self) -> bool:
        return self.source.device.type == "cpu"

    @property
    def _plain(self) -> bool:
        """Whether the work may be split as suits a processor, and an image be shown twice."""
        return self._on_cpu and not self.estimated

    def _part(self, texels: Float[Tensor, "reads 3"], groups: Sequence[Rows]) -> _Part:
        """Loss and gradient of ``texels`` over some groups of views, one after the other."""
        read, loss, won = texels.detach().requires_grad_(), 0.0, 0
        numbers = [
            torch.cat([some + self.surrogate.batches[batch].start for batch, some in rows.items()]) for rows in groups
        ]
        settled = []
        for rows, views in zip(groups, numbers, strict=True):
            its_loss, reached, safe = self._add_gradient(read, rows, views)
            loss, won = loss + its_loss, won + reached
            settled.append(views[safe])
        gradient = torch.zeros_like(texels) if read.grad is None else read.grad
        return _Part(gradient, loss, won, torch.cat(settled), sum(map(len, numbers)))

    def _groups(self, batches: Sequence[int]) -> Iterator[dict[int, range]]:
        """The views of ``batches`` by batch: on a CPU each batch alone, elsewhere as many as one pass of a network
        takes."""
        most, group = 1 if self._on_cpu else AT_ONCE, dict[int, range]()
        for batch in batches:
            views = self.surrogate.batches[batch]
            if group and sum(map(len, group.values())) + len(views) > most:
                yield group
                group = {}
            group[batch] = views
        if group:
            yield group

    def _add_gradient(
        self, read: Float[Tensor, "reads 3"], chosen: Rows, numbers: Int[Tensor, " chosen"]
    ) -> tuple[float, int, Bool[Tensor, " chosen"]]:
        """Add the gradient of the ``chosen`` views of some batches, the views ``numbers`` of all, to ``read.grad``.

        Returns their summed loss, the number of fooled ones, and a mask of the settled ones.
        """
        shown = [self.surrogate.render(read, batch, masks=self.masks) for batch in chosen]
        pairs = list(zip(shown, chosen.values(), strict=True))
        seen = torch.cat([_rows(images.detach(), rows) for images, rows in pairs]).requires_grad_()
        passed = seen if self.pipeline is None else self.pipeline.apply(seen, numbers.tolist())
        by_member = (self._of_member(member, passed.detach()) for member in self.members)
        gradients, losses, reached, settled = zip(*by_member, strict=True)
        (gradient,) = torch.autograd.grad(passed, seen, torch.stack(gradients).mean(0))
        parts = torch.split(gradient, [len(rows) for rows in chosen.values()])
        by_image = [_placed(part, *pair) for part, pair in zip(parts, pairs, strict=True)]
        torch.autograd.backward(shown, by_image)
        return sum(losses) / len(losses), int(torch.stack(reached).all(0).sum()), torch.stack(settled).all(0)

    def _of_member(self, member: WhiteBoxClassifier, images: Tensor) -> tuple[Tensor, float, Tensor, Tensor]:
        """Gradient of the summed loss of one classifier, the loss, and masks of reached and settled images.

        Each has its own graph: the activations of one network are most of an attack's memory. If most images are
        expected to be settled, their logits come first, and a graph only for those with a gradient.
        """
        if self.settling and self._plain:
            with torch.no_grad():
                logits = member.logits(images)
            rows, gradient = (~self.goal.settled(logits)).nonzero()[:, 0], torch.zeros_like(images)
            if len(rows):
                gradient.index_copy_(0, rows, self._gradient(member, _rows(images, rows))[0])
        else:
            gradient, logits = self._gradient(member, images)
        loss = float(self.goal.losses(logits).sum())
        return gradient, loss, self.goal.reached(logits), self.goal.settled(logits)

    def _gradient(self, member: WhiteBoxClassifier, images: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient of the summed loss of one classifier, and its logits."""
        images.requires_grad_()
        logits = member.logits(images)
        (gradient,) = torch.autograd.grad(self.goal.losses(logits).sum(), images, allow_unused=True)
        if gradient is None:
            raise ClassifierError(f"{member.name!r} has no gradient: its logits do not depend on its images.")
        return gradient, logits.detach()

    @torch.no_grad()
    def score(self, change: Flat) -> Score:
        """Score of a ``change`` on all views, without masks."""
        texels, won, total = self.texels(change), 0, 0.0
        for group in self._groups(range(len(self.surrogate.batches))):
            images = torch.cat([self.surrogate.render(texels, batch) for batch in group])
            logits = [member.logits(images) for member in self.members]
            won += int(torch.stack([self.goal.reached(each) for each in logits]).all(0).sum())
            total += float(torch.stack([self.goal.losses(each).sum() for each in logits]).mean())
        return Score(won / self.surrogate.n_views, total / self.surrogate.n_views)


def _chosen(group: Mapping[int, range], active: Bool[Tensor, " views"]) -> Rows:
    """The active views of a group."""
    rows = {batch: active[views.start : views.stop].nonzero()[:, 0] for batch, views in group.items()}
    return {batch: some for batch, some in rows.items() if len(some)}


def _rows(images: Float[Tensor, "n 3 H W"], chosen: Int[Tensor, " chosen"]) -> Float[Tensor, "chosen 3 H W"]:
    """The ``chosen`` images, in the same memory order (channels last)."""
    if len(chosen) == len(images):
        return images
    return images.permute(0, 2, 3, 1).index_select(0, chosen).permute(0, 3, 1, 2)


def _placed(
    gradient: Float[Tensor, "chosen 3 H W"], images: Float[Tensor, "n 3 H W"], chosen: Int[Tensor, " chosen"]
) -> Float[Tensor, "n 3 H W"]:
    """The gradient of all ``images`` from that of the ``chosen`` ones."""
    return gradient if len(chosen) == len(images) else torch.zeros_like(images).index_copy_(0, chosen, gradient)
