"""A white-box classifier around a torch network."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from trompe_server.classifiers.protocol import AT_ONCE, BATCH, Images, Logits, predicted
from trompe_shared.errors import ClassifierError


class NamedNetwork(NamedTuple):
    """A network of a library: its normalisation inside, the size (H, W) of its images, its class names, if known."""

    network: nn.Module
    image_size: tuple[int, int]
    classes: Sequence[str] | None


@dataclass(frozen=True)
class NetworkClassifier:
    """A network (N, 3, H, W) in [0, 1] -> logits (N, n_classes) on ``device``; freezes its parameters.

    Raises ``ClassifierError`` for another number of class names, for what is no network, for an ``image_size`` that is
    not (H, W), and for a network in training, where an image's logits hang on chance or on its batch.
    """

    name: str
    network: nn.Module
    image_size: tuple[int, int]
    n_classes: int
    classes: tuple[str, ...] | None = None
    device: str = "cpu"

    def __post_init__(self) -> None:
        if self.classes is not None and len(self.classes) != self.n_classes:
            raise ClassifierError(f"{self.name!r} has {self.n_classes} classes, but {len(self.classes)} class names.")
        if not isinstance(self.network, nn.Module):
            raise ClassifierError(f"The network {self.name!r} is a {type(self.network).__name__}, not a torch module.")
        if not (isinstance(self.image_size, Sequence) and [type(side) for side in self.image_size] == [int, int]):
            raise ClassifierError(f"`image_size` of {self.name!r} must be (height, width), got {self.image_size!r}.")
        for parameter in self.network.parameters():
            parameter.requires_grad_(False)
        if any(each.training and _heeds_training(each) for each in self.network.modules()):
            raise ClassifierError(f"The network {self.name!r} is in training: call eval() on it first.")

    def logits(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Float32 logits of sRGB images in [0, 1] of size ``image_size``, differentiable in them and on their device.

        A graphics card plans a network anew for each number of images, which takes longer than 40 of them: fewer are
        filled up.
        """
        given = images.to(self.device)
        if given.is_cuda and 0 < len(given) < AT_ONCE:
            given = torch.cat([given, given.new_zeros(AT_ONCE - len(given), *given.shape[1:])])
        logits = self._output(given)[: len(images)]
        if logits.shape[1:] != (self.n_classes,):
            raise ClassifierError(
                f"The network {self.name!r} gives {tuple(logits.shape[1:])} scores an image, not {self.n_classes}."
            )
        return logits.to(images.device, torch.float32)

    def _output(self, images: Tensor) -> Tensor:
        try:
            output = self.network(images)
        except torch.OutOfMemoryError:
            raise
        except (RuntimeError, TypeError) as error:
            raise ClassifierError(
                f"The network {self.name!r} fails on float32 images {tuple(images.shape)} ({str(error)[:200]})."
            ) from error
        if not isinstance(output, Tensor):
            raise ClassifierError(
                f"The network {self.name!r} gives a {type(output).__name__}; expected a tensor of logits: put it "
                "into a module that returns these alone."
            )
        if torch.is_grad_enabled() and images.requires_grad and not output.requires_grad:
            raise ClassifierError(f"The network {self.name!r} has no gradient: its logits are detached from its input.")
        return output

    @torch.no_grad()
    def scores(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """The same logits without a gradient."""
        return self.logits(images)

    def predict(self, images: Images) -> Logits:
        """Logits (N, n_classes), all finite, of uint8 images (N, H, W, 3) of any size."""
        cpu = torch.device(self.device).type == "cpu"
        return predicted(
            *(self.scores, images, self.image_size, self.n_classes),
            batch=BATCH if cpu else AT_ONCE,
            device=self.device,
            split=cpu,
        )


def _heeds_training(module: nn.Module) -> bool:
    """Whether a module computes something else in training, such as a batch norm or a dropout."""
    code = getattr(type(module).forward, "__code__", None)
    return code is not None and "training" in code.co_names
