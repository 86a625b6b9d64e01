"""The shipped classifier: a small convolutional network for the shipped objects.

It serves first attacks and tests and was not trained to be robust. ``scripts/train_classifier.py`` trains it.
"""

from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from trompe_server.classifiers.convolution import convolved
from trompe_shared.errors import ClassifierError

CLASSES: Final = ("ball", "book", "bottle", "chair", "lamp", "mug", "table", "teapot")
"""Class names in the order of the logits."""
IMAGE_SIZE: Final = (128, 128)
"""(H, W) of the images it was trained on."""
WEIGHTS: Final = Path(__file__).with_name("tiny.npz")

MEAN: Final = 0.75
SPREAD: Final = 0.3
WIDTHS: Final = (24, 48, 96, 160)


class TinyNet(nn.Module):
    """Seven 3x3 convolutions with batch normalisation (16-fold downsampling), averaging, one linear layer."""

    def __init__(self) -> None:
        super().__init__()
        layers = [_convolution(3, WIDTHS[0], stride=2)]
        for before, after in pairwise(WIDTHS):
            layers += [_convolution(before, after, stride=2), _convolution(after, after, stride=1)]
        self.features = nn.Sequential(*layers)
        self.head = nn.Linear(WIDTHS[-1], len(CLASSES))

    def forward(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1]; includes the normalisation."""
        features = self.features((images - MEAN) / SPREAD)  # (n, 160, H / 16, W / 16)
        logits: Tensor = self.head(features.mean(dim=(2, 3)))
        return logits


class FoldedTinyNet(nn.Module):
    """The function of a ``TinyNet`` in evaluation mode, each convolution with its batch norm and activation as one
    operator."""

    def __init__(self, network: TinyNet) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(fuse_conv_bn_eval(unit[0], unit[1]) for unit in network.features)  # type: ignore[index]
        self.head = network.head

    def forward(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1]; includes the normalisation."""
        features = (images - MEAN) / SPREAD
        for each in self.convolutions:
            assert isinstance(each, nn.Conv2d)
            features = convolved(features, each.weight, each.bias, (each.stride, (1, 1), (1, 1), 1), "relu")
        logits: Tensor = self.head(features.mean(dim=(2, 3)))
        return logits


def _convolution(before: int, after: int, *, stride: int) -> nn.Sequential:
    convolution = nn.Conv2d(before, after, 3, stride=stride, padding=1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(after), nn.ReLU(inplace=True))


def load_tiny(path: Path = WEIGHTS) -> TinyNet:
    """The trained network in evaluation mode with frozen parameters.

    Raises ``ClassifierError`` if the shipped weights are missing or do not fit.
    """
    network = TinyNet()
    try:
        with np.load(path, allow_pickle=False) as arrays:
            state = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
        network.load_state_dict(state)
    except (OSError, ValueError, RuntimeError) as error:
        raise ClassifierError(
            f"The weights of the shipped classifier ({path.name}) cannot be read ({str(error).splitlines()[0]}). "
            "Install trompe again, or train it with scripts/train_classifier.py."
        ) from error
    return network.eval().requires_grad_(False)


def save_tiny(network: TinyNet, path: Path = WEIGHTS) -> None:
    """Write the weights, convolutions in half precision: half the size, the same predictions."""
    state = {name: tensor.cpu().numpy() for name, tensor in network.state_dict().items()}
    narrow = {name: array.astype(np.float16) if array.ndim > 1 else array for name, array in state.items()}
    np.savez(path, allow_pickle=False, **narrow)
