"""Networks from torch hub repositories that are in torch's cache already: ``hub:owner/repository:model``.

A hub repository is Python code, and loading a network runs it: name one only that you would run. Nothing is downloaded
by this module; code that finds its weights missing may try to. Whether the weights are those that were trained is
tested: a network that comes out different when it is loaded twice was left with random ones.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import torch
from torch import nn

from trompe_server.classifiers.contract import Normalised, prepared
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.protocol import check_classes
from trompe_server.classifiers.vision import read_weights
from trompe_shared.errors import ClassifierError

__all__ = ["load_hub"]

CONVENTION: Final = {"input_size": (3, 224, 224), "mean": (0.485, 0.456, 0.406), "std": (0.229, 0.224, 0.225)}
"""What networks on torch hub expect where they do not say otherwise (as timm's do, in ``pretrained_cfg``)."""
TRAINED: Final[tuple[dict[str, Any], ...]] = ({"pretrained": True}, {"weights": "DEFAULT"}, {})
BARE: Final[tuple[dict[str, Any], ...]] = ({"pretrained": False}, {"weights": None}, {})
"""Ways to ask an entry point for a network with its weights, or without; the first that it takes is used."""


def load_hub(
    reference: str,
    *,
    name: str | None = None,
    classes: Sequence[str] | None = None,
    weights: Path | None = None,
    image_size: tuple[int, int] | None = None,
    device: str = "cpu",
) -> NetworkClassifier:
    """The network ``owner/repository[:branch]:model`` as a white-box classifier.

    ``weights``: a file with a state dict in place of the repository's own; ``image_size``: (H, W) where it is neither
    the network's own word nor hub's usual 224. Raises ``ClassifierError``.
    """
    repository, _, model = reference.rpartition(":")
    folder = _cached(repository)
    network = _load(folder, model, weights)
    config = {**CONVENTION, **(getattr(network, "pretrained_cfg", None) or getattr(network, "default_cfg", None) or {})}
    size = image_size or tuple(config["input_size"][1:])
    whole = Normalised(network, mean=tuple(config["mean"]), std=tuple(config["std"]))
    fast, n_classes = prepared(whole, size, reference, device=device)
    return NetworkClassifier(name or model, fast, size, n_classes, check_classes(classes, n_classes, reference), device)


def _cached(repository: str) -> Path:
    """The folder in which hub keeps the repository. Raises ``ClassifierError``."""
    owned, _, branch = repository.partition(":")
    if owned.count("/") != 1:
        raise ClassifierError(
            f"{repository!r} is no hub repository; spell the network hub:owner/repository:model, or with a branch or "
            "tag hub:owner/repository:branch:model."
        )
    cache = Path(torch.hub.get_dir())
    names = [f"{owned}_{one}".replace("/", "_") for one in ([branch] if branch else ["main", "master"])]
    for name in names:
        if (cache / name).is_dir():
            return cache / name
    raise ClassifierError(
        f"The hub repository {repository!r} is not in torch's cache ({' or '.join(names)} in {str(cache)!r}), and "
        f"nothing is downloaded. Fetch it with torch.hub.list({repository!r}), or put its files there."
    )


def _load(folder: Path, model: str, weights: Path | None) -> nn.Module:
    """The network in evaluation mode. Raises ``ClassifierError`` when it cannot be had with trained weights."""
    if weights is not None:
        network = _entry(folder, model, BARE)
        try:
            network.load_state_dict(read_weights(weights))
        except RuntimeError as error:
            raise _failed(folder, model, f"{weights.name!r} does not fit: {str(error)[:300]}") from error
        return network
    network = _entry(folder, model, TRAINED)
    if not _same(network, _entry(folder, model, TRAINED)):
        raise ClassifierError(
            f"{model!r} comes with random weights: it is another network each time it is loaded. Give a file with its "
            "state dict as weights."
        )
    return network


def _entry(folder: Path, model: str, ways: Sequence[dict[str, Any]]) -> nn.Module:
    for options in ways:
        try:
            network = torch.hub.load(str(folder), model, source="local", **options)  # type: ignore[no-untyped-call]
        except TypeError:
            continue
        except Exception as error:
            raise _failed(folder, model, f"{type(error).__name__}: {str(error)[:300]}") from error
        if not isinstance(network, nn.Module):
            raise _failed(folder, model, f"it is a {type(network).__name__}, not a network")
        return network.eval()
    raise _failed(folder, model, "its entry point wants arguments that are not known here")


def _failed(folder: Path, model: str, why: str) -> ClassifierError:
    return ClassifierError(
        f"The hub network {model!r} of {folder.name!r} cannot be loaded ({why}). "
        "Check its name and that its weights are in torch's cache, or give a file with its state dict as weights."
    )


def _same(one: nn.Module, other: nn.Module) -> bool:
    """Whether two networks have the same tensors."""
    mine, others = one.state_dict(), other.state_dict()
    return mine.keys() == others.keys() and all(torch.equal(mine[key], others[key]) for key in mine)
