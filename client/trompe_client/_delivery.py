"""What a job made, as files in the user's folder."""

import os
import shutil
import tempfile
import zipfile
from pathlib import Path, PurePosixPath

from trompe_client._errors import ContractError

__all__ = ["ADVERSARIAL", "in_the_form_of"]

ADVERSARIAL = "adversarial.zip"
"""The artifact that holds the adversarial object."""


def in_the_form_of(source: str, archive: Path) -> Path:
    """Turn the downloaded ``archive`` into what the user gave: a zip stays one, a folder or .obj becomes a folder.

    It is called ``<name>_adversarial`` after ``source`` and lies beside ``archive``, which it takes the place of.
    """
    given = Path(source)
    is_folder, is_mesh = given.is_dir(), given.suffix.lower() == ".obj"
    name = f"{given.resolve().name if is_folder else given.stem if given.is_file() else given.name}_adversarial"
    if not (is_folder or is_mesh):
        return archive.replace(archive.with_name(f"{name}.zip"))
    folder = archive.with_name(name)
    _unpack(archive, folder)
    archive.unlink()
    return folder


def _unpack(archive: Path, folder: Path) -> None:
    """Unpack a flat zip; ``folder`` is replaced when all of it is there."""
    with tempfile.TemporaryDirectory(dir=archive.parent, prefix=".unpacking-") as scratch:
        fresh = Path(scratch, "object")
        fresh.mkdir()
        with zipfile.ZipFile(archive) as members:
            for info in members.infolist():
                if PurePosixPath(info.filename).name != info.filename:
                    raise ContractError(
                        f"{archive.name} should be a flat zip, but holds {info.filename!r}; not unpacked."
                    )
                (fresh / info.filename).write_bytes(members.read(info))
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(fresh, folder)
