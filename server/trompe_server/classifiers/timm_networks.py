"""timm's networks by name, with the image size, normalisation and class names of their weights."""

from pathlib import Path
from typing import Any

from trompe_server.classifiers.contract import Normalised
from trompe_server.classifiers.extras import WEIGHTS, check_known, hub_file, import_extra
from trompe_server.classifiers.network import NamedNetwork
from trompe_server.classifiers.protocol import refusing
from trompe_shared.errors import ClassifierError


def load_timm(model: str) -> NamedNetwork:
    """timm's network ``model`` (``vit_base_patch16_224``, or with the tag of its weights), weights from timm's hub.

    Raises ``ClassifierError`` if timm, the network or the weights are missing or do not fit together.
    """
    timm, path = _timm(model), timm_weights(model)
    misfit = f"The weights in {str(path)!r} do not fit timm's {model!r}"
    with refusing(misfit, remedy=". Delete this file, and it is downloaded again."):
        overlay = {"file": str(path), "custom_load": False}
        network = timm.create_model(model, pretrained=True, pretrained_cfg_overlay=overlay)
    config = timm.data.resolve_model_data_config(network)
    whole = Normalised(network, mean=config["mean"], std=config["std"])
    subset = timm.data.infer_imagenet_subset(network)  # if it has the classes of a part of ImageNet that timm knows
    names = None if subset is None else timm.data.ImageNetInfo(subset).label_descriptions()
    return NamedNetwork(whole, config["input_size"][1:], names)


def timm_weights(model: str) -> Path:
    """The file with the weights of ``model`` from timm's hub. Raises ``ClassifierError``."""
    config = _timm(model).get_pretrained_cfg(model)
    if config is None or not config.hf_hub_id:
        raise ClassifierError(f"timm has no weights of {model!r} on its hub; give a .pt2 file.")
    if not config.num_classes:
        raise ClassifierError(
            f"timm's weights of {model!r} ({config.tag}) have no classes: they give features. Name others, as NAME.TAG."
        )
    return hub_file(config.hf_hub_id, WEIGHTS, extra="timm")


def _timm(model: str) -> Any:
    """timm, which must have ``model``. Raises ``ClassifierError``."""
    timm = import_extra("timm", extra="timm")
    if not timm.is_model(model):
        check_known(model, timm.list_models(), "timm has no network")
    return timm
