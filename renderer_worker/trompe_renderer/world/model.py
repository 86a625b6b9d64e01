"""3D models with hashes of their content, by which caches find meshes and textures."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from trompe_shared.errors import ObjectError
from trompe_shared.object3d import Object3D
from trompe_shared.opacity import opacity_of

Texture = NDArray[np.uint8]


@dataclass(frozen=True)
class HashedModel:
    """An object and hashes of its content.

    ``albedos`` holds the hash of each texture that serves as albedo only, by file name; ``shape`` covers everything
    else, ``key`` covers all. In a repainted model ``obj.textures`` is up to date and ``obj.files`` is not.
    ``opacities`` holds a cache key and the alpha (H, W) of each albedo texture; "" and ``None`` if all of it is opaque.
    """

    shape: str
    albedos: Mapping[str, str]
    obj: Object3D = field(compare=False, repr=False)
    opacities: Mapping[str, tuple[str, Texture | None]] = field(compare=False, repr=False)

    @cached_property
    def key(self) -> str:
        """Equal for equal content."""
        opacities = [self.opacities[name][0] for name in sorted(self.albedos)]
        return content_key(repr((self.shape, sorted(self.albedos.items()), opacities)).encode())

    @property
    def nbytes(self) -> int:
        """Approximate size in memory."""
        parts = sum(p.vertices.nbytes + p.normals.nbytes + p.uvs.nbytes + p.faces.nbytes for p in self.obj.parts)
        textures = sum(texture.nbytes for texture in self.obj.textures.values())
        alphas = sum(alpha.nbytes for _, alpha in self.opacities.values() if alpha is not None)
        return parts + textures + alphas + sum(map(len, self.obj.files.values()))


def content_key(*data: bytes | Texture) -> str:
    """SHA-256 of ``data`` as hex digits."""
    digest = hashlib.sha256()
    for part in data:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).data)
    return digest.hexdigest()


def model_of(obj: Object3D) -> HashedModel:
    """Hash the content of ``obj``."""
    maps = {name for material in obj.materials.values() for name in (material.normal, material.metallic)}
    albedos = {name: _texture_key(texture) for name, texture in obj.textures.items() if name not in maps}
    kept = [(name.encode(), data) for name, data in sorted(obj.files.items()) if name not in albedos]
    blended = (name.encode() for name, look in sorted(obj.materials.items()) if look.opacity is not None)
    shape = content_key(*(part for item in kept for part in item), *blended)
    return HashedModel(shape, albedos, obj, opacities_of(obj, obj.textures))


def opacities_of(obj: Object3D, names: Iterable[str]) -> Mapping[str, tuple[str, Texture | None]]:
    """``HashedModel.opacities`` of some textures, from the files of ``obj``."""
    return {name: _opacity(obj.files[name], blended=name in obj.blended) for name in names}


def repainted(model: HashedModel, textures: Mapping[str, Texture]) -> HashedModel:
    """``model`` with some of its albedo textures replaced: (H, W, 3) uint8, row 0 on top.

    Raises ``ObjectError`` for a name outside ``albedos`` and for a texture without texels.
    """
    unknown = sorted(set(textures) - set(model.albedos))
    if unknown:
        raise ObjectError(f"{unknown} cannot be repainted; choose from {sorted(model.albedos)}.")
    if not all(texture.size for texture in textures.values()):
        raise ObjectError("A texture must have at least one texel.")
    obj = replace(model.obj, textures={**model.obj.textures, **textures})
    albedos = {**model.albedos, **{name: _texture_key(texture) for name, texture in textures.items()}}
    return replace(model, albedos=albedos, obj=obj)


def _opacity(data: bytes, *, blended: bool) -> tuple[str, Texture | None]:
    opacity = opacity_of(data, blended=blended)
    return ("", None) if opacity is None else (f" opacity {content_key(opacity)}", opacity)


def _texture_key(texture: Texture) -> str:
    return content_key(repr(texture.shape).encode(), texture)
