"""A white-box classifier around a torch network."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from trompe_server.classifiers.contract import prepared
from trompe_server.classifiers.protocol import Images, Logits, check_classes, finite, fit_images, in_batches

BATCH = 10


@dataclass(frozen=True)
class NetworkClassifier:
    """A network (N, 3, H, W) in [0, 1] -> logits (N, n_classes) on ``device``; freezes its parameters."""

    name: str
    network: nn.Module
    image_size: tuple[int, int]
    n_classes: int
    classes: tuple[str, ...] | None = None
    device: str = "cpu"

    def __post_init__(self) -> None:
        self.network.requires_grad_(False)

    def logits(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1] of size ``image_size``, differentiable in the images and on their device."""
        logits: Tensor = self.network(images.to(self.device))
        return logits.to(images.device)

    @torch.no_grad()
    def scores(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """The same logits without a gradient."""
        return self.logits(images)

    @torch.no_grad()
    def predict(self, images: Images) -> Logits:
        """Logits (N, n_classes), all finite, of uint8 images (N, H, W, 3) of any size."""
        chunks = [np.zeros((0, self.n_classes), np.float32)]
        for batch in in_batches(images, BATCH):
            chunks.append(finite(self.logits(fit_images(batch, self.image_size))).numpy())
        return np.concatenate(chunks)


def prepared_classifier(
    network: nn.Module, size: tuple[int, int], name: str, classes: Sequence[str] | None, *, device: str
) -> NetworkClassifier:
    """The network, normalisation inside, as a classifier of images of ``size`` (H, W), faster if torch can export it.

    Raises ``ClassifierError`` if it breaks the contract, or has another number of classes.
    """
    fast, n_classes = prepared(network, size, name, device=device)
    return NetworkClassifier(name, fast, size, n_classes, check_classes(classes, n_classes, name), device)
