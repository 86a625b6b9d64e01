"""timm's networks by name, with the image size, normalisation and class names of their weights."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trompe_server.classifiers.contract import Normalised
from trompe_server.classifiers.extras import WEIGHTS, check_known, hub_file, import_extra
from trompe_server.classifiers.network import NamedNetwork
from trompe_shared.errors import ClassifierError


def load_timm(model: str, *, classes: Sequence[str] | None = None, weights: str | Path | None = None) -> NamedNetwork:
    """timm's network ``model`` (``vit_base_patch16_224``, or with the tag of its weights).

    weights: file of a state dict (safetensors, or tensors of ``torch.save``); default: the weights of timm's hub.

    Raises ``ClassifierError`` if timm, the network or the weights are missing or do not fit together.
    """
    timm = _timm(model)
    path = timm_weights(model) if weights is None else Path(weights)
    if not path.is_file():
        raise ClassifierError(f"There is no file {str(path)!r} with weights of {model!r}; check the path.")
    known = {} if classes is None else {"num_classes": len(classes)}
    try:
        overlay = {"file": str(path), "custom_load": False}
        network = timm.create_model(model, pretrained=True, pretrained_cfg_overlay=overlay, **known)
    except Exception as error:  # what a file contains decides its kind
        raise ClassifierError(
            f"The weights in {path.name!r} do not fit timm's {model!r} ({type(error).__name__}: {str(error)[:300]}). "
            "Give a state dict of this network, and one class name for each of its logits."
        ) from error
    config = timm.data.resolve_model_data_config(network)
    whole = Normalised(network, mean=config["mean"], std=config["std"])
    subset = timm.data.infer_imagenet_subset(network)  # if it has the classes of a part of ImageNet that timm knows
    names = None if subset is None else timm.data.ImageNetInfo(subset).label_descriptions()
    return NamedNetwork(whole, config["input_size"][1:], names)


def timm_weights(model: str) -> Path:
    """The file with the weights of ``model`` from timm's hub. Raises ``ClassifierError``."""
    config = _timm(model).get_pretrained_cfg(model)
    if config is None or not config.hf_hub_id:
        raise ClassifierError(f"timm has no weights of {model!r} on its hub; give a file with a state dict as weights.")
    return hub_file(config.hf_hub_id, WEIGHTS, extra="timm")


def _timm(model: str) -> Any:
    """timm, which must have ``model``. Raises ``ClassifierError``."""
    timm = import_extra("timm", extra="timm")
    if not timm.is_model(model):
        check_known(model, timm.list_models(), "timm has no network")
    return timm
