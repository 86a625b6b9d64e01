"""RobustBench's ImageNet networks by name, which contain their normalisation."""

import difflib
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from trompe_server.classifiers.extras import import_extra
from trompe_server.classifiers.network import NetworkClassifier, prepared_classifier
from trompe_shared.errors import ClassifierError

DATASET = "imagenet"


def load_robustbench(
    model: str,
    *,
    name: str | None = None,
    classes: Sequence[str] | None = None,
    weights: None = None,
    device: str = "cpu",
) -> NetworkClassifier:
    """Load RobustBench's ImageNet network ``model`` (``Salman2020Do_R50``) as a white box.

    RobustBench downloads missing weights to ``robustbench`` in torch's cache. Raises ``ClassifierError`` if
    RobustBench, the network or its weights are missing.
    """
    if weights is not None:
        raise ClassifierError(f"robustbench:{model} has its own weights; leave out weights.")
    utils = _robustbench("utils")
    threat = _threat_model(model)
    try:
        network = utils.load_model(model, model_dir=_folder(), dataset=DATASET, threat_model=threat)
    except Exception as error:  # any that a download or a file raises
        raise ClassifierError(
            f"RobustBench cannot load {model!r} ({type(error).__name__}: {str(error)[:300]}). Put its weights at "
            f"{str(robustbench_weights(model))!r}."
        ) from error
    steps = _robustbench("data").get_preprocessing(utils.BenchmarkDataset(DATASET), threat, model, None).transforms
    size = next(step.size for step in reversed(steps) if hasattr(step, "size"))
    names = classes or import_extra("torchvision.models", extra="vision").ResNet50_Weights.DEFAULT.meta["categories"]
    return prepared_classifier(network, tuple(size), name or model, names, device=device)


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
    found = next((threat for threat, models in zoo.items() if model in models), None)
    if found is None:
        known = sorted({each for models in zoo.values() for each in models})
        near = ", ".join(difflib.get_close_matches(model, known)) or ", ".join(known[:5])
        raise ClassifierError(f"RobustBench has no ImageNet network {model!r}; try one of {near}.")
    return found
