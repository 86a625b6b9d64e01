"""Files of the Hugging Face hub, from the user's cache or the hub. Pickles are never fetched."""

import re
from pathlib import Path
from typing import Final

from trompe_server.classifiers.extras import import_extra
from trompe_shared.errors import ClassifierError

WEIGHTS: Final = "model.safetensors"
REPOSITORY: Final = re.compile(r"\w[\w.-]*/\w[\w.-]*", re.ASCII)


def hub_file(repository: str, name: str, *, extra: str) -> Path:
    """A file of ``repository`` (ORG/MODEL). ``HF_HUB_OFFLINE=1`` forbids downloads.

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
