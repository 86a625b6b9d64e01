"""Folders of files, local or on any file system of fsspec. Writes are atomic."""

import os
import re
import shutil
import urllib.parse
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

from trompe_server.errors import MissingFileError, ServiceError
from trompe_server.system.files import no_space, write_whole
from trompe_shared.addresses import without_password
from trompe_shared.errors import SpecError, TrompeError

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,199}")
_JOBS: Final = "jobs"


def open_folder(url: str | Path) -> "Folder":
    """The folder at a path or URL (``s3://bucket/prefix``). Raises ``ServiceError`` for an unsupported URL."""
    text = str(url)
    scheme, _, rest = text.partition("://")
    if not rest:
        if re.match(r"[a-z0-9]{2,}:/", text):
            raise ServiceError(f"The store {text!r} is no URL: write {text.replace(':/', '://', 1)!r}.")
        return LocalArtifacts(Path(text))
    if scheme in {"file", "local"}:
        return LocalArtifacts(Path(urllib.parse.unquote(rest)))
    import fsspec  # type: ignore[import-untyped]

    try:
        system, root = fsspec.core.url_to_fs(text, use_listings_cache=False)
    except (ImportError, ValueError) as error:
        raise ServiceError(
            f"The store {without_password(text)!r} cannot be opened ({error}). Give a folder or a URL supported "
            "by fsspec; s3:// needs: pip install 'trompe[s3]'."
        ) from error
    return RemoteArtifacts(system, root.rstrip("/"))


def job_artifacts(store: "Folder", job: str, *, attempt: int | None = None) -> "JobArtifacts":
    """The files of one job in the store, read-only without ``attempt``."""
    return JobArtifacts(store.within(_JOBS).within(job), attempt)


def checked(name: str) -> str:
    """Return ``name``. Raises ``SpecError`` if it could leave the folder."""
    if not _NAME.fullmatch(name):
        raise SpecError(
            f"{name!r} is not a valid file name: use up to 200 letters, digits, '_', '-' and '.', "
            "not beginning with '.' or '-'."
        )
    return name


@dataclass(frozen=True)
class LocalArtifacts:
    """Files by name, and subfolders: a folder on this machine, created with its first file."""

    folder: Path

    def path(self, name: str) -> Path:
        """Path of the file ``name``. Raises ``SpecError`` for a name that could leave the folder."""
        return self.folder / checked(name)

    def read(self, name: str) -> bytes:
        """Bytes of a file. Raises ``FileNotFoundError``."""
        return self.path(name).read_bytes()

    def write(self, name: str, data: bytes | Path) -> None:
        """Store bytes, or a copy of a local file, atomically in place of a file of the same name.

        Raises ``ServiceError`` without space.
        """
        write_whole(self.path(name), data)

    def open(self, name: str) -> BinaryIO:
        """Open a file for reading; it is seekable. Raises ``FileNotFoundError``."""
        return self.path(name).open("rb")

    def exists(self, name: str) -> bool:
        """Whether the file exists."""
        return self.path(name).is_file()

    def size(self, name: str) -> int:
        """Bytes of a file. Raises ``FileNotFoundError``."""
        return self.path(name).stat().st_size

    def touched(self, name: str) -> float:
        """Time of the last write or touch, seconds since 1970. Raises ``FileNotFoundError``."""
        return self.path(name).stat().st_mtime

    def touch(self, name: str) -> None:
        """Mark a file as used now."""
        os.utime(self.path(name))

    def names(self) -> list[str]:
        """Names of the files, sorted."""
        return sorted(each.name for each in self._entries() if each.is_file())

    def folders(self) -> list[str]:
        """Names of the subfolders, sorted."""
        return sorted(each.name for each in self._entries() if each.is_dir())

    def within(self, name: str) -> "LocalArtifacts":
        """The subfolder ``name``, created with its first file."""
        return LocalArtifacts(self.path(name))

    def delete(self, name: str) -> None:
        """Delete a file if it exists."""
        self.path(name).unlink(missing_ok=True)

    def delete_all(self) -> None:
        """Delete the folder with its content. Raises ``ServiceError`` if that fails."""
        try:
            shutil.rmtree(self.folder)
        except FileNotFoundError:
            pass
        except OSError as error:
            raise ServiceError(f"The folder {self.folder} cannot be deleted ({error}).") from error

    def _entries(self) -> list[Path]:
        """Content of the folder without temporary files, whose names begin with a dot."""
        try:
            return [each for each in self.folder.iterdir() if _NAME.fullmatch(each.name)]
        except FileNotFoundError:
            return []


@dataclass(frozen=True)
class RemoteArtifacts:
    """The same at ``root`` of an fsspec file system. Object stores write atomically."""

    system: Any
    root: str

    def read(self, name: str) -> bytes:
        return bytes(self._call("cat_file", self._path(name)))

    def write(self, name: str, data: bytes | Path) -> None:
        self._call("makedirs", self.root, exist_ok=True)
        if isinstance(data, bytes):
            self._call("pipe_file", self._path(name), data)
        else:
            self._call("put_file", str(data), self._path(name))

    def open(self, name: str) -> BinaryIO:
        return cast(BinaryIO, self._call("open", self._path(name), "rb"))

    def exists(self, name: str) -> bool:
        return bool(self._call("isfile", self._path(name)))

    def size(self, name: str) -> int:
        return int(self._call("size", self._path(name)))

    def touched(self, name: str) -> float:
        return float(self._call("modified", self._path(name)).timestamp())

    def touch(self, name: str) -> None:
        # object stores have no other way to change the time of a file
        self.write(name, self.read(name))

    def names(self) -> list[str]:
        return self._listing("file")

    def folders(self) -> list[str]:
        return self._listing("directory")

    def within(self, name: str) -> "RemoteArtifacts":
        return RemoteArtifacts(self.system, self._path(name))

    def delete(self, name: str) -> None:
        if self._call("exists", self._path(name)):
            self._call("rm_file", self._path(name))

    def delete_all(self) -> None:
        if self._call("exists", self.root):
            self._call("rm", self.root, recursive=True)

    def _path(self, name: str) -> str:
        return f"{self.root}/{checked(name)}"

    def _listing(self, kind: str) -> list[str]:
        try:
            found = self._call("ls", self.root, detail=True, refresh=True)
        except FileNotFoundError:
            return []
        names = (str(each["name"]).rstrip("/").rpartition("/")[2] for each in found if each["type"] == kind)
        return sorted(name for name in names if _NAME.fullmatch(name))

    def _call(self, operation: str, *arguments: Any, **options: Any) -> Any:
        """Call the file system; translate its errors, except ``FileNotFoundError``, to ``ServiceError``."""
        try:
            with no_space(self.root):
                return getattr(self.system, operation)(*arguments, **options)
        except (FileNotFoundError, TrompeError):
            raise
        except Exception as error:
            raise ServiceError(
                f"The store at {self.root} is not available ({type(error).__name__}: {error}). "
                "Check its URL (--store or TROMPE_STORE), its credentials and the network."
            ) from error


Folder = LocalArtifacts | RemoteArtifacts


@dataclass(frozen=True)
class JobArtifacts:
    """The files of one job in ``folder``. Each attempt writes to its own subfolder; reads prefer the newest attempt.

    So an older attempt, by a worker that was frozen and came back, never replaces files of a newer one. ``attempt`` is
    the number of the writing attempt; without it the files are read-only.
    """

    folder: Folder
    attempt: int | None = None

    def write(self, name: str, data: bytes) -> None:
        """Store a file of this attempt. Raises ``ServiceError`` without an attempt or space."""
        if self.attempt is None:
            raise ServiceError("These artifacts are read-only: name the attempt that writes.")
        self.folder.within(str(self.attempt)).write(name, data)

    def read(self, name: str) -> bytes:
        """Bytes of a file. Raises ``MissingFileError``."""
        return self._where(name).read(name)

    def open(self, name: str) -> BinaryIO:
        """Open a file for reading; it is seekable. Raises ``MissingFileError``."""
        return self._where(name).open(name)

    def size(self, name: str) -> int:
        """Bytes of a file. Raises ``MissingFileError``."""
        return self._where(name).size(name)

    def exists(self, name: str) -> bool:
        """Whether the file exists."""
        return any(each.exists(name) for each in self._attempts())

    def names(self) -> list[str]:
        """Names of all files, sorted."""
        return sorted({name for each in self._attempts() for name in each.names()})

    def delete(self) -> None:
        """Delete all files. Raises ``ServiceError`` if that fails."""
        self.folder.delete_all()

    def keep(self, names: Collection[str]) -> None:
        """Delete all files of the attempts except ``names``."""
        for each in self._attempts()[:-1]:
            for name in set(each.names()) - set(names):
                each.delete(name)

    def _where(self, name: str) -> Folder:
        for each in self._attempts():
            if each.exists(name):
                return each
        raise MissingFileError(f"The file {name!r} is no longer in the store; run the job again to make it.")

    def _attempts(self) -> list[Folder]:
        """Folders of the attempts, newest first, then the job's folder itself."""
        numbers = sorted((int(name) for name in self.folder.folders() if name.isdecimal()), reverse=True)
        return [self.folder.within(str(number)) for number in numbers] + [self.folder]
