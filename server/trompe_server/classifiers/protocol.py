"""Interfaces of classifiers, and the conversion of images to their input."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from trompe_server.spec.checks import Classes
from trompe_server.system.threads import side_by_side
from trompe_shared.errors import ClassifierError

BATCH: Final = 10
"""Images of one call of a network on a CPU, without a gradient."""
AT_ONCE: Final = 40
"""Images of one call of a network on a graphics card, with or without a gradient: a step of the attack."""
HUGE: Final = 1e30
"""Replacement for an infinite logit."""

Images = NDArray[np.uint8]
Logits = NDArray[np.float32]


@runtime_checkable
class Classifier(Classes, Protocol):
    """An image classifier with logits. ``name`` is for reports, ``n_classes`` the number of logits."""

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) of its input."""
        ...

    @property
    def classes(self) -> tuple[str, ...] | None:
        """Class names in the order of the logits, or ``None`` if unknown."""
        ...

    def predict(self, images: Images) -> Logits:
        """Logits (N, n_classes) float32, all finite, of sRGB images (N, H, W, 3) uint8 of any size, row 0 on top."""
        ...


@runtime_checkable
class WhiteBoxClassifier(Classifier, Protocol):
    """A classifier with logits differentiable in the images. An attack calls it from two threads at once."""

    def logits(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1] of size ``image_size``; the parameters are frozen."""
        ...


@runtime_checkable
class ScoringClassifier(Classifier, Protocol):
    """A classifier for images not rounded to 8 bits, with or without gradients."""

    def scores(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1] of size ``image_size``, without a gradient, on the images' device."""
        ...


def resize(images: Float[Tensor, "n 3 h w"], size: tuple[int, int]) -> Float[Tensor, "n 3 H W"]:
    """The images resized (antialiased bilinear, differentiable); the same tensor if they have that size."""
    if images.shape[2:] == size:
        return images
    return F.interpolate(images, size, mode="bilinear", antialias=True)


def fit_images(images: Images, size: tuple[int, int], device: str = "cpu") -> Float[Tensor, "n 3 H W"]:
    """Images (N, h, w, 3) as a classifier's input in [0, 1] of ``size`` (H, W), resized if necessary."""
    batch = torch.from_numpy(np.ascontiguousarray(images)).to(device).permute(0, 3, 1, 2).float() / 255
    return resize(batch, size)


def predicted(
    logits: Callable[[Tensor], Tensor],
    images: Images,
    size: tuple[int, int],
    n_classes: int,
    *,
    batch: int = BATCH,
    device: str = "cpu",
    split: bool = False,
) -> Logits:
    """Logits (N, n_classes), all finite, of images of any size, by a network of ``size`` (H, W) on ``device``;
    ``split``: in parts of torch's threads.

    Raises ``ClassifierError`` unless the images are (N, H, W, 3) uint8, and for a NaN.
    """
    if images.ndim != 4 or images.shape[3] != 3 or images.dtype != np.uint8:
        raise ClassifierError(
            f"Images of shape {images.shape} and type {images.dtype} cannot be classified; "
            "pass (N, H, W, 3) uint8, sRGB."
        )

    def of(start: int) -> Logits:
        found = logits(fit_images(images[start : start + batch], size, device))
        if found.isnan().any():
            raise ClassifierError(
                f"The classifier gives NaN for {int(found.isnan().any(dim=1).sum())} of {len(found)} images, so they "
                "have no class. Half precision may overflow: export it in float32."
            )
        return finite(found).cpu().numpy()

    starts = range(0, len(images), batch)
    chunks = side_by_side(of, starts, split=split)
    return np.concatenate([np.zeros((0, n_classes), np.float32), *chunks])


def finite(logits: Float[Tensor, "n classes"]) -> Float[Tensor, "n classes"]:
    """Replace infinite logits by huge ones and NaN by 0; neither passes a gradient."""
    return logits.nan_to_num(nan=0.0, posinf=HUGE, neginf=-HUGE)


def check_classes(classes: Sequence[str] | None, n_classes: int, file: str) -> tuple[str, ...] | None:
    """The class names as a tuple. Raises ``ClassifierError`` unless there is one for each logit."""
    if classes is None:
        return None
    if len(classes) != n_classes:
        raise ClassifierError(
            f"{file!r} has {n_classes} classes, but {len(classes)} class names were given; "
            "pass one name for each, in order."
        )
    return tuple(classes)


def broken(file: str, what: str, *, batch: str = "") -> ClassifierError:
    """The error for a network that breaks the contract. ``batch``: what it says of the batch."""
    return ClassifierError(
        f"{file!r}: {what}. Expected: input image float32 NCHW in [0, 1]{batch}, output logits (N, classes); export it "
        "so, with the normalisation inside."
    )


@contextmanager
def refusing(what: str, *, remedy: str) -> Iterator[None]:
    """Translate any error, whose kind foreign files and libraries decide, to ``ClassifierError``."""
    try:
        yield
    except ClassifierError:
        raise
    except Exception as error:
        raise ClassifierError(f"{what} ({type(error).__name__}: {str(error)[:300]}){remedy}") from error


def refuse_probabilities(outputs: NDArray[np.float32], file: str) -> None:
    """Raise ``ClassifierError`` if every row of ``outputs`` (N, classes) is a distribution, also in half precision."""
    if outputs.shape[1] > 1 and (outputs >= 0).all() and np.allclose(outputs.sum(axis=1), 1, atol=0.01):
        raise ClassifierError(
            f"{file!r} ends in a softmax: each output row is positive and sums to 1. "
            "Expected logits; export the network without its last softmax."
        )


class Wrapper:
    """Base of wrappers around a classifier: name, classes and predictions are those of ``inner``."""

    inner: Classifier

    @property
    def name(self) -> str:
        return self.inner.name

    @property
    def n_classes(self) -> int:
        return self.inner.n_classes

    @property
    def classes(self) -> tuple[str, ...] | None:
        return self.inner.classes

    def predict(self, images: Images) -> Logits:
        """Logits (N, n_classes) of uint8 images (N, H, W, 3) of any size, resized once, to the size of ``inner``."""
        return self.inner.predict(images)
