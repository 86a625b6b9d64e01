"""Classifiers of ART and foolbox as victims, with their preprocessing and range of values.

The other way needs no code: a ``NetworkClassifier``'s ``network`` takes images in [0, 1], so
``foolbox.PyTorchModel(classifier.network, bounds=(0, 1))`` and ART's ``PyTorchClassifier`` take it as it is.
"""

from collections.abc import Callable, Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from trompe_server.classifiers.contract import check_contract, sample_images
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.protocol import check_classes
from trompe_shared.errors import ClassifierError


class _Rescaled(nn.Module):
    """A function of images in ``bounds`` as a network of images in [0, 1]."""

    def __init__(self, logits: Callable[[Tensor], Tensor], bounds: tuple[float, float]) -> None:
        super().__init__()
        self.logits, (self.lower, self.upper) = logits, bounds

    def forward(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1]."""
        return self.logits(self.lower + (self.upper - self.lower) * images)


def from_foolbox(
    model: Any, *, image_size: tuple[int, int], classes: Sequence[str] | None = None, name: str = "foolbox"
) -> NetworkClassifier:
    """foolbox's ``PyTorchModel`` as a white box for images of ``image_size`` (H, W), on the model's device.

    Raises ``ClassifierError`` for a model of another kind, and if it breaks the contract of a white box.
    """
    if not (callable(model) and hasattr(model, "bounds") and hasattr(model, "device")):
        raise ClassifierError(f"Expected foolbox's PyTorchModel, got {type(model).__name__}; wrap the network in one.")
    return _adapted(model, tuple(model.bounds), image_size, classes, name, str(model.device))


def from_art(model: Any, *, classes: Sequence[str] | None = None, name: str = "art") -> NetworkClassifier:
    """ART's ``PyTorchClassifier`` as a white box for images of its ``input_shape``, on its device.

    Raises ``ClassifierError`` if its images are not (3, H, W) with ``clip_values`` of two numbers, if it changes scores
    (``postprocessing_defences``) or is of another kind, and if it breaks the contract of a white box.
    """
    if not (hasattr(model, "clip_values") and isinstance(getattr(model, "model", None), nn.Module)):
        raise ClassifierError(f"Expected ART's PyTorchClassifier, got {type(model).__name__}; wrap the network in one.")
    if model.postprocessing_defences:
        raise ClassifierError(
            f"The ART classifier changes scores by {model.postprocessing_defences}, which cannot be attacked; leave "
            "them out."
        )
    shape, bounds = tuple(model.input_shape), model.clip_values
    if len(shape) != 3 or shape[0] != 3 or bounds is None or any(getattr(end, "ndim", 0) for end in bounds):
        raise ClassifierError(
            f"An ART classifier with input_shape {shape} and clip_values {bounds} cannot be attacked; expected "
            "(3, H, W) and two numbers such as (0, 1)."
        )

    def logits(images: Tensor) -> Tensor:
        ready, _ = model._apply_preprocessing(images, y=None, fit=False, no_grad=False)
        found: Tensor = model.model(ready)
        return found

    model.model.eval()
    return _adapted(logits, tuple(map(float, bounds)), shape[1:], classes, name, str(model.device))


def _adapted(
    logits: Callable[[Tensor], Tensor],
    bounds: Any,
    size: tuple[int, int],
    classes: Sequence[str] | None,
    name: str,
    device: str,
) -> NetworkClassifier:
    network = _Rescaled(logits, bounds).eval()
    n_classes = check_contract(network, sample_images(size).to(device), name)
    return NetworkClassifier(name, network, size, n_classes, check_classes(classes, n_classes, name), device)
