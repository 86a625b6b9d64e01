"""The contract of a white-box network, and its check."""

from functools import partial
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from trompe_server.classifiers import protocol
from trompe_server.classifiers.fold import accelerate

SAME: Final = 1e-3
"""Largest difference of a logit of one image in two batches, relative to the largest logit."""


class Normalised(nn.Module):
    """A network preceded by its image normalisation."""

    mean: Tensor
    std: Tensor

    def __init__(self, network: nn.Module, *, mean: tuple[float, ...], std: tuple[float, ...]) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("mean", torch.tensor(mean).reshape(3, 1, 1))
        self.register_buffer("std", torch.tensor(std).reshape(3, 1, 1))

    def forward(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1]."""
        logits: Tensor = self.network((images - self.mean) / self.std)
        return logits


broken = partial(protocol.broken, batch=" with a dynamic batch")


def describe_value(value: Any) -> str:
    """A value's type and shape, for messages."""
    return f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"


def sample_images(size: tuple[int, int]) -> Float[Tensor, "2 3 H W"]:
    """Two images: plain grey and noise."""
    noise = torch.rand((1, 3, *size), generator=torch.Generator().manual_seed(0))
    return torch.cat([torch.full_like(noise, 0.5), noise])


def check_contract(network: nn.Module, sample: Float[Tensor, "2 3 H W"], file: str) -> int:
    """Return the number of classes.

    Raises ``ClassifierError`` unless the output is finite, differentiable logits, for each image by itself.
    """
    images = sample.clone().requires_grad_()
    try:
        logits = network(images)
    except Exception as error:  # of a network, which may raise anything
        remedy = "; compute x = x - mean in place of x -= mean" if "in-place" in str(error) else ""
        raise broken(file, f"it does not run on two images ({str(error)[:300]}){remedy}") from error
    if not isinstance(logits, Tensor) or logits.ndim != 2 or len(logits) != 2 or not logits.is_floating_point():
        raise broken(file, f"its output for two images is {describe_value(logits)}")
    if logits.shape[1] < 2:
        raise broken(file, "it gives one score: return one of each class, torch.cat([-z, z], 1) of a binary network")
    if not torch.isfinite(logits).all():
        raise broken(file, "its output is not finite")
    with torch.no_grad():
        difference = (network(sample[1:].repeat(2, 1, 1, 1)) - logits[1]).abs().max()
    if difference > SAME * logits.abs().max():
        raise broken(file, "its logits of an image depend on chance or on its batch: call eval() on the network first")
    protocol.refuse_probabilities(logits.detach().cpu().float().numpy(), file)
    weighted = logits @ torch.linspace(1, 2, logits.shape[1]).to(logits)  # a class may be constant, and so may the sum
    gradient = torch.autograd.grad(weighted.sum(), images, allow_unused=True)[0] if logits.requires_grad else None
    if gradient is None or not gradient.any():
        raise broken(file, "its output has no gradient in the image")
    return logits.shape[1]


def prepared(network: nn.Module, size: tuple[int, int], file: str, *, device: str) -> tuple[nn.Module, int]:
    """Return the same function on ``device``, faster if torch can export it, and its number of classes.

    Raises ``ClassifierError`` if the network breaks the contract on images of ``size`` (H, W).
    """
    network = network.to(device).eval().requires_grad_(False)
    sample = sample_images(size).to(device)
    n_classes = check_contract(network, sample, file)
    try:
        program = torch.export.export(network, (sample,), dynamic_shapes=({0: torch.export.Dim.DYNAMIC},))
    except Exception:  # torch.export raises errors of any kind; then the network runs unchanged
        return network, n_classes
    return accelerate(program.module(check_guards=False), sample), n_classes
