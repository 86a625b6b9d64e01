"""Where in the target's images the loss is most sensitive: the pixels that an attack with ``tau`` may use."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from trompe_server.attack.goal import margin
from trompe_server.classifiers import WhiteBoxClassifier

__all__ = ["BATCH", "saliency", "saliency_masks"]

BATCH = 10


def saliency(images: NDArray[np.uint8], classifier: WhiteBoxClassifier, label: int) -> Float[torch.Tensor, "views H W"]:
    """|dL/dI| of the target's images (views, H, W, 3), mean over channels, rescaled to [0, 1] over all views (the
    paper's equation 5).

    L is the margin without its clamp, so that a view that is fooled already has a saliency too.
    """
    maps = []
    for start in range(0, len(images), BATCH):
        batch = torch.from_numpy(images[start : start + BATCH]).float().div(255)
        inputs = batch.permute(0, 3, 1, 2).requires_grad_()
        (gradient,) = torch.autograd.grad(margin(classifier.logits(inputs), label).sum(), inputs)
        maps.append(gradient.abs().mean(1).cpu())
    everything = torch.cat(maps)
    low, high = everything.min(), everything.max()
    return (everything - low) / (high - low).clamp(min=1e-30)


def saliency_masks(maps: Float[torch.Tensor, "views H W"], tau: float) -> Bool[torch.Tensor, "views H W"]:
    """The pixels whose saliency is at least ``tau``, in [0, 1)."""
    return maps >= tau
