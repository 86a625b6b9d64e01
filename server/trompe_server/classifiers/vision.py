"""torchvision's networks by name, with the image size and normalisation of their weights.

Nothing is downloaded: weights come from torch's cache and must include every tensor of the network, so that no layer
keeps random weights.
"""

from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import urlparse

import torch

from trompe_server.classifiers.contract import Normalised
from trompe_server.classifiers.extras import check_known, import_extra
from trompe_server.classifiers.network import NamedNetwork
from trompe_shared.errors import ClassifierError


class _LocalWeights:
    """An entry of torchvision's table of weights with tensors from a local file."""

    def __init__(self, entry: Any, tensors: dict[str, torch.Tensor]) -> None:
        self.entry, self.meta, self.tensors = entry, entry.meta, tensors

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        """The entry's class: torchvision accepts members of the network's own table only."""
        return type(self.entry)

    def get_state_dict(self, **_: Any) -> dict[str, torch.Tensor]:
        """The tensors for the network."""
        return self.tensors


def load_torchvision(model: str) -> NamedNetwork:
    """torchvision's classification network ``model`` with torchvision's default weights.

    Raises ``ClassifierError`` if torchvision, the network or the weights are missing or do not fit together.
    """
    models = import_extra("torchvision.models", extra="vision")
    entry, path = _find_weights(models, model)
    tensors = read_weights(path)
    try:
        network = models.get_model(model, weights=_LocalWeights(entry, tensors))
    except RuntimeError as error:
        raise ClassifierError(
            f"The weights in {path.name!r} do not fit torchvision's {model!r} ({str(error)[:300]}). Put the file from "
            f"{entry.url} there."
        ) from error
    transforms = entry.transforms()
    (side,) = transforms.crop_size
    whole = Normalised(network, mean=tuple(transforms.mean), std=tuple(transforms.std))
    return NamedNetwork(whole, (side, side), entry.meta["categories"])


def torchvision_weights(model: str) -> Path:
    """The file with torchvision's default weights of ``model`` in torch's cache. Raises ``ClassifierError``."""
    return _find_weights(import_extra("torchvision.models", extra="vision"), model)[1]


def _find_weights(models: Any, model: str) -> tuple[Any, Path]:
    """(entry of torchvision's table, file). Raises ``ClassifierError``."""
    check_known(model, models.list_models(module=models), "torchvision has no classification network")
    entry = models.get_model_weights(model).DEFAULT
    path = Path(torch.hub.get_dir()) / "checkpoints" / PurePosixPath(urlparse(entry.url).path).name
    if not path.is_file():
        raise ClassifierError(
            f"There is no file {str(path)!r}, and nothing is downloaded. Put the weights of {model} ({entry.name}) "
            f"from {entry.url} there."
        )
    return entry, path


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """The state dict in a file of ``torch.save``, tensors only. Raises ``ClassifierError``."""
    try:
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise ClassifierError(
            f"The weights in {path.name!r} cannot be read ({type(error).__name__}: {str(error)[:200]}); expected a "
            "state dict of tensors alone: torch.save(network.state_dict(), path)."
        ) from error
    if not isinstance(tensors, dict) or not all(isinstance(value, torch.Tensor) for value in tensors.values()):
        raise ClassifierError(
            f"{path.name!r} contains no state dict; save one with torch.save(network.state_dict(), path)."
        )
    return tensors
