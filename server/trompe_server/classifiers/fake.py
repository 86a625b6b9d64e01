"""A small classifier with fixed random weights: real gradients in no time, for tests of what uses a classifier."""

import torch
from torch import nn

from trompe_server.classifiers.network import NetworkClassifier

__all__ = ["fake_classifier"]


def fake_classifier(
    *,
    n_classes: int = 10,
    image_size: tuple[int, int] = (32, 32),
    seed: int = 0,
    classes: tuple[str, ...] | None = None,
) -> NetworkClassifier:
    """A classifier that looks at a 4 x 4 thumbnail through one hidden layer; the ``seed`` fixes its weights."""
    hidden, generator = 32, torch.Generator().manual_seed(seed)
    network = nn.Sequential(
        nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(48, hidden), nn.ReLU(), nn.Linear(hidden, n_classes)
    )
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * (2 / parameter.shape[-1]) ** 0.5)
    return NetworkClassifier("fake", network, image_size, n_classes, classes)
