"""Stored objects, classifiers and backgrounds, which jobs name."""

from pydantic import Field

from trompe_shared.api.schema import Schema


class _Stored(Schema):
    """What is stored under an id; ``shipped`` ones come with Trompe."""

    id: str
    name: str
    shipped: bool = False

    @property
    def reference(self) -> str:
        """Its name in a job: shipped ones keep theirs in every version, ids are of uploads."""
        return self.name if self.shipped else self.id


class ObjectInfo(_Stored):
    """A stored object. ``id`` is the hash of its archive: the same upload is stored once."""

    materials: list[str]
    textures: dict[str, tuple[int, int]] = Field(description="albedo file: (height, width) in texels")
    triangles: int
    radius: float = Field(description="metres")
    format: str = Field(default="sailenv", description="format of the upload: sailenv, obj, gltf, fbx, ply or stl")
    filename: str | None = Field(default=None, description="file name of the upload")


class ClassifierInfo(_Stored):
    """A stored classifier. ``white_box`` classifiers give gradients; the others give scores only."""

    white_box: bool
    image_size: tuple[int, int] = Field(description="(height, width) of its input")
    n_classes: int
    classes: list[str] | None = Field(None, description="class names in the order of the logits, if known")


class BackgroundInfo(Schema):
    """A stored background picture; a job names it by ``id``."""

    id: str
    name: str
