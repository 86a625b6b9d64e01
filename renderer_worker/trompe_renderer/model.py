"""Objects as agents upload them, read once: the same archive again costs no more than its hash."""

import hashlib
import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

from trompe_shared.object3d import Object3D, load_object

__all__ = ["Library", "Model", "content_key"]

CAPACITY: Final = 8


@dataclass(frozen=True)
class Model:
    """An object with the hash of the archive it was read from, by which what was made of it can be found again."""

    key: str
    obj: Object3D


def content_key(data: bytes) -> str:
    """A name for ``data`` that no other bytes have."""
    return hashlib.sha256(data).hexdigest()


class Library:
    """The models read last, shared by all agents."""

    def __init__(self) -> None:
        self._models: OrderedDict[str, Model] = OrderedDict()
        self._lock = threading.Lock()

    def read(self, key: str, archive: bytes) -> Model:
        """The model in a zip whose ``content_key`` is ``key``. Raises ``ObjectError``."""
        with self._lock:
            model = self._models.pop(key, None) or Model(key, load_object(archive))
            self._models[key] = model
            if len(self._models) > CAPACITY:
                self._models.popitem(last=False)
        return model
