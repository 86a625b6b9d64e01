"""Objects in the memory of the graphics card. Only the thread that owns the OpenGL context may come here."""

import io
from collections import OrderedDict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trompe_renderer.model import Model, content_key
from trompe_renderer.platform import pyrender
from trompe_shared.object3d import Material, Part, decode_rgb

__all__ = ["Uploads"]

CAPACITY: Final = 16
PLAIN_ROUGHNESS: Final = 0.9
"""Roughness of a material whose maps do not give one."""


class Uploads:
    """Meshes and textures of the models drawn last.

    Textures are found by their content, so that models that differ in their albedo share all the rest.
    """

    def __init__(self) -> None:
        self._meshes: OrderedDict[str, Any] = OrderedDict()
        self._textures: dict[tuple[str, str], Any] = {}

    def mesh(self, model: Model) -> Any:
        """The model as a ``pyrender.Mesh``, one primitive for each part."""
        mesh = self._meshes.pop(model.key, None) or self._build(model)
        self._meshes[model.key] = mesh
        return mesh

    def trim(self) -> None:
        """Free what has not been drawn for long. Not to be called while a scene holds a mesh that it will draw."""
        while len(self._meshes) > CAPACITY:
            _, mesh = self._meshes.popitem(last=False)
            for primitive in mesh.primitives:
                primitive.delete()
        used = {texture for mesh in self._meshes.values() for p in mesh.primitives for texture in p.material.textures}
        for key in [key for key, texture in self._textures.items() if texture not in used]:
            self._textures.pop(key).delete()

    def _build(self, model: Model) -> Any:
        obj = model.obj
        return pyrender.Mesh([_primitive(p, self._material(obj.materials[p.material], model)) for p in obj.parts])

    def _material(self, material: Material, model: Model) -> Any:
        """Unity's MetallicSmoothness in pyrender's terms: a texture (roughness, metallic), factors 1."""
        maps = {
            "baseColorTexture": self._texture("RGB", material.albedo, model),
            "normalTexture": self._texture("RGB", material.normal, model),
            "metallicRoughnessTexture": self._texture("RG", material.metallic, model),
        }
        plain = material.metallic is None
        return pyrender.MetallicRoughnessMaterial(
            **maps,
            metallicFactor=0.0 if plain else 1.0,
            roughnessFactor=PLAIN_ROUGHNESS if plain else 1.0,
            alphaMode="OPAQUE",
            doubleSided=False,
        )

    def _texture(self, channels: str, name: str | None, model: Model) -> Any:
        if name is None:
            return None
        data = model.obj.files[name]
        key = (channels, content_key(data))
        if key not in self._textures:
            image = decode_rgb(data, name) if channels == "RGB" else _roughness_metallic(data)
            self._textures[key] = pyrender.Texture(source=image, source_channels=channels, sampler=_trilinear())
        return self._textures[key]


def _primitive(part: Part, material: Any) -> Any:
    return pyrender.Primitive(
        positions=part.vertices, normals=part.normals, texcoord_0=part.uvs, indices=part.faces, material=material
    )


def _trilinear() -> Any:
    gltf = pyrender.GLTF
    return pyrender.Sampler(
        magFilter=gltf.LINEAR, minFilter=gltf.LINEAR_MIPMAP_LINEAR, wrapS=gltf.REPEAT, wrapT=gltf.REPEAT
    )


def _roughness_metallic(data: bytes) -> NDArray[np.uint8]:
    """(H, W, 2) uint8 from a MetallicSmoothness file: 1 - alpha (smoothness), red."""
    with Image.open(io.BytesIO(data)) as image:
        smoothness = image.getchannel("A") if "A" in image.getbands() else None
        metallic = np.array(image.convert("RGB"))[..., 0]
    plain = np.full(metallic.shape, round(255 * PLAIN_ROUGHNESS), np.uint8)
    roughness = plain if smoothness is None else 255 - np.array(smoothness)
    return np.stack([roughness, metallic], axis=-1)
