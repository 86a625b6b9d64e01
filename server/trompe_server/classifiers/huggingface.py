"""Image classifiers of the Hugging Face hub by name: safetensors and settings, no code of the repository."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from trompe_server.classifiers.contract import Normalised
from trompe_server.classifiers.extras import WEIGHTS, hub_file, import_extra
from trompe_server.classifiers.network import NamedNetwork
from trompe_shared.errors import ClassifierError


class _Logits(nn.Module):
    """A network of transformers that returns its logits alone."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        """(n, 3, H, W), normalised -> logits (n, classes)."""
        logits: Tensor = self.network(pixel_values=images, return_dict=False)[0]
        return logits


def load_huggingface(model: str) -> NamedNetwork:
    """The image classifier in the repository ``model`` (ORG/MODEL) of the hub.

    Image size and normalisation come from ``preprocessor_config.json``, class names from ``config.json``. Raises
    ``ClassifierError`` if transformers or a file is missing, and for a network that classifies no images.
    """
    settings = _settings(model)
    folder = hub_file(model, "config.json", extra="hf").parent
    huggingface_weights(model)
    transformers = import_extra("transformers", extra="hf")
    try:
        network = transformers.AutoModelForImageClassification.from_pretrained(
            folder, use_safetensors=True, trust_remote_code=False, local_files_only=True
        )
    except Exception as error:  # what a repository contains decides its kind
        raise ClassifierError(
            f"{model!r} cannot be loaded as an image classifier ({type(error).__name__}: {str(error)[:300]}). Give a "
            "repository of transformers' image classifiers with safetensors, or a .pt2 file."
        ) from error
    labels = network.config.id2label
    whole = Normalised(_Logits(network), mean=_statistic(settings, "mean", 0.0), std=_statistic(settings, "std", 1.0))
    return NamedNetwork(whole, _image_size(settings, model), [labels[index] for index in range(len(labels))])


def huggingface_weights(model: str) -> Path:
    """The file with the weights of the repository ``model``. Raises ``ClassifierError``."""
    return hub_file(model, WEIGHTS, extra="hf")


def _settings(model: str) -> Mapping[str, Any]:
    """How images become the network's input. Raises ``ClassifierError``."""
    name = "preprocessor_config.json"
    try:
        settings = json.loads(hub_file(model, name, extra="hf").read_bytes())
    except ValueError as error:
        raise ClassifierError(f"The {name} of {model!r} is not JSON ({error}); give a .pt2 file.") from error
    if not isinstance(settings, dict):
        raise ClassifierError(f"The {name} of {model!r} has no settings by name; give a .pt2 file.")
    return settings


def _statistic(settings: Mapping[str, Any], which: str, default: float) -> tuple[float, ...]:
    """Mean or std of the three channels."""
    given = settings.get(f"image_{which}") if settings.get("do_normalize", True) else None
    return tuple(given or [default] * 3)


def _image_size(settings: Mapping[str, Any], model: str) -> tuple[int, int]:
    """(H, W) of the input. Raises ``ClassifierError``."""
    size = settings.get("crop_size") if settings.get("do_center_crop") else None
    size = size or settings.get("size")
    if isinstance(size, int):
        return size, size
    if isinstance(size, dict):
        edge = size.get("shortest_edge")
        found = size.get("height", edge), size.get("width", edge)
        if isinstance(found[0], int) and isinstance(found[1], int):
            return found[0], found[1]
    raise ClassifierError(
        f"The preprocessor_config.json of {model!r} names no image size ({size!r}); give a .pt2 file."
    )
