"""Ensembles: classifiers attacked together, for transfer to unknown ones."""

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from trompe_server.classifiers.protocol import WhiteBoxClassifier, Wrapper, resize
from trompe_server.spec.checks import check_same_classes
from trompe_shared.errors import ClassifierError


@dataclass(frozen=True)
class ResizedClassifier(Wrapper):
    """``inner`` for images of ``image_size``; resizes images and gradients."""

    inner: WhiteBoxClassifier
    image_size: tuple[int, int]

    def logits(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1] of size ``image_size``, differentiable in them."""
        return self.inner.logits(resize(images, self.inner.image_size))


def resized(classifier: WhiteBoxClassifier, size: tuple[int, int]) -> WhiteBoxClassifier:
    """The classifier for images of ``size`` (H, W): itself if that is its own size."""
    return classifier if classifier.image_size == size else ResizedClassifier(classifier, size)


def as_ensemble(classifiers: Sequence[WhiteBoxClassifier]) -> tuple[WhiteBoxClassifier, ...]:
    """The classifiers as members for images of the first one's size.

    Raises ``ClassifierError`` for no classifier, and if two of them differ in their classes.
    """
    if not classifiers:
        raise ClassifierError("An ensemble needs at least one classifier, got none.")
    check_same_classes(classifiers)
    return tuple(resized(one, classifiers[0].image_size) for one in classifiers)
