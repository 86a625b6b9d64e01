"""Read and repaint uploads in a separate process with limits on memory and time."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from trompe_server.formats.registry import Exported
from trompe_server.system.sandbox import run_limited
from trompe_shared.errors import ObjectError
from trompe_shared.object3d import Object3D

MEMORY: Final = 4 * 2**30
"""Limit of the address space in bytes; 8192 x 8192 texels take 1.3 GiB."""
SECONDS: Final = 180.0
"""Limit of the time; a million triangles take 20 s and 2.7 GiB."""
_MODULE: Final = "trompe_server.formats.convert"


@dataclass(frozen=True)
class Converted:
    """An upload as SAILenv's zip, its format, and the ``facts_of`` the object."""

    archive: bytes
    facts: Mapping[str, Any]


def import_file(
    data: bytes | Path, *, name: str, max_texture: int | None = None, memory: int = MEMORY, seconds: float = SECONDS
) -> Converted:
    """As ``read_object`` of bytes or of a file, in a separate process.

    Raises ``ObjectError``, also beyond the limits of ``memory`` (bytes) and ``seconds``.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, archive = Path(folder, "upload"), Path(folder, "archive.zip")
        if isinstance(data, Path):
            source = data
        else:
            source.write_bytes(data)
        arguments = ["read", str(source), name, str(max_texture or 0), str(archive)]
        facts = run_limited(_MODULE, arguments, memory=memory, seconds=seconds, failure=ObjectError)
        return Converted(archive.read_bytes(), facts)


def repaint_limited(data: bytes, painted: Object3D, *, name: str) -> Exported:
    """As ``repaint_file``, in a separate process. Raises ``ObjectError``."""
    with tempfile.TemporaryDirectory() as folder:
        source, archive, out = Path(folder, "upload"), Path(folder, "archive.zip"), Path(folder, "out")
        source.write_bytes(data)
        archive.write_bytes(painted.to_zip())
        arguments = ["repaint", str(source), name, str(archive), str(out)]
        answer = run_limited(_MODULE, arguments, memory=MEMORY, seconds=SECONDS, failure=ObjectError)
        return Exported(out.read_bytes(), str(answer["ending"]))
