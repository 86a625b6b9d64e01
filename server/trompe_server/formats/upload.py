"""An uploaded model: its files, the mesh file among them, and failures of a library on it."""

import posixpath
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Final
from urllib.parse import unquote

from trompe_shared.errors import ObjectError
from trompe_shared.local_files import PICTURE_SUFFIXES, base_name, named, pack_zip, spelling

_FLAT: Final = (".obj", ".mtl", ".json", *PICTURE_SUFFIXES)
"""Endings of files that are read by their name without folders."""


@dataclass(frozen=True)
class Upload:
    """files: by path. main: path of the mesh file. packed: whether the files came as a zip and leave as one."""

    main: str
    files: Mapping[str, bytes]
    packed: bool

    @property
    def data(self) -> bytes:
        """The bytes of the mesh file."""
        return self.files[self.main]

    @property
    def stem(self) -> str:
        """The mesh file's name without folder and ending."""
        return base_name(self.main).rsplit(".", 1)[0] or "object"

    def beside(self, uri: str) -> str:
        """The path of a URI in the mesh file, in other capitals or folders if only such a file is there.

        Programs write paths of the machine they ran on. Raises ``ObjectError`` for a file that the upload lacks.
        """
        path = posixpath.normpath(posixpath.join(posixpath.dirname(self.main), unquote(uri).replace("\\", "/")))
        found = named(path, self.files) or self._elsewhere(base_name(path))
        if found is not None:
            return found
        if ":" in uri or path.startswith(("/", "..")):
            raise ObjectError(
                f"{self.main!r} names {uri[:80]!r}; only files below its own folder are read. Put the file there."
            )
        raise ObjectError(f"{self.main!r} names {uri[:80]!r}, which is missing; zip the model together with its files.")

    def _elsewhere(self, name: str) -> str | None:
        """The only file of a name in any folder."""
        alike = [path for path in self.files if spelling(base_name(path)) == spelling(name) and not is_litter(path)]
        return alike[0] if len(alike) == 1 else None

    def flat(self) -> dict[str, bytes]:
        """The files by name without folders, but litter and equal names of different files that are not read.

        Raises ``ObjectError`` if the names of two others are equal.
        """
        first: dict[str, str] = {}
        differ = set[str]()
        for path in (path for path in self.files if not is_litter(path)):
            other = first.setdefault(base_name(path), path)
            if self.files[other] == self.files[path]:
                continue
            if path.lower().endswith(_FLAT):
                raise ObjectError(f"{other!r} and {path!r} have the same name; rename one of them.")
            differ.add(base_name(path))
        return {name: self.files[path] for name, path in first.items() if name not in differ}

    def with_flat(self, files: Mapping[str, bytes]) -> "Upload":
        """The upload with files replaced, by name without folders; new ones go beside the mesh."""
        kept = {path: files.get(base_name(path), data) for path, data in self.files.items()}
        new = files.keys() - set(map(base_name, self.files))
        folder = posixpath.dirname(self.main)
        return replace(self, files=kept | {posixpath.join(folder, name): files[name] for name in sorted(new)})

    def to_bytes(self) -> bytes:
        """The bytes to send back: the mesh file if it came and stays alone, otherwise a zip."""
        return self.data if not self.packed and len(self.files) == 1 else pack_zip(self.files)


def is_litter(path: str) -> bool:
    """Whether a file is hidden or left by Windows."""
    return base_name(path).startswith(".") or base_name(path).lower() in {"thumbs.db", "desktop.ini"}


@contextmanager
def refusing(what: str, *, remedy: str) -> Iterator[None]:
    """Translate exceptions, and NumPy's warning about malformed numbers, to ``ObjectError``; not ``MemoryError``."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "string or file could not be read to its end", DeprecationWarning)
            yield
    except (MemoryError, ObjectError):
        raise
    except Exception as error:
        raise ObjectError(f"{what} cannot be read ({type(error).__name__}: {str(error)[:200]}). {remedy}") from error
