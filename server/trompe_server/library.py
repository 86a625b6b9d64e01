"""What jobs can name: objects, classifiers and backgrounds, uploaded (by the hash of their bytes) or shipped.

Each uploaded thing is a folder ``<kind>/<id>`` with its bytes and an ``info.json``, here or in an object store.
"""

import hashlib
import os
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO, Final, Generic, TypeVar

from trompe_server.artifacts import Folder, LocalArtifacts
from trompe_server.errors import AmbiguousError, NotFoundError
from trompe_server.files import no_space, write_whole
from trompe_server.formats import import_file
from trompe_server.sandbox import run_limited
from trompe_shared.api import BackgroundInfo, ClassifierInfo, ObjectInfo
from trompe_shared.errors import ClassifierError, ObjectError, SpecError
from trompe_shared.object3d import decode_rgb, load_object
from trompe_shared.shipped import ShippedObject, shipped_objects

__all__ = ["Library"]

INSPECTION_TIMEOUT: Final = 300.0
INSPECTION_MEMORY: Final = 8 * 2**30
"""Bytes of address space; networks of ImageNet's take less than half of it."""
CLASSIFIER_ENDINGS: Final = {".pt2", ".pt", ".torchscript", ".onnx"}
NAMED: Final = "torchvision:"
"""Begins the names of classifiers that torchvision brings."""
_INFO: Final = "info.json"
_UPLOAD: Final = "upload"
"""An object as it came; beside it, ``data.zip`` is what it was turned into."""
_ID: Final = re.compile(r"[0-9a-f]{64}")
_PART: Final = 2**20


Info = TypeVar("Info", ObjectInfo, ClassifierInfo, BackgroundInfo)


@dataclass(frozen=True)
class _Shelf(Generic[Info]):
    """Things of one kind. Shipped ones stand first, and their names mean them, whatever was uploaded.

    A thing is there once its info is, which is written last.
    """

    kind: str
    folder: Folder
    model: type[Info]
    shipped: Callable[[], list[Info]]

    def all(self) -> list[Info]:
        stored = (self.stored(identity) for identity in self.folder.folders())
        return self.shipped() + [info for info in stored if info is not None]

    def find(self, reference: str) -> Info:
        """The thing with this id, name, or (from 6 characters) beginning of an id."""
        if _ID.fullmatch(reference) and (stored := self.stored(reference)) is not None:
            return stored
        if shipped := [info for info in self.shipped() if info.name == reference]:
            return shipped[0]
        known = self.all()
        for fits in (
            [info for info in known if info.id == reference],
            [info for info in known if info.name == reference],
            [info for info in known if len(reference) >= 6 and info.id.startswith(reference)],
        ):
            if len(fits) > 1:
                ids = ", ".join(info.id[:12] for info in fits)
                raise AmbiguousError(f"Several {self.kind}s are called {reference!r}; name one by its id: {ids}.")
            if fits:
                return fits[0]
        names = ", ".join(sorted({info.name for info in known})) or "none yet"
        raise NotFoundError(
            f"There is no {self.kind} {reference!r}. There are: {names}. Upload it, or name one of these."
        )

    def place(self, info: Info) -> tuple[Folder, str]:
        """The folder of an uploaded thing, and the name of its bytes there."""
        folder = self.folder.within(info.id)
        return folder, next(name for name in folder.names() if name.startswith("data"))

    def payload(self, info: Info) -> bytes:
        folder, name = self.place(info)
        return folder.read(name)

    def put(self, info: Info, payload: Path) -> Info:
        """Store the file ``payload``, or only renew the info where the same bytes are stored already."""
        folder = self.folder.within(info.id)
        if not folder.exists(_INFO):
            folder.write_file(payload.name, payload)
        folder.write(_INFO, info.model_dump_json().encode())
        return info

    def stored(self, identity: str) -> Info | None:
        """The uploaded thing with exactly this id."""
        try:
            return self.model.model_validate_json(self.folder.within(identity).read(_INFO))
        except FileNotFoundError:
            return None


class Library:
    """What is stored in ``folder``, and what is shipped. References are ids, unique beginnings of ids, or names.

    ``cache`` is a local folder for files that must have a path; without it there is a temporary one.
    """

    def __init__(self, folder: Folder | Path, *, cache: Path | None = None) -> None:
        folder = LocalArtifacts(folder) if isinstance(folder, Path) else folder
        self._objects = _Shelf("object", folder.within("objects"), ObjectInfo, _shipped_objects)
        self._classifiers = _Shelf("classifier", folder.within("classifiers"), ClassifierInfo, _shipped_classifiers)
        self._backgrounds = _Shelf("background", folder.within("backgrounds"), BackgroundInfo, list)
        self.calibrations = folder.within("calibrations")
        """What jobs found out about the target, for later jobs."""
        self._cache = cache or Path(tempfile.gettempdir(), f"trompe-cache-{os.getuid()}")

    def objects(self) -> list[ObjectInfo]:
        """All objects."""
        return self._objects.all()

    def object(self, reference: str) -> ObjectInfo:
        """One object. Raises ``NotFoundError`` or ``AmbiguousError``."""
        return self._objects.find(reference)

    def object_bytes(self, reference: str) -> bytes:
        """The archive of an object. Raises ``NotFoundError`` or ``AmbiguousError``."""
        info = self.object(reference)
        return shipped_objects()[info.name].read() if info.shipped else self._objects.payload(info)

    def original(self, reference: str) -> tuple[bytes, str] | None:
        """The file that an object was uploaded as, and its name; ``None`` for a shipped one."""
        info = self.object(reference)
        if info.shipped:
            return None
        return self._objects.folder.within(info.id).read(_UPLOAD), info.filename or "object.zip"

    def add_object(
        self, file: BinaryIO, filename: str, *, name: str | None = None, max_texture: int | None = None
    ) -> ObjectInfo:
        """Store an object in any of the formats that are read, as it came and as SAILenv's zip.

        ``max_texture`` is the longest side of a texture, in texels; larger ones are made smaller.
        Raises ``ObjectError`` for a file that cannot be read; nothing is kept then.
        """
        with _intake() as intake:
            upload = intake / _UPLOAD
            identity = _copy(file, upload)
            made = import_file(upload, name=filename, max_texture=max_texture)
            info = ObjectInfo(
                id=identity if max_texture is None else _identity(f"{identity} at most {max_texture}".encode()),
                name=Path(name or filename).stem or "object",
                materials=made.materials,
                textures=dict(made.textures),
                triangles=made.triangles,
                radius=made.radius,
                format=made.format,
                filename=filename,
            )
            payload = intake / "data.zip"
            write_whole(payload, made.archive)
            self._objects.folder.within(info.id).write_file(_UPLOAD, upload)
            return self._objects.put(info, payload)

    def classifiers(self) -> list[ClassifierInfo]:
        """All classifiers."""
        return self._classifiers.all()

    def classifier(self, reference: str) -> ClassifierInfo:
        """One classifier, or one of torchvision's (``torchvision:NAME``, its weights from the local cache).

        Raises ``NotFoundError``, ``AmbiguousError``, or ``ClassifierError`` for what torchvision does not give.
        """
        return _named(reference) if reference.startswith(NAMED) else self._classifiers.find(reference)

    def classifier_path(self, reference: str) -> str:
        """What ``load_classifier`` takes: the path of an uploaded file, the name of any other classifier."""
        if reference.startswith(NAMED):
            return reference
        info = self.classifier(reference)
        if info.shipped:
            return info.name
        folder, name = self._classifiers.place(info)
        return str(folder.path(name) if isinstance(folder, LocalArtifacts) else self._local(info.id, folder, name))

    def _local(self, identity: str, folder: Folder, name: str) -> Path:
        """A copy on this machine of a stored file whose bytes have the hash ``identity``."""
        path = self._cache / identity / name
        if not path.exists():
            with folder.open(name) as source, tempfile.NamedTemporaryFile() as copy:
                if _copy(source, Path(copy.name)) != identity:
                    raise ClassifierError(f"The stored file {identity[:12]} is damaged: upload the classifier again.")
                write_whole(path, Path(copy.name))
        return path

    def add_classifier(
        self, file: BinaryIO, filename: str, *, classes: Sequence[str] | None = None, name: str | None = None
    ) -> ClassifierInfo:
        """Store a .pt2, TorchScript or .onnx file.

        Without ``classes`` it keeps those that the same file came with before, or those that it names itself.
        Raises ``ClassifierError`` for a bad one; nothing is kept then.
        """
        suffix = Path(filename).suffix.lower()
        if suffix not in CLASSIFIER_ENDINGS:
            raise ClassifierError(
                f"{filename!r} is neither a .pt2 (torch.export), a TorchScript (.pt, .torchscript) nor an .onnx file."
            )
        with _intake() as intake:
            payload = intake / f"data{suffix}"
            identity = _copy(file, payload)
            before = self._classifiers.stored(identity)
            found = _inspect(str(payload)) if before is None else before.model_dump()
            _check_classes(classes, found)
            if classes is None:
                classes = found.get("classes")  # type: ignore[assignment]
            info = ClassifierInfo.model_validate(
                found | {"id": identity, "name": name or Path(filename).stem, "classes": classes}
            )
            return self._classifiers.put(info, payload)

    def backgrounds(self) -> list[BackgroundInfo]:
        """All uploaded backgrounds."""
        return self._backgrounds.all()

    def background(self, reference: str) -> BackgroundInfo:
        """One background. Raises ``NotFoundError`` or ``AmbiguousError``."""
        return self._backgrounds.find(reference)

    def background_bytes(self, reference: str) -> bytes:
        """The image file of a background. Raises ``NotFoundError`` or ``AmbiguousError``."""
        return self._backgrounds.payload(self.background(reference))

    def add_background(self, data: bytes, name: str) -> BackgroundInfo:
        """Store an image file. Raises ``SpecError`` for one that is none; nothing is kept then."""
        try:
            decode_rgb(data, name)
        except ObjectError as error:
            raise SpecError(f"The background {name!r} cannot be read as an image; send a PNG or a JPEG.") from error
        with _intake() as intake:
            payload = intake / f"data{Path(name).suffix.lower()}"
            write_whole(payload, data)
            return self._backgrounds.put(BackgroundInfo(id=_identity(data), name=Path(name).stem), payload)


@contextmanager
def _intake() -> Iterator[Path]:
    """A folder for what comes in, until it is known to be good."""
    with no_space(tempfile.gettempdir()), tempfile.TemporaryDirectory(prefix="trompe-intake-") as folder:
        yield Path(folder)


def _identity(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _copy(source: BinaryIO, path: Path) -> str:
    """Copy a file to ``path``; the hash of its bytes."""
    digest = hashlib.sha256()
    with path.open("wb") as target:
        while part := source.read(_PART):
            digest.update(part)
            target.write(part)
        target.flush()
        os.fsync(target.fileno())
    return digest.hexdigest()


def _describe_shipped(shipped: ShippedObject) -> ObjectInfo:
    data = shipped.read()
    obj = load_object(data)
    return ObjectInfo(
        id=_identity(data),
        name=shipped.name,
        materials=sorted(obj.materials),
        textures={file: (image.shape[0], image.shape[1]) for file, image in obj.textures.items()},
        triangles=sum(len(part.faces) for part in obj.parts),
        radius=obj.radius,
        shipped=True,
    )


def _inspect(path_or_name: str) -> dict[str, object]:
    """What a classifier is, read in a process of its own: this one stays free of torch and of what a file may do."""
    return dict(
        run_limited(
            "trompe_server.classifiers.inspect",
            [path_or_name],
            memory=INSPECTION_MEMORY,
            seconds=INSPECTION_TIMEOUT,
            failure=ClassifierError,
        )
    )


@cache
def _named(reference: str) -> ClassifierInfo:
    """One of torchvision's classifiers."""
    name = reference.removeprefix(NAMED)
    return ClassifierInfo.model_validate(_inspect(reference) | {"id": reference, "name": name})


def _check_classes(classes: Sequence[str] | None, found: dict[str, object]) -> None:
    if classes is not None and len(classes) != found["n_classes"]:
        raise ClassifierError(
            f"{len(classes)} class names came with a classifier of {found['n_classes']} classes; "
            "send one name for each logit, in order."
        )


@cache
def _shipped_objects() -> list[ObjectInfo]:
    return [_describe_shipped(shipped) for shipped in shipped_objects().values()]


@cache
def _shipped_classifiers() -> list[ClassifierInfo]:
    """The one that is shipped; written down here because asking it takes a process that imports torch."""
    classes = sorted({shipped.label for shipped in shipped_objects().values()})
    size = (128, 128)
    return [
        ClassifierInfo(
            id="tiny",
            name="tiny",
            white_box=True,
            image_size=size,
            n_classes=len(classes),
            classes=classes,
            shipped=True,
        )
    ]
