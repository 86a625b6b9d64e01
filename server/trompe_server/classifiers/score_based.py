"""Attack a classifier that only answers: its gradient is estimated from scores, and every question is counted.

Natural evolution strategies in image space (Ilyas et al., 2018): the slope of the loss along random patterns, each
asked for on both sides of the image, times the patterns. A pattern is noise on a coarse grid, spread smoothly over the
image: the fewer unknowns, the fewer questions, and what is finer the surrogate averages away. The estimate stands in
for the true gradient at the classifier's input, so that nothing behind it, surrogate and attack, needs to know.

The steps are large, as large as the change that the attack may make: a slope over the whole budget tells more about
where to go than one at the image itself, and is not drowned by the kinks of a network.
"""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from trompe_server.classifiers.drawing import generator_for
from trompe_server.classifiers.protocol import Classifier, ScoringClassifier, Wrapper
from trompe_shared.errors import ClassifierError, SpecError

__all__ = ["ScoreBasedClassifier", "score_based"]


@dataclass
class ScoreBasedClassifier(Wrapper):
    """``inner``, its gradient estimated; ``queries`` counts the images it was asked about, ``predict`` left out.

    An image for which no gradient is wanted (its loss is clamped, say) costs only the one query for its scores.
    """

    inner: ScoringClassifier
    queries_per_gradient: int
    cells: int
    sigma: float
    seed: int
    background: Float[Tensor, "3 #H #W"] | None = None
    queries: int = field(default=0, init=False)

    @property
    def image_size(self) -> tuple[int, int]:
        """See ``Classifier``."""
        return self.inner.image_size

    def logits(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """The true logits of sRGB images in [0, 1]; their gradient is an estimate, asked for when it is needed."""
        logits: Tensor = _Asked.apply(images, self)  # type: ignore[no-untyped-call]
        return logits

    def ask(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Scores of the images, each counted as one query."""
        self.queries += len(images)
        return self.inner.scores(images)

    def estimate(self, image: Float[Tensor, "3 H W"], weights: Float[Tensor, " classes"]) -> Float[Tensor, "3 H W"]:
        """Estimated gradient of ``weights @ logits`` in the image.

        The same image and weights give the same estimate, whenever and in whatever company they are asked about.
        """
        patterns = self._patterns(image)
        steps = self.sigma * patterns
        answers = self.ask(torch.cat([image + steps, image - steps]).clamp(0, 1)) @ weights
        plus, minus = answers.chunk(2)
        slopes = (plus - minus) / (2 * self.sigma * len(patterns))
        return torch.einsum("p,pchw->chw", slopes, patterns)

    def _patterns(self, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "pairs 3 H W"]:
        """Smooth noise on the object's pixels, drawn by the seed and the image's own bits."""
        generator = generator_for(image, self.seed)
        height, width = (min(self.cells, side) for side in image.shape[1:])
        coarse = torch.randn((self.queries_per_gradient // 2, 3, height, width), generator=generator)
        smooth = F.interpolate(coarse, image.shape[1:], mode="bilinear").to(image)
        return smooth if self.background is None else smooth * _differs(image, self.background.to(image))


class _Asked(Function):
    """Logits whose gradient is asked for, not computed."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, classifier: ScoreBasedClassifier) -> Tensor:
        """The logits of the images."""
        ctx.save_for_backward(images)
        ctx.classifier = classifier
        return classifier.ask(images.detach())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """The estimate for each image that a gradient comes to, nothing for the others."""
        (images,) = ctx.saved_tensors
        estimates = torch.zeros_like(images)
        for index in torch.nonzero(gradient.any(dim=1)).flatten().tolist():
            estimates[index] = ctx.classifier.estimate(images[index], gradient[index])
        return estimates, None


def _differs(image: Float[Tensor, "3 H W"], background: Float[Tensor, "3 #H #W"]) -> Bool[Tensor, "H W"]:
    """Where the image shows something else than the background, by more than what resizing leaves of rounding."""
    return (image - background).abs().amax(0) > 0.25 / 255


def score_based(
    classifier: Classifier,
    *,
    seed: int,
    background: Float[Tensor, "3 #H #W"] | None = None,
    queries: int = 10,
    sigma: float = 0.05,
    cells: int = 28,
) -> ScoreBasedClassifier:
    """A classifier of which only scores are known as one that can be attacked.

    ``background``: what the images show behind the object, sRGB in [0, 1], of the classifier's size or one colour
    (3, 1, 1). Only what differs from it is asked about: a small object needs that, for every other pixel is noise.
    ``queries``: how many images it is asked about for the gradient of one, an even number. ``sigma``: standard
    deviation of a pattern at the middle of a cell, sRGB in [0, 1] units; the budget's epsilon is a good choice.
    ``cells``: the grid of a pattern is ``cells`` x ``cells``; as many as the image has pixels makes it white noise, and
    the estimate of a linear function exact on average, instead of a smoothed gradient.
    The draws depend on the seed and on the image alone: a resumed attack goes on as if it had not stopped.
    Raises ``SpecError`` for options out of range, ``ClassifierError`` where the classifier takes 8-bit images only.
    """
    if queries < 2 or queries % 2 or not 0 < sigma <= 1 or cells < 1:
        raise SpecError(
            "Gradients are estimated from an even number of queries, at least 2, with 0 < sigma <= 1 and cells >= 1; "
            f"got queries={queries}, sigma={sigma}, cells={cells}."
        )
    if not isinstance(classifier, ScoringClassifier):
        raise ClassifierError(
            f"{classifier.name!r} takes 8-bit images only, which are too coarse to estimate a gradient from; "
            "expected a classifier with a method 'scores', as .onnx files give."
        )
    return ScoreBasedClassifier(classifier, queries, cells, sigma, seed, background)
