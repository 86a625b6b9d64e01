"""What the rest of the server asks of a classifier, and the one way images become its input."""

from collections.abc import Iterator, Sequence
from typing import Final, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from trompe_shared.errors import ClassifierError

__all__ = [
    "Classifier",
    "ScoringClassifier",
    "WhiteBoxClassifier",
    "Wrapper",
    "check_classes",
    "finite",
    "fit_images",
    "in_batches",
    "innermost",
    "refuse_probabilities",
    "resize",
]

HUGE: Final = 1e30
"""What stands for an infinite logit."""

Images = NDArray[np.uint8]
Logits = NDArray[np.float32]


@runtime_checkable
class Classifier(Protocol):
    """An image classifier that gives logits. ``classes`` names them in order, where known."""

    @property
    def name(self) -> str:
        """What reports call it."""
        ...

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) of its input."""
        ...

    @property
    def n_classes(self) -> int:
        """Number of its logits."""
        ...

    @property
    def classes(self) -> tuple[str, ...] | None:
        """Class names in the order of the logits, or ``None`` where unknown."""
        ...

    def predict(self, images: Images) -> Logits:
        """Logits (N, n_classes), all finite, of sRGB images (N, H, W, 3), row 0 on top; other sizes are resized."""
        ...


@runtime_checkable
class WhiteBoxClassifier(Classifier, Protocol):
    """A classifier that can be attacked: its logits are differentiable in the images."""

    def logits(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1] of the classifier's own size; its parameters take no gradient."""
        ...


@runtime_checkable
class ScoringClassifier(Classifier, Protocol):
    """A classifier that takes images that are not rounded to 8 bits, whether it gives gradients or not."""

    def scores(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1] of the classifier's own size, without a gradient, on the images' device."""
        ...


def resize(images: Float[Tensor, "n 3 h w"], size: tuple[int, int]) -> Float[Tensor, "n 3 H W"]:
    """The images in another size (antialiased bilinear, differentiable); the very same tensor where it is theirs."""
    if images.shape[2:] == size:
        return images
    return F.interpolate(images, size, mode="bilinear", antialias=True)


def fit_images(images: Images, size: tuple[int, int]) -> Float[Tensor, "n 3 H W"]:
    """Images (N, h, w, 3) as a classifier's input in [0, 1], resized (antialiased bilinear) where not of ``size``."""
    batch = torch.from_numpy(np.ascontiguousarray(images)).permute(0, 3, 1, 2).float() / 255
    return resize(batch, size)


def in_batches(images: Images, count: int) -> Iterator[Images]:
    """Consecutive runs of at most ``count`` images. Raises ``ClassifierError`` when they are not (N, H, W, 3) uint8."""
    if images.ndim != 4 or images.shape[3] != 3 or images.dtype != np.uint8:
        raise ClassifierError(
            f"Images of shape {images.shape} and type {images.dtype} cannot be classified; "
            "pass (N, H, W, 3) uint8, sRGB."
        )
    return (images[start : start + count] for start in range(0, len(images), count))


def finite(logits: Float[Tensor, "n classes"]) -> Float[Tensor, "n classes"]:
    """Infinite logits as huge ones, undefined ones as 0: what can be compared and written. No gradient flows through
    either."""
    return logits.nan_to_num(nan=0.0, posinf=HUGE, neginf=-HUGE)


def check_classes(classes: Sequence[str] | None, n_classes: int, file: str) -> tuple[str, ...] | None:
    """The class names as a tuple. Raises ``ClassifierError`` when there is not one for each logit."""
    if classes is None:
        return None
    if len(classes) != n_classes:
        raise ClassifierError(
            f"{file!r} has {n_classes} classes, but {len(classes)} class names were given; "
            "pass one name for each, in order."
        )
    return tuple(classes)


def refuse_probabilities(outputs: NDArray[np.float32], file: str) -> None:
    """Raise ``ClassifierError`` when every row of ``outputs`` (N, classes) is a probability distribution."""
    if outputs.shape[1] > 1 and (outputs >= 0).all() and np.allclose(outputs.sum(axis=1), 1, atol=1e-4):
        raise ClassifierError(
            f"{file!r} ends in a softmax: each output row is positive and sums to 1. "
            "Expected logits; export the network without its last softmax."
        )


class Wrapper:
    """What a wrapper around another classifier says of itself: what ``inner`` says."""

    inner: Classifier

    @property
    def name(self) -> str:
        """See ``Classifier``."""
        return self.inner.name

    @property
    def n_classes(self) -> int:
        """See ``Classifier``."""
        return self.inner.n_classes

    @property
    def classes(self) -> tuple[str, ...] | None:
        """See ``Classifier``."""
        return self.inner.classes

    def predict(self, images: Images) -> Logits:
        """Logits (N, n_classes) of uint8 images (N, H, W, 3) of any size, resized once, to the inner size."""
        return self.inner.predict(images)


def innermost(classifier: Classifier) -> Classifier:
    """The classifier without its wrappers."""
    while isinstance(classifier, Wrapper):
        classifier = classifier.inner
    return classifier
