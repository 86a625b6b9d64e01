"""Results in the form of the user's object."""

import os
import shutil
import tempfile
import zipfile
from pathlib import Path, PurePosixPath

from trompe_client._errors import ContractError
from trompe_shared.api import ADVERSARIAL
from trompe_shared.local_files import SPLIT_SUFFIXES


def in_the_form_of(source: str, file: Path) -> Path:
    """Unpack the zip with the repainted object if ``source`` is a folder or a model with files beside it.

    Returns the folder; any other file stays as it is.
    """
    given = Path(source)
    if not (file.name.endswith(f"{ADVERSARIAL}.zip") and (given.is_dir() or given.suffix.lower() in SPLIT_SUFFIXES)):
        return file
    folder = file.with_suffix("")
    _unpack(file, folder)
    file.unlink()
    return folder


def _unpack(archive: Path, folder: Path) -> None:
    """Unpack a flat zip, and replace ``folder`` by it once it is complete."""
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
