"""RobustBench's ImageNet networks by name, which contain their normalisation."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import torch

from trompe_server.classifiers.extras import check_known, import_extra
from trompe_server.classifiers.network import NamedNetwork
from trompe_server.classifiers.protocol import refusing

DATASET = "imagenet"


def load_robustbench(model: str) -> NamedNetwork:
    """RobustBench's ImageNet network ``model`` (``Salman2020Do_R50``).

    RobustBench downloads missing weights to ``robustbench`` in torch's cache. Raises ``ClassifierError`` if
    RobustBench, the network or its weights are missing.
    """
    utils = _robustbench("utils")
    threat = _threat_model(model)
    remedy = f". Put its weights at {str(robustbench_weights(model))!r}."
    with refusing(f"RobustBench cannot load {model!r}", remedy=remedy):
        network = utils.load_model(model, model_dir=_folder(), dataset=DATASET, threat_model=threat)
    steps = _robustbench("data").get_preprocessing(utils.BenchmarkDataset(DATASET), threat, model, None).transforms
    size = next(step.size for step in reversed(steps) if hasattr(step, "size"))
    models = import_extra("torchvision.models", extra="vision")
    return NamedNetwork(network, tuple(size), models.ResNet50_Weights.DEFAULT.meta["categories"])


def robustbench_weights(model: str) -> Path:
    """Where RobustBench keeps the weights of ``model``. Raises ``ClassifierError``."""
    return _folder().joinpath(DATASET, _threat_model(model).value, f"{model}.pt")


def _robustbench(module: str) -> Any:
    """A module of RobustBench, which imports autoattack; its requirement pyautoattack has that under its own name."""
    if "autoattack" not in sys.modules and importlib.util.find_spec("autoattack") is None:
        for part in ("", ".state"):
            sys.modules["autoattack" + part] = import_extra("pyautoattack" + part, extra="robustbench")
    return import_extra(f"robustbench.{module}", extra="robustbench")


def _folder() -> Path:
    return Path(torch.hub.get_dir()) / "robustbench"


def _threat_model(model: str) -> Any:
    """The threat model against which ``model`` was trained. Raises ``ClassifierError`` for an unknown network."""
    zoo = _robustbench("model_zoo.imagenet").imagenet_models
    threats = {each: threat for threat, models in reversed(zoo.items()) for each in models}
    check_known(model, sorted(threats), "RobustBench has no ImageNet network")
    return threats[model]
