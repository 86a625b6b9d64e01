"""What the user points at, made ready to send: files are found and options checked before any server is asked."""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, Final, TypedDict, Unpack

from pydantic import ValidationError

from trompe_shared.api import (
    AttackOn,
    JobRequest,
    Loss,
    Needs,
    Optimiser,
    Priority,
    SaliencyScope,
    SunRanges,
    SurrogateModel,
    ViewRanges,
)
from trompe_shared.errors import ClassifierError, ObjectError, SpecError
from trompe_shared.faults import faults_of

__all__ = [
    "AttackOptions",
    "AttackPlan",
    "JobOptions",
    "Sources",
    "Upload",
    "background_source",
    "background_upload",
    "classifier_source",
    "classifier_upload",
    "each_source",
    "mask_upload",
    "named_object_upload",
    "object_source",
    "object_upload",
    "plan_attack",
]

CLASSIFIER_SUFFIXES: Final = (".pt2", ".pt", ".torchscript", ".onnx")
CLASSIFIER_KINDS: Final = ("torchvision:", "hub:")
"""How names begin that are looked up elsewhere, whatever they end with."""
SPLIT_SUFFIXES: Final = {".obj", ".gltf"}
"""Models whose textures and materials lie in files beside them."""
MODEL_SUFFIXES: Final = {*SPLIT_SUFFIXES, ".glb", ".fbx", ".ply", ".stl"}
PICTURE_SUFFIXES: Final = {".png", ".jpg", ".jpeg", ".bmp", ".webp"}


Sources = str | Path | Sequence[str | Path]


@dataclass(frozen=True)
class Upload:
    """A file to send, with the form fields that go with it.

    ``content`` is its bytes, or the path of the file that holds them: that is read piece by piece while it is sent.
    """

    filename: str
    content: bytes | Path = field(repr=False)
    form: Mapping[str, str] = field(default_factory=dict)

    def sha256(self) -> str:
        """Of its bytes, in hexadecimal."""
        if isinstance(self.content, bytes):
            return hashlib.sha256(self.content).hexdigest()
        with self.content.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def opened(self) -> AbstractContextManager[bytes | BinaryIO]:
        """Its bytes, or the file, open for the time of the block."""
        return self.content.open("rb") if isinstance(self.content, Path) else nullcontext(self.content)


class JobOptions(TypedDict, total=False):
    """Options of a job; those left out take ``JobRequest``'s defaults, where they are explained."""

    diverse: bool
    attack_on: AttackOn
    sun: SunRanges | Mapping[str, Any]
    vertex_budget: float
    epsilon: float
    alpha: float
    tau: float | None
    saliency_scope: SaliencyScope
    keep: float | None
    materials: Sequence[str]
    epsilon_view: float | None
    target_label: str | int | None
    top_k: int
    loss: Loss
    optimiser: Optimiser
    restarts: int
    queries: int | None
    surrogate: SurrogateModel
    steps: int
    seed: int
    distance: float | None
    elevation: tuple[float, float] | None
    azimuths: int
    elevations: int
    pool: int
    views_per_step: int | None
    ranges: ViewRanges | Mapping[str, Any]
    held_out: int
    priority: Priority
    labels: Mapping[str, str]
    needs: Needs


class AttackOptions(JobOptions, total=False):
    """Options of an attack: those of a job, and what may be a file on this side.

    - ``classifier``: path of a .pt2, TorchScript (.pt, .torchscript) or .onnx file; or the name or id of a stored
      classifier, by default ``tiny``. Class names are read from ``<stem>.classes.json``, ``imagenet_classes.json`` or
      ``classes.json`` beside the file.
    - ``ensemble``: classifiers that are attacked together with it, given alike.
    - ``judges``: classifiers that only judge the result, given alike.
    - ``background``: "white", "black", "#rrggbb", or the path of a picture; each view draws one of several.
    - ``masks``: by the file name of a texture, the path of a picture of its size that is white where it may change.
    """

    classifier: str | Path
    ensemble: Sources
    judges: Sources
    background: Sources
    masks: Mapping[str, str | Path]


@dataclass(frozen=True)
class AttackPlan:
    """An attack with its files in hand. Object, classifiers and backgrounds are uploads, or names the server knows.

    ``masks`` are pictures by the texture's file name.
    """

    object: Upload | str
    label: str | int
    classifier: Upload | str
    ensemble: tuple[Upload | str, ...]
    judges: tuple[Upload | str, ...]
    backgrounds: tuple[Upload | str, ...]
    masks: Mapping[str, Upload]
    options: JobOptions

    def spec(
        self,
        *,
        object: str,
        classifier: str,
        ensemble: list[str],
        judges: list[str],
        background: list[str],
        masks: dict[str, str],
    ) -> JobRequest:
        """The job, with the ids that the uploads were given. Raises ``SpecError``."""
        attacked = {"object": object, "label": self.label, "classifier": classifier, "ensemble": ensemble}
        others = {"judges": judges, "background": background, "masks": masks}
        try:
            return JobRequest.model_validate(attacked | others | dict(self.options))
        except ValidationError as error:
            wrong = "; ".join(map(str, faults_of(error)))
            raise SpecError(f"The attack's options are not right: {wrong}.") from error


def plan_attack(
    object: str | Path,
    *,
    label: str | int,
    classifier: str | Path = "tiny",
    ensemble: Sources = (),
    judges: Sources = (),
    background: Sources = "white",
    masks: Mapping[str, str | Path] | None = None,
    **options: Unpack[JobOptions],
) -> AttackPlan:
    """Read the files and check the options. Raises ``ObjectError``, ``ClassifierError`` or ``SpecError``."""
    plan = AttackPlan(
        object_source(object),
        label,
        classifier_source(classifier),
        tuple(classifier_source(each) for each in each_source(ensemble)),
        tuple(classifier_source(each) for each in each_source(judges)),
        tuple(background_source(each) for each in each_source(background)),
        {texture: mask_upload(Path(picture)) for texture, picture in (masks or {}).items()},
        options,
    )
    plan.spec(object="", classifier="", ensemble=[], judges=[], background=[""] * len(plan.backgrounds), masks={})
    return plan


def each_source(sources: Sources) -> Sequence[str | Path]:
    """One source is a list of one, never its letters."""
    return [sources] if isinstance(sources, str | Path) else sources


def object_source(source: str | Path) -> Upload | str:
    """A zip, a model file or a folder that holds one becomes an upload; any other word is a stored object's name.

    Raises ``ObjectError`` for a path that is none of these.
    """
    path = Path(source)
    is_path = isinstance(source, Path) or path.is_file() or path.suffix.lower() in {".zip", *MODEL_SUFFIXES}
    return object_upload(path) if is_path or (path.is_dir() and _models_in(path)) else str(source)


def object_upload(path: Path) -> Upload:
    """A zip, a model file (an .obj or .gltf with what lies beside it), or a folder that holds one.

    Raises ``ObjectError``.
    """
    if path.is_dir():
        return Upload(f"{path.resolve().name}.zip", _zip_folder(path))
    if not path.is_file():
        raise ObjectError(
            f"There is no file {str(path)!r}. Give a zip, a model file, a folder with one, or a stored object's name."
        )
    if path.suffix.lower() in SPLIT_SUFFIXES:
        return Upload(f"{path.stem}.zip", _zip_files([path, *_companions(path)]))
    if path.suffix.lower() not in MODEL_SUFFIXES and not zipfile.is_zipfile(path):
        raise ObjectError(f"{str(path)!r} is not a zip archive. Give a zip, or the folder or model file itself.")
    return Upload(path.name, path)


def named_object_upload(path: Path, name: str | None) -> Upload:
    """An object to be stored under a name; None leaves it that of the file."""
    return replace(object_upload(path), form={"name": name} if name else {})


def classifier_source(source: str | Path) -> Upload | str:
    """A file, told by its ending, becomes an upload; any other word is a name. Raises ``ClassifierError``."""
    is_file = Path(source).suffix.lower() in CLASSIFIER_SUFFIXES and not str(source).startswith(CLASSIFIER_KINDS)
    return classifier_upload(source) if is_file else str(source)


def classifier_upload(source: str | Path, *, classes: list[str] | None = None, name: str | None = None) -> Upload:
    """A classifier's file with its class names: ``classes``, or those in a JSON file beside it.

    Raises ``ClassifierError`` when there is no such file or when the names are not a JSON list of strings.
    """
    path = Path(source)
    if not path.is_file():
        raise ClassifierError(
            f"There is no classifier file {str(path)!r}. Give one that ends in {', '.join(CLASSIFIER_SUFFIXES)}, "
            "or a stored one's name."
        )
    names = classes if classes is not None else _classes_beside(path)
    form = {"classes": json.dumps(names)} if names is not None else {}
    return Upload(path.name, path, form | ({"name": name} if name else {}))


def background_source(source: str | Path) -> Upload | str:
    """A picture file becomes an upload; any other word is a colour. Raises ``SpecError``."""
    return background_upload(Path(source)) if Path(source).suffix.lower() in PICTURE_SUFFIXES else str(source)


def background_upload(path: Path) -> Upload:
    """A picture file. Raises ``SpecError`` when there is none."""
    return _picture(path, "background", "Give a picture file, white, black or '#rrggbb'.")


def mask_upload(path: Path) -> Upload:
    """A picture of a texture's size, white where it may change. Raises ``SpecError`` when there is none."""
    return _picture(path, "mask", "Give a picture of the texture's size, white where the texture may change.")


def _picture(path: Path, use: str, remedy: str) -> Upload:
    if not path.is_file():
        raise SpecError(f"There is no {use} picture {str(path)!r}. {remedy}")
    return Upload(path.name, path)


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
    if not _models_in(folder):
        raise ObjectError(f"The folder {str(folder)!r} holds no .obj, .gltf or other model file.")
    return _zip_files(files)


def _models_in(folder: Path) -> list[Path]:
    return [file for file in folder.iterdir() if file.suffix.lower() in MODEL_SUFFIXES]


def _companions(mesh: Path) -> list[Path]:
    """Material files, buffers and pictures in the folder of an .obj or .gltf file."""
    wanted = {".mtl", ".json", ".bin", *PICTURE_SUFFIXES}
    return [file for file in mesh.parent.iterdir() if file.is_file() and file.suffix.lower() in wanted]


def _zip_files(files: list[Path]) -> bytes:
    """A flat zip with fixed time stamps, sorted by name: the same files give the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for file in sorted(files, key=lambda file: file.name):
            info = zipfile.ZipInfo(file.name, (1980, 1, 1, 0, 0, 0))
            archive.writestr(info, file.read_bytes(), compress_type=zipfile.ZIP_DEFLATED, compresslevel=1)
    return buffer.getvalue()
