"""Comparison of an object before and after a repaint."""

import numpy as np

from trompe_server.formats.pictures import Pixels, shrink
from trompe_shared.errors import ObjectError
from trompe_shared.object3d import Object3D


def repainted(original: Object3D, painted: Object3D) -> dict[str, Pixels]:
    """The textures (H, W, 3) of ``painted``, by name, with colours different from ``original``.

    Raises ``ObjectError`` if the meshes differ.
    """
    if _mesh(original) != _mesh(painted) or original.textures.keys() != painted.textures.keys():
        raise ObjectError(
            f"The mesh of {painted.name!r} is not the uploaded one (it was moved, or read by another version of "
            "Trompe), so its paint does not fit the uploaded file. Take the zip or the GLB, or upload it again."
        )
    return {name: image for name, image in painted.textures.items() if not _same(original.textures[name], image)}


def _mesh(obj: Object3D) -> list[bytes]:
    return [data for name, data in obj.files.items() if name.lower().endswith(".obj")]


def _same(before: Pixels, after: Pixels) -> bool:
    return np.array_equal(shrink(before, max(after.shape[:2])), after)
