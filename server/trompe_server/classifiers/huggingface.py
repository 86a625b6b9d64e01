"""Image classifiers of the Hugging Face hub by name: safetensors and settings, no code of the repository."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor, nn

from trompe_server.classifiers.contract import Normalised
from trompe_server.classifiers.extras import WEIGHTS, hub_file, import_extra
from trompe_server.classifiers.network import NamedNetwork
from trompe_server.classifiers.protocol import refusing
from trompe_shared.errors import ClassifierError


class _Logits(nn.Module):
    """A network of transformers that returns its logits alone. ``bgr``: whether it takes the channels in that order."""

    def __init__(self, network: nn.Module, *, bgr: bool) -> None:
        super().__init__()
        self.network, self.bgr = network, bgr

    def forward(self, images: Tensor) -> Tensor:
        """(n, 3, H, W), RGB, normalised -> logits (n, classes)."""
        ordered = images.flip(1) if self.bgr else images
        logits: Tensor = self.network(pixel_values=ordered, return_dict=False)[0]
        return logits


def load_huggingface(model: str) -> NamedNetwork:
    """The image classifier in the repository ``model`` (ORG/MODEL) of the hub.

    Image size, normalisation and order of channels come from ``preprocessor_config.json``, class names from
    ``config.json``. The network computes in single precision. Raises ``ClassifierError`` if transformers or a file is
    missing, and for a network that classifies no images or has no trained head.
    """
    settings = _settings(model)
    folder = hub_file(model, "config.json", extra="hf").parent
    huggingface_weights(model)
    network = _trained(folder, model)
    mean, std = _normalisation(settings, model)
    whole = Normalised(_Logits(network, bgr=bool(settings.get("do_flip_channel_order"))), mean=mean, std=std)
    return NamedNetwork(whole, _image_size(settings, model), _class_names(network.config.id2label))


def _trained(folder: Path, model: str) -> Any:
    """The network with all its weights from ``folder``. Raises ``ClassifierError``."""
    import_extra("transformers.modeling_utils", extra="hf")  # tells of a torchvision for another torch
    transformers = import_extra("transformers", extra="hf")
    remedy = ". Give a repository of transformers' image classifiers with safetensors, or a .pt2 file."
    with refusing(f"{model!r} cannot be loaded as an image classifier", remedy=remedy):
        network, report = transformers.AutoModelForImageClassification.from_pretrained(
            folder, use_safetensors=True, trust_remote_code=False, local_files_only=True, output_loading_info=True
        )
    missing = sorted(dict(network.named_parameters()).keys() & report["missing_keys"])
    if missing:  # transformers draws them at random
        raise ClassifierError(
            f"{model!r} is not trained to classify images: its file lacks {', '.join(missing[:3])}. Give a repository "
            "with a trained classifier, or a .pt2 file."
        )
    return network.float()


def huggingface_weights(model: str) -> Path:
    """The file with the weights of the repository ``model``. Raises ``ClassifierError``."""
    return hub_file(model, WEIGHTS, extra="hf")


def _class_names(labels: Mapping[int, Any]) -> list[str] | None:
    """The names in the order of the logits; ``None`` if they are not numbered from 0."""
    return [str(labels[index]) for index in range(len(labels))] if set(labels) == {*range(len(labels))} else None


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


def _normalisation(settings: Mapping[str, Any], model: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Mean and standard deviation of the three channels of images in [0, 1] that have the same effect as ``settings``.

    transformers multiplies pixels in [0, 255] by ``rescale_factor`` (1 / 255), subtracts 1 (``rescale_offset``),
    normalises, and divides by the standard deviation once more (``include_top``). Its processor that flips channels
    never normalises, whatever the settings. Raises ``ClassifierError`` if mean or standard deviation is missing: each
    processor has another default.
    """
    rescaled = settings.get("do_rescale", True)
    white = 255 * (settings.get("rescale_factor") or 1 / 255) if rescaled else 255.0
    black = -1.0 if rescaled and settings.get("rescale_offset") else 0.0
    mean, std, divisor = np.zeros(3), np.ones(3), settings.get("image_std") or 1.0
    if settings.get("do_normalize", True) and "do_flip_channel_order" not in settings:
        if not (settings.get("image_mean") and settings.get("image_std")):
            raise ClassifierError(
                f"The preprocessor_config.json of {model!r} names no image_mean or no image_std; give a .pt2 file."
            )
        mean, std = mean + settings["image_mean"], std * divisor
    if settings.get("include_top"):
        std = std * divisor
    return tuple(((mean - black) / white).tolist()), tuple((std / white).tolist())


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
