"""Routes for objects, classifiers and backgrounds: upload, list, read."""

import asyncio
from collections.abc import Callable
from typing import Annotated, Final, TypeVar

from fastapi import APIRouter, Depends, Form, Request, UploadFile
from fastapi.concurrency import run_in_threadpool
from pydantic import TypeAdapter, ValidationError

from trompe_server.api import examples
from trompe_server.api.problems import PROBLEMS
from trompe_server.api.services import LibraryDep
from trompe_shared.api import BackgroundInfo, ClassifierInfo, ObjectInfo
from trompe_shared.errors import SpecError

T = TypeVar("T")

UPLOADS: Final = 2
"""Uploads that are read at the same time, since each may take a lot of memory. The others wait on disk."""

router = APIRouter(prefix="/v1", responses=PROBLEMS)

Name = Annotated[str | None, Form(description="name to store it under; default: the file's name", max_length=200)]
MaxTexture = Annotated[
    int | None, Form(description="longest side of a texture in texels; larger textures are scaled down", ge=16, le=8192)
]
_names: TypeAdapter[list[str]] = TypeAdapter(list[str])


def _turn(request: Request) -> asyncio.Semaphore:
    turn: asyncio.Semaphore = request.app.state.uploads
    return turn


TurnDep = Annotated[asyncio.Semaphore, Depends(_turn)]


async def _in_turn(turn: asyncio.Semaphore, action: Callable[[], T]) -> T:
    """Run ``action`` in a thread, ``UPLOADS`` at a time."""
    async with turn:
        return await run_in_threadpool(action)


@router.post("/objects", status_code=201, responses=examples.made(examples.OBJECT), tags=["objects"])
async def add_object(
    library: LibraryDep, turn: TurnDep, file: UploadFile, name: Name = None, max_texture: MaxTexture = None
) -> ObjectInfo:
    """Upload an object: a GLB, FBX, PLY or STL, or a zip of an OBJ or glTF with its materials and textures.

    The same bytes are stored once.
    """
    filename = file.filename or "object"
    return await _in_turn(turn, lambda: library.add_object(file.file, filename, name=name, max_texture=max_texture))


@router.get("/objects", responses=examples.found([examples.OBJECT]), tags=["objects"])
def list_objects(library: LibraryDep) -> list[ObjectInfo]:
    """All objects, the shipped ones first."""
    return library.objects()


@router.get("/objects/{reference}", responses=examples.found(examples.OBJECT), tags=["objects"])
def read_object(library: LibraryDep, reference: str) -> ObjectInfo:
    """One object, by id, beginning of the id, or name."""
    return library.object(reference)


@router.post("/classifiers", status_code=201, responses=examples.made(examples.CLASSIFIER), tags=["classifiers"])
async def add_classifier(
    library: LibraryDep,
    turn: TurnDep,
    file: UploadFile,
    classes: Annotated[str | None, Form(description="JSON list of class names in the order of the logits")] = None,
    name: Name = None,
) -> ClassifierInfo:
    """Upload a classifier: a .pt2 file, or an .onnx file (scores only)."""
    names = _class_names(classes)
    return await _in_turn(
        turn, lambda: library.add_classifier(file.file, file.filename or "", classes=names, name=name)
    )


@router.get("/classifiers", responses=examples.found([examples.CLASSIFIER]), tags=["classifiers"])
def list_classifiers(library: LibraryDep) -> list[ClassifierInfo]:
    """All classifiers, the shipped one first."""
    return library.classifiers()


@router.get("/classifiers/{reference}", responses=examples.found(examples.CLASSIFIER), tags=["classifiers"])
def read_classifier(library: LibraryDep, reference: str) -> ClassifierInfo:
    """One classifier, by id, beginning of the id, or name."""
    return library.classifier(reference)


@router.post("/backgrounds", status_code=201, responses=examples.made(examples.BACKGROUND), tags=["backgrounds"])
async def add_background(library: LibraryDep, turn: TurnDep, file: UploadFile) -> BackgroundInfo:
    """Upload a background picture. Jobs name it by its id."""
    return await _in_turn(turn, lambda: library.add_background(file.file.read(), file.filename or "background"))


@router.get("/backgrounds", responses=examples.found([examples.BACKGROUND]), tags=["backgrounds"])
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
