"""An attack before it is sent: its files are found and its options checked before any request."""

import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import UnionType
from typing import Any, BinaryIO, Generic, Self, TypeVar

from pydantic import ValidationError

from trompe_shared.api import (
    OPTIONS,
    BackgroundInfo,
    ClassifierInfo,
    JobRequest,
    JudgementRequest,
    ObjectInfo,
    in_parts,
)
from trompe_shared.errors import ClassifierError, ObjectError, SpecError
from trompe_shared.faults import Fault, faults_of
from trompe_shared.local_files import (
    CLASSIFIER_SUFFIXES,
    LOOKED_UP,
    MODEL_SUFFIXES,
    PICTURE_SUFFIXES,
    classes_beside,
    model_file,
    models_in,
)

StoredKind = type[ObjectInfo | ClassifierInfo | BackgroundInfo]
Source = str | Path
R = TypeVar("R", JobRequest, JudgementRequest)


@dataclass(frozen=True)
class Upload:
    """A file to send. ``content``: its bytes, or the path to read them from piece by piece.

    ``form``: fields to send with it. ``kind``: the record that the server makes of it.
    """

    filename: str
    content: bytes | Path = field(repr=False)
    form: Mapping[str, str] = field(default_factory=dict, hash=False)
    kind: StoredKind = ObjectInfo

    def sha256(self) -> str:
        """SHA-256 of the bytes, in hexadecimal."""
        if isinstance(self.content, bytes):
            return hashlib.sha256(self.content).hexdigest()
        with self.content.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def opened(self) -> AbstractContextManager[bytes | BinaryIO]:
        """The bytes, or the file, open within the block."""
        return self.content.open("rb") if isinstance(self.content, Path) else nullcontext(self.content)


@dataclass(frozen=True)
class Plan(Generic[R]):
    """A request by keyword, with an ``Upload`` in place of each file; ``make`` checks it."""

    options: Mapping[str, Any]
    make: Callable[..., R]

    def uploads(self) -> list[Upload]:
        """Files to send before the request, each once."""
        found: dict[Upload, None] = {}
        _replaced(self.options, Upload, found.setdefault)
        return list(found)

    def request(self, ids: Mapping[Upload, str]) -> R:
        """The request with ids in place of files; a file without an id keeps its name. Raises ``SpecError``."""
        return self.make(**_replaced(self.options, Upload, lambda upload: ids.get(upload, upload.filename)))

    def checked(self) -> Self:
        """The plan itself. Raises ``SpecError`` for invalid options."""
        self.request({})
        return self


AttackPlan = Plan[JobRequest]


def _job_request(*, object: str, **options: Any) -> JobRequest:
    try:
        return JobRequest.model_validate({"object": object, "goal": {}, **in_parts(options)})
    except ValidationError as error:
        raise SpecError(f"Invalid options: {'; '.join(map(_by_keyword, faults_of(error)))}.") from error


def _replaced(value: Any, kind: type | UnionType, by: Callable[[Any], Any]) -> Any:
    """``value`` with everything of a kind replaced, in nested mappings and lists too."""
    if isinstance(value, kind):
        return by(value)
    if isinstance(value, Mapping):
        return {key: _replaced(each, kind, by) for key, each in value.items()}
    return [_replaced(each, kind, by) for each in value] if isinstance(value, list | tuple | set) else value


def _by_keyword(fault: Fault) -> str:
    """A fault at the keyword of its option; a rule between options names them itself."""
    part, field, *inner = [*fault.place.split("."), ""]
    for option in OPTIONS.values():
        if (option.part, option.field) == (part, field):
            return f"{' '.join([f'`{option.keyword}`', *filter(None, inner)])}: {fault.message}"
    return fault.message if fault.kind == "value_error" else str(fault)


Read = Callable[[str, Source], Upload | str]
"""Reads a file of a kind ("object" or a ``FileKind``); gives the name of a stored one back as it is."""


def source_of(kind: str, source: Source) -> Upload | str:
    """A file as an upload, any other word as it is. Raises ``ObjectError``, ``ClassifierError`` or ``SpecError``."""
    read: Mapping[str, Callable[[Source], Upload | str]] = {
        "object": object_source,
        "classifier": classifier_source,
        "background": background_source,
        "mask": lambda picture: _picture(Path(picture), "mask", "the texture's size, white where it may change"),
    }
    return read[kind](source)


def plan_attack(object: Source | None = None, *, read: Read = source_of, **options: Any) -> AttackPlan:
    """Read the files and check the options (``OPTIONS``, and the queue's).

    Raises ``ObjectError``, ``ClassifierError`` or ``SpecError``, also without an object.
    """
    if not isinstance(object, str | Path):
        raise SpecError(f"`object`: expected a file, a folder or the name of a stored object; got {object!r}.")
    planned: dict[str, Any] = {"object": read("object", object)}
    for keyword, value in options.items():
        option = OPTIONS.get(keyword)
        if option is None or option.file is None:
            planned[keyword] = value
        else:
            several = option.repeated and isinstance(value, str | Path)
            planned[keyword] = _replaced([value] if several else value, str | Path, partial(read, option.file))
    return Plan(planned, _job_request).checked()


def plan_judgement(before: Source, after: Source, **options: Any) -> Plan[JudgementRequest]:
    """Read the files of a judgement and check its options (``JudgementRequest``).

    Raises ``ObjectError``, ``ClassifierError`` or ``SpecError``.
    """
    planned = options | {"before": object_source(before), "after": object_source(after)}
    if "networks" in options:
        networks = options["networks"]
        one = isinstance(networks, str | Path)
        planned["networks"] = [classifier_source(each) for each in ([networks] if one else networks)]
    return Plan(planned, JudgementRequest.of).checked()


def object_source(source: Source) -> Upload | str:
    """A zip, a model file or a folder with one as an upload; any other word is a stored object's name.

    Raises ``ObjectError`` for a path without such a file.
    """
    path = _named(source)
    is_path = isinstance(source, Path) or path.is_file() or path.suffix.lower() in {".zip", *MODEL_SUFFIXES}
    is_folder = path.is_dir() and (len(path.parts) > 1 or bool(models_in(path)))
    return object_upload(path) if is_path or is_folder else str(source)


def _named(source: Source) -> Path:
    """The path of an object. Raises ``ObjectError`` for no word at all, which would mean the current folder."""
    if source == "":
        raise ObjectError("The object's name is empty. Give a file, a folder, or a stored object's name.")
    return Path(source)


def object_upload(source: Source, *, name: str | None = None) -> Upload:
    """A zip, a model file (an .obj or .gltf with the files it names), or a folder with one.

    name: to store it under; default: the file's. Raises ``ObjectError``.
    """
    return Upload(*model_file(_named(source)), form={"name": name} if name else {})


def classifier_source(source: Source) -> Upload | str:
    """A .pt2 or .onnx file as an upload; any other word is a name. Raises ``ClassifierError``, also for other files."""
    path = Path(source)
    is_file = path.suffix.lower() in CLASSIFIER_SUFFIXES or (path.suffix and path.is_file())
    return classifier_upload(source) if is_file and not str(source).startswith(LOOKED_UP) else str(source)


def classifier_upload(source: Source, *, classes: list[str] | None = None, name: str | None = None) -> Upload:
    """A classifier's file with its class names: ``classes``, or the JSON list in a file beside it.

    Raises ``ClassifierError`` for a missing file or one of another kind, or for class names in another format.
    """
    path = Path(source)
    if not path.is_file():
        raise ClassifierError(
            f"There is no classifier file {str(path)!r}. Give a file that ends in {' or '.join(CLASSIFIER_SUFFIXES)}, "
            "or the name of a stored classifier."
        )
    if path.suffix.lower() not in CLASSIFIER_SUFFIXES:
        raise ClassifierError(
            f"{path.name!r} is not a supported classifier file: export the network to .pt2 (torch.export) or .onnx; "
            "docs/library.md shows how, for torch and Keras."
        )
    names = classes if classes is not None else classes_beside(path)
    form = {"classes": json.dumps(names)} if names is not None else {}
    return Upload(path.name, path, form | ({"name": name} if name else {}), ClassifierInfo)


def background_source(source: Source) -> Upload | str:
    """A picture file as an upload; any other word is a colour or an id. Raises ``SpecError``."""
    return background_upload(Path(source)) if Path(source).suffix.lower() in PICTURE_SUFFIXES else str(source)


def background_upload(path: Path) -> Upload:
    """A picture file. Raises ``SpecError`` if it is missing."""
    return _picture(path, "background", "any size; or white, black or '#rrggbb'")


def _picture(path: Path, use: str, remedy: str) -> Upload:
    if not path.is_file():
        raise SpecError(f"There is no {use} picture {str(path)!r}. Give a picture of {remedy}.")
    return Upload(path.name, path, kind=BackgroundInfo)
