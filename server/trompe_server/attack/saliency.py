"""Saliency of the target's images: the pixels that an attack with ``tau`` may use."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from trompe_server.attack.goal import Goal
from trompe_server.attack.objective import members_of
from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.classifiers.protocol import fit_images
from trompe_server.surrogate.surrogate import BATCH
from trompe_shared.errors import SpecError


def saliency(
    images: NDArray[np.uint8], classifier: WhiteBoxClassifier | Sequence[WhiteBoxClassifier], *, goal: Goal
) -> Float[Tensor, "views H W"]:
    """|dL/dI| of the target's images (views, H, W, 3), mean over channels, rescaled to [0, 1] over all views (the
    paper's equation 5).

    L is the goal's loss, averaged over the classifiers. The margin is not clamped, so that fooled views have a saliency
    too. Raises ``SpecError`` for a goal that does not fit a classifier.
    """
    everything = torch.cat(
        [gradient.abs().mean(3) for gradient in _gradients(images, members_of(classifier, goal), goal)]
    )
    low, high = everything.min(), everything.max()
    return (everything - low) / (high - low).clamp(min=1e-30)


def image_gradients(
    images: NDArray[np.uint8], classifier: WhiteBoxClassifier | Sequence[WhiteBoxClassifier], *, goal: Goal
) -> Float[Tensor, "views H W 3"]:
    """Signed dL/dI of the target's images (views, H, W, 3); L as in ``saliency``."""
    return torch.cat(list(_gradients(images, members_of(classifier, goal), goal)))


def _gradients(
    images: NDArray[np.uint8], members: Sequence[WhiteBoxClassifier], goal: Goal
) -> Iterator[Float[Tensor, "batch H W 3"]]:
    """dL/dI by batch; zero where not finite."""
    for start in range(0, len(images), BATCH):
        inputs = fit_images(images[start : start + BATCH], images.shape[1:3]).requires_grad_()
        losses = (goal.losses(member.logits(inputs), clamped=False).sum() for member in members)
        gradient = torch.stack([torch.autograd.grad(loss, inputs)[0] for loss in losses]).mean(0)
        yield gradient.nan_to_num(0, 0, 0).permute(0, 2, 3, 1).cpu()


def saliency_masks(maps: Float[Tensor, "views H W"], tau: float) -> Bool[Tensor, "views H W"]:
    """The pixels with a saliency of at least ``tau``, in [0, 1). Raises ``SpecError`` if there are none."""
    masks = maps >= tau
    if not masks.any():
        raise SpecError(f"No pixel of the target's images has a saliency of `tau: {tau:g}` or more; lower it.")
    return masks
