"""Where in the target's images the loss is most sensitive: the pixels that an attack with ``tau`` may use."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from trompe_server.attack.goal import Goal
from trompe_server.attack.objective import members_of
from trompe_server.classifiers import WhiteBoxClassifier
from trompe_shared.api import SaliencyScope
from trompe_shared.errors import SpecError

__all__ = ["BATCH", "image_gradients", "rescale_each_view", "saliency", "saliency_masks"]

BATCH = 10


def saliency(
    images: NDArray[np.uint8],
    classifier: WhiteBoxClassifier | Sequence[WhiteBoxClassifier],
    *,
    goal: Goal,
    scope: SaliencyScope = "all_views",
) -> Float[Tensor, "views H W"]:
    """|dL/dI| of the target's images (views, H, W, 3), mean over channels, rescaled to [0, 1] over all views (the
    paper's equation 5) or, with ``scope`` each_view, each view once more by itself.

    L is the goal's loss, the margin without its clamp, so that a view that is fooled already has a saliency too; of
    several classifiers their mean. Raises ``SpecError`` for a goal that does not fit the classifier.
    """
    everything = torch.cat(
        [gradient.abs().mean(3) for gradient in _gradients(images, members_of(classifier, goal), goal)]
    )
    low, high = everything.min(), everything.max()
    maps = (everything - low) / (high - low).clamp(min=1e-30)
    return maps if scope == "all_views" else rescale_each_view(maps)


def rescale_each_view(maps: Float[Tensor, "views H W"]) -> Float[Tensor, "views H W"]:
    """Saliency, in [0, 1], as a share of the view's own largest; a view that has none stays as it is, all zero."""
    largest = maps.amax((1, 2), keepdim=True)
    return maps / torch.where(largest > 0, largest, 1)


def image_gradients(
    images: NDArray[np.uint8], classifier: WhiteBoxClassifier | Sequence[WhiteBoxClassifier], *, goal: Goal
) -> Float[Tensor, "views H W 3"]:
    """dL/dI of the target's images (views, H, W, 3), with its sign and size; L as in ``saliency``."""
    return torch.cat(list(_gradients(images, members_of(classifier, goal), goal)))


def _gradients(
    images: NDArray[np.uint8], members: Sequence[WhiteBoxClassifier], goal: Goal
) -> Iterator[Float[Tensor, "batch H W 3"]]:
    """dL/dI, a batch of images at a time; zero where it is not finite."""
    for start in range(0, len(images), BATCH):
        batch = torch.from_numpy(images[start : start + BATCH]).float().div(255)
        inputs = batch.permute(0, 3, 1, 2).requires_grad_()
        losses = [goal.losses(member.logits(inputs), clamped=False).sum() for member in members]
        (gradient,) = torch.autograd.grad(torch.stack(losses).mean(), inputs)
        yield gradient.nan_to_num(0, 0, 0).permute(0, 2, 3, 1).cpu()


def saliency_masks(maps: Float[Tensor, "views H W"], tau: float) -> Bool[Tensor, "views H W"]:
    """The pixels whose saliency is at least ``tau``, in [0, 1). Raises ``SpecError`` where there is none."""
    masks = maps >= tau
    if not masks.any():
        raise SpecError(f"No pixel of the target's images has a saliency of tau={tau:g} or more; choose a lower tau.")
    return masks
