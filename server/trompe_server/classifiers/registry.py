"""One way in: a file or a name becomes a classifier.

======================================== ====================================================================
``"tiny"``                               the classifier that is shipped; can be attacked
``x.pt2``                                ``torch.export.save``; can be attacked
``x.pt``, ``x.torchscript``              TorchScript; can be attacked
``x.onnx``                               only judges (or is attacked by its scores: ``score_based``)
``torchvision:mobilenet_v2``, or bare    torchvision's network with its own size and normalisation
``hub:owner/repo:model``                 from torch's cache; runs that repository's Python code
======================================== ====================================================================
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import torch

from trompe_server.classifiers.exported import load_exported
from trompe_server.classifiers.hub import load_hub
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.onnx import load_onnx
from trompe_server.classifiers.protocol import Classifier
from trompe_server.classifiers.tiny import CLASSES, IMAGE_SIZE, load_tiny
from trompe_server.classifiers.torchscript import load_torchscript
from trompe_server.classifiers.vision import load_torchvision
from trompe_shared.errors import ClassifierError

__all__ = ["ENDINGS", "load_classifier"]

ENDINGS: Final = (".pt2", ".pt", ".torchscript", ".onnx")
"""Of classifier files."""
KNOWN: Final = (
    "'tiny' (the one that is shipped), a .pt2 file (torch.export.save) or TorchScript file (.pt, .torchscript), which "
    "can be attacked, an .onnx file (only judges), torchvision:NAME or hub:OWNER/REPOSITORY:MODEL"
)


def load_classifier(
    path_or_name: str | Path,
    *,
    name: str | None = None,
    classes: Sequence[str] | None = None,
    weights: str | Path | None = None,
    image_size: tuple[int, int] | None = None,
    device: str = "cpu",
) -> Classifier:
    """The classifier of a file, or of a name (see the head of this module), on ``device`` (as torch names it).

    ``name`` is what reports call it (the file's name without its ending, or the network's, by default), ``classes``
    names its logits. ``weights`` are for networks by name: one of torchvision's weights, or a file with a state dict.
    ``image_size`` (H, W) is for those that do not tell it themselves: TorchScript and hub.
    Raises ``ClassifierError`` for anything else, and for what does not keep the contract.
    """
    _check_device(device)
    reference = str(path_or_name)
    kind, colon, model = reference.partition(":")
    if colon and kind == "torchvision":
        found: Classifier = load_torchvision(model, name=name, classes=classes, weights=weights, device=device)
    elif colon and kind == "hub":
        file = None if weights is None else Path(weights)
        found = load_hub(model, name=name, classes=classes, weights=file, image_size=image_size, device=device)
    elif reference != "tiny" and re.fullmatch(r"[a-z]\w*", reference, re.ASCII):
        found = _bare(reference, name=name, classes=classes, weights=weights, device=device)
    elif weights is not None:
        raise ClassifierError(
            f"{reference!r} has its own weights; give weights only with a network by name (torchvision:NAME, hub:...)."
        )
    elif reference == "tiny":
        found = _tiny(device)
    else:
        found = _from_file(Path(path_or_name), name, classes, image_size, device)
    _check_size(found, image_size)
    return found


def _bare(
    model: str, *, name: str | None, classes: Sequence[str] | None, weights: str | Path | None, device: str
) -> Classifier:
    try:
        return load_torchvision(model, name=name, classes=classes, weights=weights, device=device)
    except ClassifierError as error:
        raise ClassifierError(f"{model!r} was looked for in torchvision: {error} Or give {KNOWN}.") from error


def _from_file(
    path: Path, name: str | None, classes: Sequence[str] | None, image_size: tuple[int, int] | None, device: str
) -> Classifier:
    if path.suffix not in ENDINGS:
        raise ClassifierError(f"{str(path)!r} is no classifier that is known here: give {KNOWN}.")
    if not path.is_file():
        raise ClassifierError(f"There is no classifier file {str(path)!r}; check the path, or give 'tiny'.")
    if path.suffix == ".onnx":
        return load_onnx(path, name=name, classes=classes, device=device)
    if path.suffix == ".pt2":
        return load_exported(path, name=name, classes=classes, device=device)
    return load_torchscript(path, name=name, classes=classes, image_size=image_size, device=device)


def _tiny(device: str) -> NetworkClassifier:
    return NetworkClassifier("tiny", load_tiny().to(device).eval(), IMAGE_SIZE, len(CLASSES), tuple(CLASSES), device)


def _check_device(device: str) -> None:
    """Raise ``ClassifierError`` when torch cannot put a tensor there."""
    try:
        torch.zeros((), device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ClassifierError(
            f"The device {device!r} cannot be used here ({str(error).splitlines()[0][:200]}); give 'cpu', or install a "
            "torch that was built for it."
        ) from error


def _check_size(classifier: Classifier, image_size: tuple[int, int] | None) -> None:
    if image_size is not None and classifier.image_size != image_size:
        raise ClassifierError(
            f"{classifier.name!r} takes images of {classifier.image_size}, not {image_size}; leave image_size out."
        )
