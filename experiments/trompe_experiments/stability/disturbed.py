"""Disturbed classifiers."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.classifiers.protocol import Images, Logits, Wrapper, predicted

Network = Callable[[Float[Tensor, "n 3 H W"]], Float[Tensor, "n classes"]]


@dataclass(frozen=True)
class ChangedClassifier(Wrapper):
    """``inner`` with another ``network`` (images in [0, 1] to logits)."""

    inner: WhiteBoxClassifier
    network: Network

    @property
    def image_size(self) -> tuple[int, int]:
        return self.inner.image_size

    def logits(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        return self.network(images)

    @torch.no_grad()
    def predict(self, images: Images) -> Logits:
        return predicted(self.network, images, self.image_size, self.n_classes)


def bfloat16(classifier: WhiteBoxClassifier) -> ChangedClassifier:
    """Computation in bfloat16."""

    def network(images: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            return classifier.logits(images).float()

    return ChangedClassifier(classifier, network)


def saturated(classifier: WhiteBoxClassifier, factor: float) -> ChangedClassifier:
    """Logits multiplied by ``factor``: a saturated softmax with hardly any gradient."""
    return ChangedClassifier(classifier, lambda images: factor * classifier.logits(images))


def quantised(classifier: WhiteBoxClassifier, levels: int) -> ChangedClassifier:
    """Images rounded to a few levels: gradient masking, since rounding has no gradient."""
    return ChangedClassifier(
        classifier, lambda images: classifier.logits((images * (levels - 1)).round() / (levels - 1))
    )
