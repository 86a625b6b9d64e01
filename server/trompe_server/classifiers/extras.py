"""Libraries of networks that come with an extra, and files of the Hugging Face hub. Pickles are never fetched."""

import importlib
import re
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final

import torch

from trompe_shared.errors import ClassifierError

WEIGHTS: Final = "model.safetensors"
REPOSITORY: Final = re.compile(r"\w[\w.-]*/\w[\w.-]*", re.ASCII)


def import_extra(module: str, *, extra: str) -> Any:
    """The module of a library that ``trompe[extra]`` installs.

    Raises ``ClassifierError`` if it is missing, or if torchvision, on which it may depend, is built for another torch.
    """
    library = module.partition(".")[0]
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ClassifierError(
            f"{library} is not installed or incomplete ({error}). Install the version for torch {torch.__version__} "
            f"(the {extra!r} extra: pip install 'trompe[{extra}]'), or give a .pt2 file."
        ) from error
    except RuntimeError as error:
        raise ClassifierError(
            f"torchvision is installed, but for another build of torch than {torch.__version__} ({error}). "
            "Install both from one index and for the same device, or give a .pt2 file."
        ) from error


def check_known(model: str, known: Sequence[str], refusal: str) -> None:
    """Raise ``ClassifierError`` with names similar to ``model`` unless it is among the ``known`` networks."""
    if model not in known:
        near = ", ".join(get_close_matches(model, known) or known[:5])
        raise ClassifierError(f"{refusal} {model!r}; try one of {near}.")


def hub_file(repository: str, name: str, *, extra: str) -> Path:
    """A file of ``repository`` (ORG/MODEL), from the user's cache or the hub. ``HF_HUB_OFFLINE=1`` forbids downloads.

    Raises ``ClassifierError`` if the repository has no such file, or cannot be reached.
    """
    if not REPOSITORY.fullmatch(repository):
        raise ClassifierError(f"{repository!r} is not a repository of the Hugging Face hub; expected ORG/MODEL.")
    hub = import_extra("huggingface_hub", extra=extra)
    try:
        return Path(hub.hf_hub_download(repository, name))
    except (OSError, ValueError) as error:  # a ValueError for names that the hub forbids
        raise ClassifierError(
            f"{name!r} of {repository!r} is neither in the cache of the Hugging Face hub nor can be downloaded "
            f"({str(error).strip().splitlines()[0][:200]}). Check the name and the network; only safetensors are read."
        ) from error
