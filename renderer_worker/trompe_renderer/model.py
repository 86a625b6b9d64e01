"""Objects as agents upload them, read once: the same archive again costs no more than its hash.

An archive that differs from one read lately in its albedo textures alone, as those of an attack do, costs no more than
the decoding of the new ones.
"""

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from trompe_shared.errors import ObjectError, RendererError
from trompe_shared.object3d import Object3D, decode_rgb, object_from_files, unpacked_size, unzip

__all__ = ["Holdings", "Library", "Model", "content_key", "model_of", "repainted"]

CAPACITY: Final = 8
KEPT_BYTES: Final = 2**30
"""All models of a library together; the last one is kept, whatever its size."""
LARGE: Final = 64 * 2**20
"""Archives that unpack to more bytes are read one after the other."""

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

    @property
    def nbytes(self) -> int:
        """About what it takes in memory."""
        parts = sum(p.vertices.nbytes + p.normals.nbytes + p.uvs.nbytes + p.faces.nbytes for p in self.obj.parts)
        textures = sum(texture.nbytes for texture in self.obj.textures.values())
        return parts + textures + sum(map(len, self.obj.files.values()))


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


class Holdings:
    """How many bytes each of many holders keeps, of at most ``total`` together. Those of one that is gone are free."""

    def __init__(self, total: int) -> None:
        self._total = total
        self._held: WeakKeyDictionary[object, int] = WeakKeyDictionary()
        self._lock = threading.Lock()

    def hold(self, whose: object, count: int) -> None:
        """From now on ``whose`` keeps ``count`` bytes. Raises ``RendererError`` where that is more than is left."""
        with self._lock:
            others = sum(held for holder, held in self._held.items() if holder is not whose)
            if count > self._held.get(whose, 0) and others + count > self._total:
                raise RendererError(
                    f"All agents together keep up to {self._total >> 20} MiB here, of which {others >> 20} MiB are "
                    f"others'; {max(count >> 20, 1)} MiB do not fit. Try again when others have left."
                )
            self._held[whose] = count


class Library:
    """The models read last, shared by all agents; and what each agent keeps."""

    def __init__(self, *, uploads: int = 2**30, textures: int = 4 * 2**30) -> None:
        self.uploads, self.textures = Holdings(uploads), Holdings(textures)
        self._models: OrderedDict[str, Model] = OrderedDict()
        self._lock = threading.Lock()
        self._large = threading.Lock()

    def read(self, key: str, archive: bytes) -> Model:
        """The model in a zip whose ``content_key`` is ``key``. Raises ``ObjectError``.

        No agent waits for the reading of another but where both archives are large: two who send the same object at
        the same time both read it.
        """
        with self._lock:
            found, recent = self._models.get(key), list(self._models.values())
        if found is None:
            with self._turn(archive):
                found = _read(unzip(archive), recent)
        with self._lock:
            self._models[key] = found
            self._models.move_to_end(key)
            while len(self._models) > 1 and (len(self._models) > CAPACITY or self._nbytes() > KEPT_BYTES):
                self._models.popitem(last=False)
        return found

    def _turn(self, archive: bytes) -> AbstractContextManager[object]:
        return self._large if unpacked_size(archive) > LARGE else nullcontext()

    def _nbytes(self) -> int:
        return sum(model.nbytes for model in self._models.values())


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
