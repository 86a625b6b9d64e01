"""Stored objects, classifiers and backgrounds, which jobs name."""

from pydantic import Field

from trompe_shared.api.schema import Schema


class ObjectInfo(Schema):
    """A stored object. ``id`` is the hash of its archive: the same upload is stored once."""

    id: str
    name: str
    materials: list[str]
    textures: dict[str, tuple[int, int]] = Field(description="albedo file: (height, width) in texels")
    triangles: int
    radius: float = Field(description="metres")
    format: str = Field(default="sailenv", description="format of the upload: sailenv, obj, gltf, fbx, ply or stl")
    filename: str | None = Field(default=None, description="file name of the upload")
    shipped: bool = False


class ClassifierInfo(Schema):
    """A stored classifier. ``white_box`` classifiers give gradients; the others give scores only."""

    id: str
    name: str
    white_box: bool
    image_size: tuple[int, int] = Field(description="(height, width) of its input")
    n_classes: int
    classes: list[str] | None = Field(None, description="class names in the order of the logits, if known")
    shipped: bool = False


class BackgroundInfo(Schema):
    """A stored background picture; a job names it by ``id``."""

    id: str
    name: str
