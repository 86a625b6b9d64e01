"""What the user points at, made ready to send: files are read and options checked before any server is asked."""

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypedDict, Unpack

from pydantic import ValidationError

from trompe_shared.api import JobSpec, SurrogateModel
from trompe_shared.errors import ClassifierError, ObjectError, SpecError

__all__ = [
    "AttackOptions",
    "AttackPlan",
    "Upload",
    "background_source",
    "background_upload",
    "classifier_source",
    "classifier_upload",
    "object_source",
    "object_upload",
    "plan_attack",
]

CLASSIFIER_SUFFIXES: Final = {".pt2", ".onnx"}
PICTURE_SUFFIXES: Final = {".png", ".jpg", ".jpeg", ".bmp", ".webp"}


@dataclass(frozen=True)
class Upload:
    """A file to send, with the form fields that go with it."""

    filename: str
    data: bytes = field(repr=False)
    form: Mapping[str, str] = field(default_factory=dict)


class AttackOptions(TypedDict, total=False):
    """Options of an attack; those left out take ``JobSpec``'s defaults, where they are explained."""

    epsilon: float
    alpha: float
    tau: float | None
    surrogate: SurrogateModel
    steps: int
    seed: int
    distance: float | None
    elevation: tuple[float, float] | None
    azimuths: int
    elevations: int
    held_out: int
    pool: int


@dataclass(frozen=True)
class AttackPlan:
    """An attack with its files in hand. Object, classifiers and background are uploads, or names the server knows."""

    object: Upload | str
    label: str | int
    classifier: Upload | str
    judges: tuple[Upload | str, ...]
    background: Upload | str
    options: AttackOptions

    def spec(self, *, object: str, classifier: str, judges: list[str], background: str) -> JobSpec:
        """The job, with the ids that the uploads were given. Raises ``SpecError``."""
        named: dict[str, Any] = {"object": object, "classifier": classifier, "judges": judges, "background": background}
        try:
            return JobSpec(label=self.label, **named, **self.options)
        except ValidationError as error:
            wrong = [f"{'.'.join(map(str, e['loc']))}: {e['msg']}" if e["loc"] else e["msg"] for e in error.errors()]
            raise SpecError("The attack's options are not right. " + "; ".join(wrong) + ".") from error


def plan_attack(
    object: str | Path,
    *,
    label: str | int,
    classifier: str | Path,
    judges: tuple[str | Path, ...],
    background: str | Path,
    **options: Unpack[AttackOptions],
) -> AttackPlan:
    """Read the files and check the options. Raises ``ObjectError``, ``ClassifierError`` or ``SpecError``."""
    sources = tuple(classifier_source(judge) for judge in judges)
    plan = AttackPlan(
        object_source(object), label, classifier_source(classifier), sources, background_source(background), options
    )
    plan.spec(object="", classifier="", judges=[], background="")
    return plan


def object_source(source: str | Path) -> Upload | str:
    """A zip, an .obj file or a folder that holds one becomes an upload; any other word is a stored object's name.

    Raises ``ObjectError`` for a path that is none of these.
    """
    path = Path(source)
    is_path = isinstance(source, Path) or path.is_file() or path.suffix.lower() in {".zip", ".obj"}
    return object_upload(path) if is_path or any(path.glob("*.[oO][bB][jJ]")) else str(source)


def object_upload(path: Path) -> Upload:
    """A zip, an .obj file with what lies beside it, or a folder that holds one. Raises ``ObjectError``."""
    if path.is_dir():
        return Upload(f"{path.resolve().name}.zip", _zip_folder(path))
    if not path.is_file():
        raise ObjectError(
            f"There is no file {str(path)!r}. Give a zip, a folder with an .obj, or a stored object's name."
        )
    if path.suffix.lower() == ".obj":
        return Upload(f"{path.stem}.zip", _zip_files([path, *_companions(path)]))
    if not zipfile.is_zipfile(path):
        raise ObjectError(f"{str(path)!r} is not a zip archive. Give a zip, or the folder or .obj file itself.")
    return Upload(path.name, path.read_bytes())


def classifier_source(source: str | Path) -> Upload | str:
    """A .pt2 or .onnx file becomes an upload; any other word is a stored one's name. Raises ``ClassifierError``."""
    return classifier_upload(source) if Path(source).suffix.lower() in CLASSIFIER_SUFFIXES else str(source)


def classifier_upload(source: str | Path, *, classes: list[str] | None = None, name: str | None = None) -> Upload:
    """A classifier's file with its class names: ``classes``, or those in a JSON file beside it.

    Raises ``ClassifierError`` when there is no such file or when the names are not a JSON list of strings.
    """
    path = Path(source)
    if not path.is_file():
        raise ClassifierError(
            f"There is no classifier file {str(path)!r}. Give a .pt2 or .onnx file, or a stored one's name."
        )
    names = classes if classes is not None else _classes_beside(path)
    form = {"classes": json.dumps(names)} if names is not None else {}
    return Upload(path.name, path.read_bytes(), form | ({"name": name} if name else {}))


def background_source(source: str | Path) -> Upload | str:
    """A picture file becomes an upload; any other word is a colour. Raises ``SpecError``."""
    return background_upload(Path(source)) if Path(source).suffix.lower() in PICTURE_SUFFIXES else str(source)


def background_upload(path: Path) -> Upload:
    """A picture file. Raises ``SpecError`` when there is none."""
    if not path.is_file():
        raise SpecError(
            f"There is no background picture {str(path)!r}. Give a picture file, white, black or '#rrggbb'."
        )
    return Upload(path.name, path.read_bytes())


def _classes_beside(path: Path) -> list[str] | None:
    """Class names from the first of the usual files beside a classifier."""
    candidates = [f"{path.stem}.classes.json", "imagenet_classes.json", "classes.json"]
    file = next((file for name in candidates if (file := path.with_name(name)).is_file()), None)
    if file is None:
        return None
    try:
        names = json.loads(file.read_text("utf-8"))
    except ValueError as error:
        raise ClassifierError(f"The class names in {str(file)!r} are not JSON ({error}).") from error
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ClassifierError(
            f"The class names in {str(file)!r} must be a JSON list of strings, in the order of the logits."
        )
    return names


def _zip_folder(folder: Path) -> bytes:
    files = [file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")]
    if not any(file.suffix.lower() == ".obj" for file in files):
        raise ObjectError(f"The folder {str(folder)!r} holds no .obj file.")
    return _zip_files(files)


def _companions(mesh: Path) -> list[Path]:
    """Material files and pictures in the folder of an .obj file."""
    wanted = {".mtl", ".json", *PICTURE_SUFFIXES}
    return [file for file in mesh.parent.iterdir() if file.is_file() and file.suffix.lower() in wanted]


def _zip_files(files: list[Path]) -> bytes:
    """A flat zip with fixed time stamps, sorted by name: the same files give the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for file in sorted(files, key=lambda file: file.name):
            info = zipfile.ZipInfo(file.name, (1980, 1, 1, 0, 0, 0))
            archive.writestr(info, file.read_bytes(), compress_type=zipfile.ZIP_DEFLATED, compresslevel=1)
    return buffer.getvalue()
