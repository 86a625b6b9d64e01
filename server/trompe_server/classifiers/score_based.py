"""Gradients of a score-only classifier, estimated from counted queries.

Natural evolution strategies in image space (Ilyas et al., 2018): the slope of the loss along random patterns, from
queries on both sides of the image, times the patterns. A pattern is noise on a coarse grid, interpolated over the
image: fewer unknowns need fewer queries, and the surrogate averages finer detail away. The estimate replaces the true
gradient at the classifier's input; surrogate and attack stay the same.

The steps are as large as the attack's budget. A slope over the whole budget is a better guide than one at the image
itself, and the kinks of a network disturb it less.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from trompe_server.classifiers.drawing import seeded_generator
from trompe_server.classifiers.protocol import AT_ONCE, Classifier, ScoringClassifier, Wrapper
from trompe_shared.errors import ClassifierError, SpecError

CELLS: Final = 28
"""Side of a pattern's grid. With as many cells as pixels the patterns are white noise, and the mean estimate of a
linear function is exact; with fewer it is a smoothed gradient."""


@dataclass
class ScoreBasedClassifier(Wrapper):
    """``inner`` with estimated gradients; ``queries`` counts its images, except those of ``predict``.

    An image without a gradient (for example with a clamped loss) costs only the query for its scores.
    """

    inner: ScoringClassifier
    queries_per_gradient: int
    sigma: float
    seed: int
    background: Float[Tensor, "3 #H #W"] | None = None
    queries: int = field(default=0, init=False)

    @property
    def image_size(self) -> tuple[int, int]:
        return self.inner.image_size

    def logits(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """The true logits of sRGB images in [0, 1]; the backward pass estimates their gradient."""
        logits: Tensor = _Asked.apply(images, self)  # type: ignore[no-untyped-call]
        return logits

    def ask(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Scores of the images; each counts as one query."""
        self.queries += len(images)
        return self.inner.scores(images)

    def estimate(self, image: Float[Tensor, "3 H W"], weights: Float[Tensor, " classes"]) -> Float[Tensor, "3 H W"]:
        """Estimated gradient of ``weights @ logits`` in the image.

        Deterministic in image and weights, independent of time and batch.
        """
        estimate = torch.zeros_like(image)
        for patterns in self._patterns(image):
            steps = self.sigma * patterns
            answers = self.ask(torch.cat([image + steps, image - steps]).clamp(0, 1)) @ weights
            plus, minus = answers.chunk(2)
            estimate += torch.einsum("p,pchw->chw", (plus - minus) / (self.sigma * self.queries_per_gradient), patterns)
        return estimate

    def _patterns(self, image: Float[Tensor, "3 H W"]) -> Iterator[Float[Tensor, "pairs 3 H W"]]:
        """Smooth noise on the object's pixels, seeded by the seed and the image, for ``AT_ONCE`` images at a time."""
        seed = self.seed.to_bytes(8, "little", signed=True)
        generator = seeded_generator(image.detach().cpu().numpy().tobytes(), key=seed)
        height, width = (min(CELLS, side) for side in image.shape[1:])
        coarse = torch.randn((self.queries_per_gradient // 2, 3, height, width), generator=generator)
        shown: Tensor | bool = True
        if self.background is not None:
            shown = (image - self.background.to(image)).abs().amax(0) > 0.25 / 255  # by more than rounding
        for few in torch.split(coarse, AT_ONCE // 2):
            yield F.interpolate(few, image.shape[1:], mode="bilinear").to(image) * shown


class _Asked(Function):
    """Logits with an estimated gradient."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, classifier: ScoreBasedClassifier) -> Tensor:
        ctx.save_for_backward(images)
        ctx.classifier = classifier
        return classifier.ask(images.detach())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """The estimate for each image with a gradient, zero for the others."""
        (images,) = ctx.saved_tensors
        estimates = torch.zeros_like(images)
        for index in torch.nonzero(gradient.any(dim=1)).flatten().tolist():
            estimates[index] = ctx.classifier.estimate(images[index], gradient[index])
        return estimates, None


def score_based(
    classifier: Classifier,
    *,
    seed: int,
    background: Float[Tensor, "3 #H #W"] | None = None,
    queries: int = 10,
    sigma: float = 0.05,
) -> ScoreBasedClassifier:
    """Make a score-only classifier attackable.

    background: the images' background, sRGB in [0, 1], of the classifier's size or one colour (3, 1, 1). Patterns cover
        only the pixels that differ from it; for a small object all others are noise.
    queries: images per gradient of one image, an even number.
    sigma: standard deviation of a pattern at the middle of a cell, sRGB in [0, 1] units, best the budget's epsilon.

    The draws depend on the seed and on the image only, so that a resumed attack continues identically.
    Raises ``SpecError`` for options out of range and ``ClassifierError`` for a classifier of 8-bit images only.
    """
    if queries < 2 or queries % 2 or not 0 < sigma <= 1:
        raise SpecError(
            "Gradients are estimated from an even number of queries, at least 2, with 0 < sigma <= 1; "
            f"got queries={queries}, sigma={sigma}."
        )
    if not isinstance(classifier, ScoringClassifier):
        raise ClassifierError(
            f"{classifier.name!r} takes 8-bit images only, too coarse to estimate a gradient; "
            "expected a classifier with a method 'scores', such as an .onnx file."
        )
    return ScoreBasedClassifier(classifier, queries, sigma, seed, background)
