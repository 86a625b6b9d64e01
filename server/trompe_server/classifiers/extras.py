"""Libraries of networks that come with an extra."""

import importlib
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any

import torch

from trompe_shared.errors import ClassifierError


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
