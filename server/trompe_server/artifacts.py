"""Folders of files, local or anywhere that fsspec reaches, by the same few verbs. A write is whole or not at all."""

import os
import re
import shutil
import urllib.parse
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, Protocol, cast

from trompe_server.errors import ServiceError
from trompe_server.files import no_space, write_whole
from trompe_shared.errors import SpecError, TrompeError

__all__ = ["Folder", "JobArtifacts", "LocalArtifacts", "RemoteArtifacts", "job_artifacts", "open_folder"]

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,199}")
_JOBS: Final = "jobs"


class Folder(Protocol):
    """Files by name, and folders within."""

    def read(self, name: str) -> bytes:
        """Bytes of a file; raises ``FileNotFoundError``."""
        ...

    def write(self, name: str, data: bytes) -> None:
        """Store a file under ``name``, replacing one of that name at once. ``ServiceError`` where space runs out."""
        ...

    def write_file(self, name: str, file: Path) -> None:
        """Store the bytes of a local file, however many."""
        ...

    def open(self, name: str) -> BinaryIO:
        """A file to be read from any place in it; raises ``FileNotFoundError``."""
        ...

    def exists(self, name: str) -> bool:
        """Whether there is a file ``name``."""
        ...

    def size(self, name: str) -> int:
        """Bytes of a file; raises ``FileNotFoundError``."""
        ...

    def touched(self, name: str) -> float:
        """When a file was written or touched last, seconds since 1970; raises ``FileNotFoundError``."""
        ...

    def touch(self, name: str) -> None:
        """Note that a file was of use."""
        ...

    def names(self) -> list[str]:
        """Names of the files, sorted."""
        ...

    def folders(self) -> list[str]:
        """Names of the folders within, sorted."""
        ...

    def within(self, name: str) -> "Folder":
        """The folder ``name`` within, which is made with its first file."""
        ...

    def delete(self, name: str) -> None:
        """Remove a file, if there is one."""
        ...

    def delete_all(self) -> None:
        """Remove the folder with all that is in it."""
        ...


def open_folder(url: str | Path) -> Folder:
    """The folder at a path or URL (``s3://bucket/prefix``). Raises ``ServiceError`` for a URL nobody knows."""
    text = str(url)
    scheme, _, rest = text.partition("://")
    if not rest:
        return LocalArtifacts(Path(text))
    if scheme in {"file", "local"}:
        return LocalArtifacts(Path(urllib.parse.unquote(rest)))
    import fsspec  # type: ignore[import-untyped]

    try:
        system, root = fsspec.core.url_to_fs(text, use_listings_cache=False)
    except (ImportError, ValueError) as error:
        raise ServiceError(
            f"The store {text!r} cannot be opened ({error}). Give a folder or a URL that fsspec knows; "
            "s3:// needs: pip install 'trompe[s3]'."
        ) from error
    return RemoteArtifacts(system, root.rstrip("/"))


def job_artifacts(store: Folder, job: str, *, attempt: int | None = None) -> "JobArtifacts":
    """The files of one job in the store; for ``attempt`` to write, or else only to be read."""
    return JobArtifacts(store.within(_JOBS).within(job), attempt)


def checked(name: str) -> str:
    """``name``; raises ``SpecError`` for one that could leave the folder."""
    if not _NAME.fullmatch(name):
        raise SpecError(
            f"{name!r} cannot be the name of an artifact: use up to 200 letters, digits, '_', '-' and '.', "
            "not beginning with '.' or '-'."
        )
    return name


@dataclass(frozen=True)
class LocalArtifacts:
    """A ``Folder`` on this machine. It is made with the first file."""

    folder: Path

    def path(self, name: str) -> Path:
        """Where the file ``name`` is or would be; raises ``SpecError`` for a name that could leave the folder."""
        return self.folder / checked(name)

    def read(self, name: str) -> bytes:
        """See ``Folder``."""
        return self.path(name).read_bytes()

    def write(self, name: str, data: bytes) -> None:
        """See ``Folder``."""
        write_whole(self.path(name), data)

    def write_file(self, name: str, file: Path) -> None:
        """See ``Folder``."""
        write_whole(self.path(name), file)

    def open(self, name: str) -> BinaryIO:
        """See ``Folder``."""
        return self.path(name).open("rb")

    def exists(self, name: str) -> bool:
        """See ``Folder``."""
        return self.path(name).is_file()

    def size(self, name: str) -> int:
        """See ``Folder``."""
        return self.path(name).stat().st_size

    def touched(self, name: str) -> float:
        """See ``Folder``."""
        return self.path(name).stat().st_mtime

    def touch(self, name: str) -> None:
        """See ``Folder``."""
        os.utime(self.path(name))

    def names(self) -> list[str]:
        """See ``Folder``."""
        return sorted(each.name for each in self._entries() if each.is_file())

    def folders(self) -> list[str]:
        """See ``Folder``."""
        return sorted(each.name for each in self._entries() if each.is_dir())

    def within(self, name: str) -> "LocalArtifacts":
        """See ``Folder``."""
        return LocalArtifacts(self.path(name))

    def delete(self, name: str) -> None:
        """See ``Folder``."""
        self.path(name).unlink(missing_ok=True)

    def delete_all(self) -> None:
        """See ``Folder``."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _entries(self) -> list[Path]:
        """What is in the folder; names of ours never begin with a dot."""
        try:
            return [each for each in self.folder.iterdir() if _NAME.fullmatch(each.name)]
        except FileNotFoundError:
            return []


@dataclass(frozen=True)
class RemoteArtifacts:
    """A ``Folder`` in a file system of fsspec's, at the path ``root`` there. Object stores write whole objects."""

    system: Any
    root: str

    def read(self, name: str) -> bytes:
        """See ``Folder``."""
        with self._words():
            return bytes(self.system.cat_file(self._path(name)))

    def write(self, name: str, data: bytes) -> None:
        """See ``Folder``."""
        with self._words():
            self.system.makedirs(self.root, exist_ok=True)
            self.system.pipe_file(self._path(name), data)

    def write_file(self, name: str, file: Path) -> None:
        """See ``Folder``."""
        with self._words():
            self.system.makedirs(self.root, exist_ok=True)
            self.system.put_file(str(file), self._path(name))

    def open(self, name: str) -> BinaryIO:
        """See ``Folder``."""
        with self._words():
            return cast(BinaryIO, self.system.open(self._path(name), "rb"))

    def exists(self, name: str) -> bool:
        """See ``Folder``."""
        with self._words():
            return bool(self.system.isfile(self._path(name)))

    def size(self, name: str) -> int:
        """See ``Folder``."""
        with self._words():
            return int(self.system.size(self._path(name)))

    def touched(self, name: str) -> float:
        """See ``Folder``."""
        with self._words():
            return float(self.system.modified(self._path(name)).timestamp())

    def touch(self, name: str) -> None:
        """See ``Folder``. Object stores know no other way than to write the file again."""
        self.write(name, self.read(name))

    def names(self) -> list[str]:
        """See ``Folder``."""
        return self._listing("file")

    def folders(self) -> list[str]:
        """See ``Folder``."""
        return self._listing("directory")

    def within(self, name: str) -> "RemoteArtifacts":
        """See ``Folder``."""
        return RemoteArtifacts(self.system, self._path(name))

    def delete(self, name: str) -> None:
        """See ``Folder``."""
        with self._words():
            if self.system.exists(self._path(name)):
                self.system.rm_file(self._path(name))

    def delete_all(self) -> None:
        """See ``Folder``."""
        with self._words():
            if self.system.exists(self.root):
                self.system.rm(self.root, recursive=True)

    def _path(self, name: str) -> str:
        return f"{self.root}/{checked(name)}"

    def _listing(self, kind: str) -> list[str]:
        with self._words():
            try:
                found = self.system.ls(self.root, detail=True, refresh=True)
            except FileNotFoundError:
                return []
        names = (str(each["name"]).rstrip("/").rpartition("/")[2] for each in found if each["type"] == kind)
        return sorted(name for name in names if _NAME.fullmatch(name))

    @contextmanager
    def _words(self) -> Iterator[None]:
        """``FileNotFoundError`` as it is, no space in words, and anything else as a store that cannot be reached."""
        try:
            with no_space(self.root):
                yield
        except (FileNotFoundError, TrompeError):
            raise
        except Exception as error:
            raise ServiceError(
                f"The store at {self.root} cannot be used just now ({type(error).__name__}: {error}). "
                "Check its URL (--store or TROMPE_STORE), its credentials and that it can be reached."
            ) from error


@dataclass(frozen=True)
class JobArtifacts:
    """The files of one job in ``folder``. Each attempt writes to a folder of its own, and the newest is read first.

    So what an older attempt writes, by a worker that was frozen and came back, never replaces what a newer one wrote.
    ``attempt`` is the one that writes; without it the files can only be read.
    """

    folder: Folder
    attempt: int | None = None

    def write(self, name: str, data: bytes) -> None:
        """Store a file of this attempt; see ``Folder.write``."""
        if self.attempt is None:
            raise ServiceError("These artifacts were opened to be read; name the attempt that writes.")
        self.folder.within(str(self.attempt)).write(name, data)

    def read(self, name: str) -> bytes:
        """Bytes of a file; raises ``FileNotFoundError``."""
        return self._where(name).read(name)

    def open(self, name: str) -> BinaryIO:
        """A file to be read from any place in it; raises ``FileNotFoundError``."""
        return self._where(name).open(name)

    def size(self, name: str) -> int:
        """Bytes of a file; raises ``FileNotFoundError``."""
        return self._where(name).size(name)

    def exists(self, name: str) -> bool:
        """Whether there is a file ``name``."""
        return any(each.exists(name) for each in self._attempts())

    def names(self) -> list[str]:
        """Names of all files, sorted."""
        return sorted({name for each in self._attempts() for name in each.names()})

    def delete(self) -> None:
        """Remove them all."""
        self.folder.delete_all()

    def keep(self, names: Collection[str]) -> None:
        """Remove what the attempts wrote for themselves alone: all but ``names``."""
        for each in self._attempts()[:-1]:
            for name in set(each.names()) - set(names):
                each.delete(name)

    def _where(self, name: str) -> Folder:
        for each in self._attempts():
            if each.exists(name):
                return each
        raise FileNotFoundError(f"There is no artifact {name!r}.")

    def _attempts(self) -> list[Folder]:
        """The newest first; what lies in the job's folder itself comes last."""
        numbers = sorted((int(name) for name in self.folder.folders() if name.isdecimal()), reverse=True)
        return [self.folder.within(str(number)) for number in numbers] + [self.folder]
