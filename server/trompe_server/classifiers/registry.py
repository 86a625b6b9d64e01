"""Load a classifier from a file or by its name.

======================================== ====================================================
reference                                classifier
======================================== ====================================================
``tiny``                                 the shipped network; can be attacked
``x.pt2``                                file of ``torch.export.save``; can be attacked
``x.onnx``                               gives scores only; attacked through ``score_based``
``torchvision:NAME``, or the bare name   network of torchvision, timm, RobustBench (ImageNet) or
``timm:NAME``                            of the Hugging Face hub, with its own image size,
``robustbench:NAME``                     normalisation and class names; can be attacked
``hf:ORG/MODEL``
======================================== ====================================================
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import torch

from trompe_server.classifiers.contract import prepared
from trompe_server.classifiers.fold import Formatted, fastest_format
from trompe_server.classifiers.huggingface import huggingface_weights, load_huggingface
from trompe_server.classifiers.network import NamedNetwork, NetworkClassifier
from trompe_server.classifiers.onnx import OnnxClassifier, load_onnx
from trompe_server.classifiers.protocol import Classifier, check_classes
from trompe_server.classifiers.robustbench_networks import load_robustbench, robustbench_weights
from trompe_server.classifiers.timm_networks import load_timm, timm_weights
from trompe_server.classifiers.tiny import CLASSES, IMAGE_SIZE, WEIGHTS, FoldedTinyNet, load_tiny
from trompe_server.classifiers.vision import load_torchvision, torchvision_weights
from trompe_shared.errors import ClassifierError
from trompe_shared.local_files import LOOKED_UP


def load_exported(path: Path, device: str) -> NetworkClassifier:
    """As ``exported.load_exported``. Importing ``torch.export`` takes as long as importing torch."""
    from trompe_server.classifiers import exported

    return exported.load_exported(path, device)


LOADERS: Final[Mapping[str, Callable[[Path, str], NetworkClassifier | OnnxClassifier]]] = {
    ".pt2": load_exported,
    ".onnx": load_onnx,
}
"""By the ending of the file."""


class _Zoo(NamedTuple):
    """Networks of a library: loader by name, file of weights by name."""

    load: Callable[[str], NamedNetwork]
    weights: Callable[[str], Path]


ZOOS: Final[Mapping[str, _Zoo]] = {
    "torchvision:": _Zoo(load_torchvision, torchvision_weights),
    "timm:": _Zoo(load_timm, timm_weights),
    "robustbench:": _Zoo(load_robustbench, robustbench_weights),
    "hf:": _Zoo(load_huggingface, huggingface_weights),
}
"""By the prefix of the reference."""

KNOWN: Final = (
    "'tiny' (the shipped network), a .pt2 file (torch.export.save), an .onnx file (scores only), or a network by name "
    f"({', '.join(ZOOS)})"
)


def load_classifier(
    path_or_name: str | Path,
    *,
    name: str | None = None,
    classes: Sequence[str] | None = None,
    device: str = "cpu",
) -> Classifier:
    """Load the classifier ``path_or_name`` (see the table above) on the torch device ``device``.

    name: name for reports; by default the file's name without its ending, or the network's.
    classes: class names in the order of the logits.

    Raises ``ClassifierError`` for an unknown reference and for a network that breaks the contract.
    """
    _prepare_device(device)
    reference = str(path_or_name)
    if reference.startswith(LOOKED_UP):
        return _by_name(reference, name, classes, device)
    if reference != "tiny" and re.fullmatch(r"[a-z]\w*", reference, re.ASCII):
        try:
            return _by_name(f"torchvision:{reference}", name, classes, device)
        except ClassifierError as error:
            raise ClassifierError(
                f"{reference!r} was taken for a torchvision network: {error} Or give {KNOWN}."
            ) from error
    if reference == "tiny":
        names = check_classes(classes or CLASSES, len(CLASSES), reference)
        network = Formatted(FoldedTinyNet(load_tiny()).to(device), fastest_format(torch.device(device)))
        return NetworkClassifier(name or reference, network, IMAGE_SIZE, len(CLASSES), names, device)
    return _from_file(Path(path_or_name), name, classes, device)


def classifier_file(reference: str) -> Path:
    """The file with the weights of the classifier that ``load_classifier`` loads. Raises ``ClassifierError``."""
    if reference == "tiny":
        return WEIGHTS
    if reference.startswith(LOOKED_UP):
        zoo, model = _zoo(reference)
        return zoo.weights(model)
    return Path(reference) if reference.lower().endswith(tuple(LOADERS)) else torchvision_weights(reference)


def _zoo(reference: str) -> tuple[_Zoo, str]:
    """The library of a network by name, and its name there."""
    prefix = next(prefix for prefix in ZOOS if reference.startswith(prefix))
    return ZOOS[prefix], reference.removeprefix(prefix)


def _by_name(reference: str, name: str | None, classes: Sequence[str] | None, device: str) -> NetworkClassifier:
    zoo, model = _zoo(reference)
    found, name = zoo.load(model), name or model
    network, n_classes = prepared(found.network, found.image_size, name, device=device)
    names = check_classes(classes or found.classes, n_classes, name)
    return NetworkClassifier(name, network, found.image_size, n_classes, names, device)


def _from_file(path: Path, name: str | None, classes: Sequence[str] | None, device: str) -> Classifier:
    load = LOADERS.get(path.suffix.lower())
    if load is None:
        raise ClassifierError(f"{str(path)!r} is not a supported classifier; give {KNOWN}.")
    if not path.is_file():
        raise ClassifierError(f"There is no classifier file {str(path)!r}; check the path, or give 'tiny'.")
    loaded = load(path, device)
    names = check_classes(classes, loaded.n_classes, path.name)
    return replace(loaded, name=name or path.stem, classes=names)


def _prepare_device(device: str) -> None:
    """Raise ``ClassifierError`` if torch cannot put a tensor on ``device``.

    On a graphics card convolutions are computed in full precision from then on: judgements must not depend on the
    device.
    """
    try:
        if torch.zeros((), device=device).is_cuda:
            torch.backends.cudnn.allow_tf32 = False
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ClassifierError(
            f"The device {device!r} cannot be used here ({str(error).splitlines()[0][:200]}); give 'cpu', or install a "
            "torch built for it."
        ) from error
