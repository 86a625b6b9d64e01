"""What jobs can name: objects, classifiers and backgrounds, uploaded (by the hash of their bytes) or shipped.

Each uploaded thing is a folder ``<kind>/<id>`` with its bytes and an ``info.json``; one rename puts it in place.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO, Final, Generic, TypeVar

from trompe_server.artifacts import LocalArtifacts
from trompe_server.errors import AmbiguousError, NotFoundError
from trompe_server.files import write_whole
from trompe_shared.api import BackgroundInfo, ClassifierInfo, ObjectInfo
from trompe_shared.errors import ClassifierError, ObjectError, SpecError
from trompe_shared.object3d import decode_rgb, load_object
from trompe_shared.shipped import shipped_objects

__all__ = ["Library"]

INSPECTION_TIMEOUT: Final = 300.0
CLASSIFIER_ENDINGS: Final = {".pt2", ".pt", ".torchscript", ".onnx"}
NAMED: Final = "torchvision:"
"""Begins the names of classifiers that torchvision brings."""
_INFO: Final = "info.json"
_PART: Final = 2**20


Info = TypeVar("Info", ObjectInfo, ClassifierInfo, BackgroundInfo)


@dataclass(frozen=True)
class _Shelf(Generic[Info]):
    """Things of one kind. Shipped ones stand first, and their names mean them, whatever was uploaded."""

    kind: str
    folder: Path
    model: type[Info]
    shipped: Callable[[], list[Info]]

    def all(self) -> list[Info]:
        stored = sorted(self.folder.glob(f"[!.]*/{_INFO}"))
        return self.shipped() + [self.model.model_validate_json(file.read_bytes()) for file in stored]

    def find(self, reference: str) -> Info:
        """The thing with this id, name, or (from 6 characters) beginning of an id."""
        known = self.all()
        for fits in (
            [info for info in known if info.id == reference],
            [info for info in self.shipped() if info.name == reference],
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

    def payload(self, info: Info) -> Path:
        return next(file for file in (self.folder / info.id).iterdir() if file.name.startswith("data"))

    def put(self, info: Info, payload: Path) -> Info:
        """Take the file ``payload`` (it is moved), or only renew the info where the same bytes are stored already."""
        text = info.model_dump_json().encode()
        place = self.folder / info.id
        write_whole(payload.parent / _INFO, text)
        try:
            payload.parent.rename(place)
        except OSError:
            if not place.is_dir():
                raise
            write_whole(place / _INFO, text)
        return info

    def stored(self, identity: str) -> Info | None:
        """The uploaded thing with exactly this id."""
        file = self.folder / identity / _INFO
        return self.model.model_validate_json(file.read_bytes()) if file.exists() else None


class Library:
    """What is stored below ``folder``, and what is shipped. References are ids, unique beginnings of ids, or names."""

    def __init__(self, folder: Path) -> None:
        self._objects = _Shelf("object", folder / "objects", ObjectInfo, _shipped_objects)
        self._classifiers = _Shelf("classifier", folder / "classifiers", ClassifierInfo, _shipped_classifiers)
        self._backgrounds = _Shelf("background", folder / "backgrounds", BackgroundInfo, list)
        self.calibrations = LocalArtifacts(folder / "calibrations")
        """What jobs found out about the target, for later jobs."""

    def objects(self) -> list[ObjectInfo]:
        """All objects."""
        return self._objects.all()

    def object(self, reference: str) -> ObjectInfo:
        """One object. Raises ``NotFoundError`` or ``AmbiguousError``."""
        return self._objects.find(reference)

    def object_bytes(self, reference: str) -> bytes:
        """The archive of an object. Raises ``NotFoundError`` or ``AmbiguousError``."""
        info = self.object(reference)
        return shipped_objects()[info.name].read() if info.shipped else self._objects.payload(info).read_bytes()

    def add_object(self, data: bytes, name: str) -> ObjectInfo:
        """Store an object archive. Raises ``ObjectError`` for one that cannot be read; nothing is kept then."""
        info = _describe_object(data, Path(name).stem or "object")
        with _Intake(self._objects.folder) as intake:
            payload = intake.folder / "data.zip"
            write_whole(payload, data)
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
        return info.name if info.shipped else str(self._classifiers.payload(info))

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
        with _Intake(self._classifiers.folder) as intake:
            payload = intake.folder / f"data{suffix}"
            identity = _copy(file, payload)
            found = _inspect(str(payload))
            _check_classes(classes, found)
            before = self._classifiers.stored(identity)
            if classes is None:
                classes = before.classes if before is not None else found.get("classes")  # type: ignore[assignment]
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
        return self._backgrounds.payload(self.background(reference)).read_bytes()

    def add_background(self, data: bytes, name: str) -> BackgroundInfo:
        """Store an image file. Raises ``SpecError`` for one that is none; nothing is kept then."""
        try:
            decode_rgb(data, name)
        except ObjectError as error:
            raise SpecError(f"The background {name!r} cannot be read as an image; send a PNG or a JPEG.") from error
        with _Intake(self._backgrounds.folder) as intake:
            payload = intake.folder / f"data{Path(name).suffix.lower()}"
            write_whole(payload, data)
            return self._backgrounds.put(BackgroundInfo(id=_identity(data), name=Path(name).stem), payload)


class _Intake:
    """A hidden folder beside the stored things; whatever is left in it is removed at the end."""

    def __init__(self, shelf: Path) -> None:
        shelf.mkdir(parents=True, exist_ok=True)
        self.folder = Path(tempfile.mkdtemp(dir=shelf, prefix=".intake-"))

    def __enter__(self) -> "_Intake":
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


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


def _describe_object(data: bytes, name: str, *, shipped: bool = False) -> ObjectInfo:
    obj = load_object(data)
    return ObjectInfo(
        id=_identity(data),
        name=name,
        materials=sorted(obj.materials),
        textures={file: (image.shape[0], image.shape[1]) for file, image in obj.textures.items()},
        triangles=sum(len(part.faces) for part in obj.parts),
        radius=obj.radius,
        shipped=shipped,
    )


def _inspect(path_or_name: str) -> dict[str, object]:
    """What a classifier is, read in a process of its own: this one stays free of torch and of what a file may do."""
    command = [sys.executable, "-m", "trompe_server.classifiers.inspect", path_or_name]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=INSPECTION_TIMEOUT, check=False)
        found = json.loads(done.stdout.strip().splitlines()[-1])
    except (subprocess.TimeoutExpired, ValueError, IndexError) as error:
        raise ClassifierError(
            "The classifier could not be read: the process that tried ended without an answer. "
            "Check that the file loads with torch.export.load or onnxruntime on this machine."
        ) from error
    if "error" in found:
        raise ClassifierError(str(found["error"]))
    return dict(found)


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
    return [_describe_object(shipped.read(), name, shipped=True) for name, shipped in shipped_objects().items()]


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
