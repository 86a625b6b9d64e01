"""Objects as agents upload them, read once: the same archive again costs no more than its hash.

An archive that differs from one read lately in its albedo textures alone, as those of an attack do, costs no more than
the decoding of the new ones.
"""

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_shared.errors import ObjectError
from trompe_shared.object3d import Object3D, decode_rgb, object_from_files, unzip

__all__ = ["Library", "Model", "content_key", "model_of", "repainted"]

CAPACITY: Final = 8

Texture = NDArray[np.uint8]


@dataclass(frozen=True)
class Model:
    """An object with names for its content, by which what was made of it can be found again.

    ``albedos`` names, by file name, each texture that is an albedo and nothing else; ``shape`` names all the rest,
    ``key`` names all. Of a repainted model ``obj.textures`` is up to date, the files of those textures are not.
    """

    shape: str
    albedos: Mapping[str, str]
    obj: Object3D = field(compare=False, repr=False)

    @cached_property
    def key(self) -> str:
        """The same for the same content."""
        return content_key(repr((self.shape, sorted(self.albedos.items()))).encode())


def content_key(*data: bytes | Texture) -> str:
    """A name for ``data`` that no other bytes have."""
    digest = hashlib.sha256()
    for part in data:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).data)
    return digest.hexdigest()


def model_of(obj: Object3D) -> Model:
    """``obj`` as a model."""
    maps = {name for material in obj.materials.values() for name in (material.normal, material.metallic)}
    albedos = {name: _picture_key(texture) for name, texture in obj.textures.items() if name not in maps}
    kept = [(name.encode(), data) for name, data in sorted(obj.files.items()) if name not in albedos]
    return Model(content_key(*(part for item in kept for part in item)), albedos, obj)


def repainted(model: Model, textures: Mapping[str, Texture]) -> Model:
    """``model`` with some of its albedo textures replaced: (H, W, 3) uint8, row 0 on top.

    Raises ``ObjectError`` for a name that is not among ``albedos``, and for a texture without texels.
    """
    unknown = sorted(set(textures) - set(model.albedos))
    if unknown:
        raise ObjectError(f"{unknown} cannot be repainted; those that can are {sorted(model.albedos)}.")
    if not all(texture.size for texture in textures.values()):
        raise ObjectError("A texture must have at least one texel.")
    obj = replace(model.obj, textures={**model.obj.textures, **textures})
    return Model(model.shape, {**model.albedos, **{name: _picture_key(t) for name, t in textures.items()}}, obj)


def _picture_key(texture: Texture) -> str:
    return content_key(repr(texture.shape).encode(), texture)


class Library:
    """The models read last, shared by all agents."""

    def __init__(self) -> None:
        self._models: OrderedDict[str, Model] = OrderedDict()
        self._lock = threading.Lock()

    def read(self, key: str, archive: bytes) -> Model:
        """The model in a zip whose ``content_key`` is ``key``. Raises ``ObjectError``.

        No agent waits for the reading of another: two who send the same object at the same time both read it.
        """
        with self._lock:
            found, recent = self._models.get(key), list(self._models.values())
        model = found or _read(unzip(archive), recent)
        with self._lock:
            self._models[key] = model
            self._models.move_to_end(key)
            if len(self._models) > CAPACITY:
                self._models.popitem(last=False)
        return model


def _read(files: Mapping[str, bytes], recent: list[Model]) -> Model:
    for model in reversed(recent):
        if _differs_in_albedos_alone(files, model):
            changed = [name for name in model.albedos if files[name] != model.obj.files[name]]
            new = repainted(model, {name: decode_rgb(files[name], name) for name in changed})
            return replace(new, obj=replace(new.obj, files=files))
    return model_of(object_from_files(files))


def _differs_in_albedos_alone(files: Mapping[str, bytes], model: Model) -> bool:
    before = model.obj.files
    return files.keys() == before.keys() and all(files[n] == before[n] for n in files if n not in model.albedos)
