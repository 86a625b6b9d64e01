"""The files of one job, in a local folder."""

import re
from dataclasses import dataclass
from pathlib import Path

from trompe_server.files import write_whole
from trompe_shared.errors import SpecError

__all__ = ["LocalArtifacts"]

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,199}")


@dataclass(frozen=True)
class LocalArtifacts:
    """Files in ``folder``, which is made with the first of them. A write is whole or not at all."""

    folder: Path

    def path(self, name: str) -> Path:
        """Where the file ``name`` is or would be; raises ``SpecError`` for a name that could leave the folder."""
        if not _NAME.fullmatch(name):
            raise SpecError(
                f"{name!r} cannot be the name of an artifact: use up to 200 letters, digits, '_', '-' and '.', "
                "not beginning with '.' or '-'."
            )
        return self.folder / name

    def read(self, name: str) -> bytes:
        """Bytes of a file; raises ``FileNotFoundError``."""
        return self.path(name).read_bytes()

    def write(self, name: str, data: bytes) -> None:
        """Store a file under ``name``, replacing one of that name at once."""
        write_whole(self.path(name), data)

    def exists(self, name: str) -> bool:
        """Whether there is a file ``name``."""
        return self.path(name).is_file()
