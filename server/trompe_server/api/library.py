"""Routes for objects, classifiers and backgrounds: upload, list, read."""

from collections.abc import Callable
from typing import Annotated, TypeVar

from fastapi import APIRouter, Form, UploadFile
from fastapi.concurrency import run_in_threadpool
from pydantic import TypeAdapter, ValidationError

from trompe_server.api import examples
from trompe_server.api.problems import PROBLEMS
from trompe_server.api.services import Services, ServicesDep
from trompe_shared.api import BackgroundInfo, ClassifierInfo, ObjectInfo
from trompe_shared.errors import SpecError

T = TypeVar("T")

router = APIRouter(prefix="/v1", responses=PROBLEMS)

Name = Annotated[str | None, Form(description="name to store it under; default: the file's name", max_length=200)]
MaxTexture = Annotated[
    int | None, Form(description="longest side of a texture in texels; larger textures are scaled down", ge=16, le=8192)
]
_names: TypeAdapter[list[str]] = TypeAdapter(list[str])


async def _in_turn(services: Services, action: Callable[[], T]) -> T:
    """Run ``action`` in a thread, ``UPLOADS`` at a time."""
    async with services.uploads:
        return await run_in_threadpool(action)


@router.post("/objects", status_code=201, responses=examples.made(examples.OBJECT), tags=["objects"])
async def add_object(
    services: ServicesDep, file: UploadFile, name: Name = None, max_texture: MaxTexture = None
) -> ObjectInfo:
    """Upload an object: a GLB, FBX, PLY or STL, or a zip of an OBJ or glTF with its materials and textures.

    The same bytes are stored once.
    """
    filename = file.filename or "object"
    return await _in_turn(
        services, lambda: services.library.add_object(file.file, filename, name=name, max_texture=max_texture)
    )


@router.get("/objects", responses=examples.found([examples.OBJECT]), tags=["objects"])
def list_objects(services: ServicesDep) -> list[ObjectInfo]:
    """All objects, the shipped ones first."""
    return services.library.objects.all()


@router.get("/objects/{reference}", responses=examples.found(examples.OBJECT), tags=["objects"])
def read_object(services: ServicesDep, reference: str) -> ObjectInfo:
    """One object, by id, beginning of the id, or name."""
    return services.library.objects.find(reference)


@router.post("/classifiers", status_code=201, responses=examples.made(examples.CLASSIFIER), tags=["classifiers"])
async def add_classifier(
    services: ServicesDep,
    file: UploadFile,
    classes: Annotated[str | None, Form(description="JSON list of class names in the order of the logits")] = None,
    name: Name = None,
) -> ClassifierInfo:
    """Upload a classifier: a .pt2 file, or an .onnx file (scores only)."""
    names = _class_names(classes)
    return await _in_turn(
        services, lambda: services.library.add_classifier(file.file, file.filename or "", classes=names, name=name)
    )


@router.get("/classifiers", responses=examples.found([examples.CLASSIFIER]), tags=["classifiers"])
def list_classifiers(services: ServicesDep) -> list[ClassifierInfo]:
    """All classifiers, the shipped one first."""
    return services.library.classifiers.all()


@router.get("/classifiers/{reference}", responses=examples.found(examples.CLASSIFIER), tags=["classifiers"])
def read_classifier(services: ServicesDep, reference: str) -> ClassifierInfo:
    """One classifier, by id, beginning of the id, or name."""
    return services.library.classifier(reference)


@router.post("/backgrounds", status_code=201, responses=examples.made(examples.BACKGROUND), tags=["backgrounds"])
async def add_background(services: ServicesDep, file: UploadFile) -> BackgroundInfo:
    """Upload a background picture. Jobs name it by its id."""
    return await _in_turn(
        services, lambda: services.library.add_background(file.file.read(), file.filename or "background")
    )


@router.get("/backgrounds", responses=examples.found([examples.BACKGROUND]), tags=["backgrounds"])
def list_backgrounds(services: ServicesDep) -> list[BackgroundInfo]:
    """All uploaded backgrounds."""
    return services.library.backgrounds.all()


def _class_names(text: str | None) -> list[str] | None:
    if text is None:
        return None
    try:
        return _names.validate_json(text)
    except ValidationError as error:
        raise SpecError('classes must be a JSON list of names, such as ["mug", "vase"].') from error
