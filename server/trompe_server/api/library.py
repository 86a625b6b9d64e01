"""Routes for objects, classifiers and backgrounds: upload, list, read."""

from typing import Annotated

from fastapi import APIRouter, Form, UploadFile
from pydantic import TypeAdapter, ValidationError

from trompe_server.api.problems import PROBLEMS
from trompe_server.api.services import LibraryDep
from trompe_shared.api import BackgroundInfo, ClassifierInfo, ObjectInfo
from trompe_shared.errors import SpecError

__all__ = ["router"]

router = APIRouter(prefix="/v1", responses=PROBLEMS)

Name = Annotated[str | None, Form(description="what it shall be called; the file's name by default", max_length=200)]
_names: TypeAdapter[list[str]] = TypeAdapter(list[str])


@router.post("/objects", status_code=201, tags=["objects"])
def add_object(library: LibraryDep, file: UploadFile, name: Name = None) -> ObjectInfo:
    """Upload an object: a flat zip of an OBJ, its materials and its textures. The same bytes are stored once."""
    return library.add_object(file.file.read(), name or file.filename or "object")


@router.get("/objects", tags=["objects"])
def list_objects(library: LibraryDep) -> list[ObjectInfo]:
    """All objects, the shipped ones first."""
    return library.objects()


@router.get("/objects/{reference}", tags=["objects"])
def read_object(library: LibraryDep, reference: str) -> ObjectInfo:
    """One object, by its id, the beginning of its id, or its name."""
    return library.object(reference)


@router.post("/classifiers", status_code=201, tags=["classifiers"])
def add_classifier(
    library: LibraryDep,
    file: UploadFile,
    classes: Annotated[str | None, Form(description="JSON list of class names in the order of the logits")] = None,
    name: Name = None,
) -> ClassifierInfo:
    """Upload a classifier: a .pt2 file (can be attacked) or an .onnx file (only judges)."""
    return library.add_classifier(file.file, file.filename or "", classes=_class_names(classes), name=name)


@router.get("/classifiers", tags=["classifiers"])
def list_classifiers(library: LibraryDep) -> list[ClassifierInfo]:
    """All classifiers, the shipped one first."""
    return library.classifiers()


@router.get("/classifiers/{reference}", tags=["classifiers"])
def read_classifier(library: LibraryDep, reference: str) -> ClassifierInfo:
    """One classifier, by its id, the beginning of its id, or its name."""
    return library.classifier(reference)


@router.post("/backgrounds", status_code=201, tags=["backgrounds"])
def add_background(library: LibraryDep, file: UploadFile) -> BackgroundInfo:
    """Upload a picture that views can have behind the object; its id is then a job's ``background``."""
    return library.add_background(file.file.read(), file.filename or "background")


@router.get("/backgrounds", tags=["backgrounds"])
def list_backgrounds(library: LibraryDep) -> list[BackgroundInfo]:
    """All uploaded backgrounds."""
    return library.backgrounds()


def _class_names(text: str | None) -> list[str] | None:
    if text is None:
        return None
    try:
        return _names.validate_json(text)
    except ValidationError as error:
        raise SpecError('classes must be a JSON list of names, such as ["mug", "vase"].') from error
