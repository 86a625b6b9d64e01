"""Catalogue of things of one kind: uploaded ones in a folder, shipped ones in the package."""

import hashlib
import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Generic, TypeVar

from pydantic import ValidationError

from trompe_server.errors import AmbiguousError, NotFoundError
from trompe_server.storage.folders import Folder
from trompe_shared.api import BackgroundInfo, ClassifierInfo, ObjectInfo

logger = logging.getLogger(__name__)

_INFO: Final = "info.json"
_ID: Final = re.compile(r"[0-9a-f]{64}")

Info = TypeVar("Info", ObjectInfo, ClassifierInfo, BackgroundInfo)


def identity_of(data: bytes) -> str:
    """SHA-256 in hex: the id of an upload."""
    return hashlib.sha256(data).hexdigest()


@dataclass(frozen=True)
class Catalogue(Generic[Info]):
    """Things of one ``kind``. The name of a shipped one always means the shipped one.

    Each upload is a folder named by its id, with its bytes and ``info.json``. The info is written last, so a half
    written upload does not exist.
    """

    kind: str
    folder: Folder
    model: type[Info]
    shipped: Callable[[], list[Info]]

    def all(self) -> list[Info]:
        """Shipped things, then uploaded ones."""
        stored = (self.stored(identity) for identity in self.folder.folders())
        return self.shipped() + [info for info in stored if info is not None]

    def find(self, reference: str) -> Info:
        """The thing with this id, name, or beginning of an id (at least 6 characters).

        Raises ``NotFoundError`` or ``AmbiguousError``.
        """
        if _ID.fullmatch(reference) and (stored := self.stored(reference)) is not None:
            return stored
        if shipped := [info for info in self.shipped() if info.name == reference]:
            return shipped[0]
        known = self.all()
        for matches in (
            [info for info in known if info.id == reference],
            [info for info in known if info.name == reference],
            [info for info in known if len(reference) >= 6 and info.id.startswith(reference)],
        ):
            if len(matches) > 1:
                ids = ", ".join(info.id[:12] for info in matches)
                raise AmbiguousError(f"Several {self.kind}s match {reference!r}. Use an id: {ids}.")
            if matches:
                return matches[0]
        names = ", ".join(sorted({info.name for info in known})) or "none"
        raise NotFoundError(
            f"There is no {self.kind} {reference!r}. Available: {names}. Use one of these, or upload yours."
        )

    def place(self, info: Info) -> tuple[Folder, str]:
        """Folder of an upload, and the name of its file there."""
        folder = self.folder.within(info.id)
        return folder, next(name for name in folder.names() if name.startswith("data"))

    def read(self, info: Info) -> bytes:
        """Bytes of an upload."""
        folder, name = self.place(info)
        return folder.read(name)

    def put(self, info: Info, name: str, data: bytes | Path) -> Info:
        """Store bytes or a file as ``name``. If they are stored already, in full, only the info is replaced."""
        folder, size = self.folder.within(info.id), len(data) if isinstance(data, bytes) else data.stat().st_size
        if not (folder.exists(name) and folder.size(name) == size):
            folder.write(name, data)
        folder.write(_INFO, info.model_dump_json().encode())
        return info

    def stored(self, identity: str) -> Info | None:
        """The upload with exactly this id; ``None`` also for a damaged one, which can be sent again."""
        try:
            return self.model.model_validate_json(self.folder.within(identity).read(_INFO))
        except FileNotFoundError:
            return None
        except ValidationError:
            logger.warning("the %s %s is left out: its %s is damaged; send its file again", self.kind, identity, _INFO)
            return None
