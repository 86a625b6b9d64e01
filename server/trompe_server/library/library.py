"""The library: objects, classifiers and backgrounds that jobs can name, uploaded or shipped."""

import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import BinaryIO, Final

from trompe_server.formats import import_file
from trompe_server.library.catalogue import Catalogue, identity_of
from trompe_server.library.shipped import list_shipped_classifiers, list_shipped_objects
from trompe_server.storage.folders import Folder, LocalArtifacts
from trompe_server.system.files import no_space, write_whole
from trompe_server.system.sandbox import run_limited
from trompe_shared.api import BackgroundInfo, ClassifierInfo, ObjectInfo
from trompe_shared.errors import ClassifierError, ObjectError, SpecError
from trompe_shared.local_files import CLASSIFIER_SUFFIXES, LOOKED_UP
from trompe_shared.object3d import decode_rgb
from trompe_shared.shipped import shipped_objects

_UPLOAD: Final = "upload"
"""File of an object as uploaded, beside ``data.zip``."""
_UNSAFE: Final = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")
"""Characters of a name that a command line or JSON cannot carry."""
_SECONDS: Final = 300.0
_MEMORY: Final = 8 * 2**30
"""Bytes of address space to inspect a classifier; networks for ImageNet take less than half."""

Inspect = Callable[[str], dict[str, object]]
"""Maps a file or a name to the fields of ``ClassifierInfo`` that depend on the network."""


def inspect_classifier(path_or_name: str) -> dict[str, object]:
    """Load a classifier in a child process and describe it. Raises ``ClassifierError``.

    So this process stays free of torch and safe from the file.
    """
    module = "trompe_server.classifiers.inspect"
    return dict(run_limited(module, [path_or_name], memory=_MEMORY, seconds=_SECONDS, failure=ClassifierError))


class Library:
    """Uploads in ``folder``, and shipped things. References are ids, unique beginnings of ids, or names.

    ``objects``, ``classifiers`` and ``backgrounds`` list and find them; ``classifier`` finds networks by name too.

    ``cache``: local folder for files of a remote store that need a path; default: a temporary one.
    ``inspect`` describes a classifier. ``networks``: allowed networks by name, as patterns (``timm:*``).
    """

    def __init__(
        self,
        folder: Folder | Path,
        *,
        cache: Path | None = None,
        inspect: Inspect = inspect_classifier,
        networks: Sequence[str] = (),
    ) -> None:
        folder = LocalArtifacts(folder) if isinstance(folder, Path) else folder
        self.objects = Catalogue("object", folder.within("objects"), ObjectInfo, list_shipped_objects)
        self.classifiers = Catalogue(
            "classifier", folder.within("classifiers"), ClassifierInfo, list_shipped_classifiers
        )
        self.backgrounds = Catalogue("background", folder.within("backgrounds"), BackgroundInfo, list)
        self.calibrations = folder.within("calibrations")
        """Calibrations of the target, shared by jobs."""
        self._cache = cache or Path(tempfile.gettempdir(), f"trompe-cache-{os.getuid()}")
        self._inspect = inspect
        self._networks = networks

    def object_bytes(self, reference: str) -> bytes:
        """SAILenv's zip of an object. Raises ``NotFoundError`` or ``AmbiguousError``."""
        info = self.objects.find(reference)
        return shipped_objects()[info.name].read() if info.shipped else self.objects.read(info)

    def original(self, reference: str) -> tuple[bytes, str] | None:
        """The uploaded file of an object and its name; ``None`` for a shipped object."""
        info = self.objects.find(reference)
        if info.shipped:
            return None
        return self.objects.folder.within(info.id).read(_UPLOAD), info.filename or "object.zip"

    def add_object(
        self, file: BinaryIO, filename: str, *, name: str | None = None, max_texture: int | None = None
    ) -> ObjectInfo:
        """Store an object of any supported format, as uploaded and as SAILenv's zip.

        Textures are shrunk to at most ``max_texture`` texels a side. Raises ``ObjectError`` for an unreadable file and
        stores nothing then.
        """
        filename = _clean(filename)
        with _intake() as folder:
            upload = folder / _UPLOAD
            identity = _copy(file, upload)
            made = import_file(upload, name=filename, max_texture=max_texture)
            info = ObjectInfo(
                id=identity if max_texture is None else identity_of(f"{identity} at most {max_texture}".encode()),
                name=_named(name, filename) or "object",
                filename=filename,
                **made.facts,
            )
            self.objects.folder.within(info.id).write(_UPLOAD, upload)
            return self.objects.put(info, "data.zip", made.archive)

    def classifier(self, reference: str) -> ClassifierInfo:
        """One classifier, or a network by name (``timm:NAME``).

        Raises ``NotFoundError``, ``AmbiguousError``, or ``ClassifierError`` for a network by name that is not
        allowed or cannot be loaded.
        """
        if not reference.startswith(LOOKED_UP):
            return self.classifiers.find(reference)
        if not any(fnmatchcase(reference, pattern) for pattern in self._networks):
            allowed = ", ".join(self._networks) or "none"
            raise ClassifierError(
                f"This service does not allow the network {reference!r}; it allows {allowed}. Its operator names "
                "them in TROMPE_NETWORKS; or upload a .pt2 file."
            )
        return _named_classifier(reference, self._inspect)

    def classifier_path(self, reference: str) -> str:
        """Argument for ``load_classifier``: the path of an upload, or the name of any other classifier."""
        if reference.startswith(LOOKED_UP):
            return reference
        info = self.classifier(reference)
        if info.shipped:
            return info.name
        folder, name = self.classifiers.place(info)
        return str(folder.path(name) if isinstance(folder, LocalArtifacts) else self._local(info.id, folder, name))

    def _local(self, identity: str, folder: Folder, name: str) -> Path:
        """Local copy of a remote file, checked against its id."""
        path = self._cache / identity / name
        if not path.exists():
            with folder.open(name) as source, tempfile.NamedTemporaryFile() as target:
                if _copy(source, Path(target.name)) != identity:
                    raise ClassifierError(f"The stored file {identity[:12]} is damaged. Upload the classifier again.")
                write_whole(path, Path(target.name))
        return path

    def add_classifier(
        self, file: BinaryIO, filename: str, *, classes: Sequence[str] | None = None, name: str | None = None
    ) -> ClassifierInfo:
        """Store a .pt2 or .onnx file.

        ``classes`` default to the names given with an earlier upload of the same file, or to the names in the file.
        Raises ``ClassifierError`` for an invalid file and stores nothing then.
        """
        suffix = Path(filename).suffix.lower()
        if suffix not in CLASSIFIER_SUFFIXES:
            raise ClassifierError(
                f"{filename!r} is not a supported classifier: upload a .pt2 (torch.export) or .onnx file."
            )
        with _intake() as folder:
            payload = folder / f"data{suffix}"
            identity = _copy(file, payload)
            before = self.classifiers.stored(identity)
            names = self.classifiers.folder.within(identity).names() if before is not None else []
            if payload.name not in names and (known := [name for name in names if name.startswith("data")]):
                ending = Path(known[0]).suffix
                raise ClassifierError(
                    f"{filename!r} is stored already, as a {ending} file; let its name end in {ending}."
                )
            try:
                found = self._inspect(str(payload)) if before is None else before.model_dump()
            except ClassifierError as error:
                raise ClassifierError(str(error).replace(repr(payload.name), repr(filename))) from error
            if classes is None:
                classes = found.get("classes")  # type: ignore[assignment]
            elif len(classes) != found["n_classes"]:
                raise ClassifierError(
                    f"{len(classes)} class names for a classifier of {found['n_classes']} classes: send one name per "
                    f"logit, in order. Clients read them from {Path(filename).stem}.classes.json, else "
                    "imagenet_classes.json or classes.json, beside the file."
                )
            info = ClassifierInfo.model_validate(
                found | {"id": identity, "name": _named(name, filename), "classes": classes}
            )
            return self.classifiers.put(info, payload.name, payload)

    def background_bytes(self, reference: str) -> bytes:
        """Image file of a background. Raises ``NotFoundError`` or ``AmbiguousError``."""
        return self.backgrounds.read(self.backgrounds.find(reference))

    def add_background(self, data: bytes, name: str) -> BackgroundInfo:
        """Store an image file. Raises ``SpecError`` for anything else and stores nothing then."""
        try:
            decode_rgb(data, name)
        except ObjectError as error:
            raise SpecError(f"The background {name!r} is not a readable image. Send a PNG or a JPEG.") from error
        return self.backgrounds.put(BackgroundInfo(id=identity_of(data), name=_named(None, name)), "data", data)


@contextmanager
def _intake() -> Iterator[Path]:
    """A temporary folder for an upload until it is checked."""
    with no_space(tempfile.gettempdir()), tempfile.TemporaryDirectory(prefix="trompe-intake-") as folder:
        yield Path(folder)


def _copy(source: BinaryIO, path: Path) -> str:
    """Copy a file to ``path`` and return its id."""
    with path.open("w+b") as target:
        shutil.copyfileobj(source, target)
        target.seek(0)
        return hashlib.file_digest(target, "sha256").hexdigest()


def _clean(name: str) -> str:
    return _UNSAFE.sub("_", name)


def _named(name: str | None, filename: str) -> str:
    """The name to store: the given one, or that of the file without its suffix."""
    return _clean(name or Path(filename).stem)


@cache
def _named_classifier(reference: str, inspect: Inspect) -> ClassifierInfo:
    """A network by name, such as ``timm:NAME``. Raises ``ClassifierError`` if it cannot be loaded."""
    name = reference.partition(":")[2]
    return ClassifierInfo.model_validate(inspect(reference) | {"id": reference, "name": name})
