"""Meshes and textures in GPU memory, found by content. For the OpenGL thread only."""

from typing import Any, Final

import numpy as np

from trompe_renderer.engines.pyrender.blending import BlendedPrimitive
from trompe_renderer.engines.pyrender.platform import ANISOTROPY, GL, pyrender
from trompe_renderer.engines.surfaces import ContentCache, Pixels, TextureImage, Use
from trompe_renderer.world.model import HashedModel
from trompe_shared.object3d import PLAIN_ROUGHNESS, Material
from trompe_shared.wavefront import Part

MAX_SHAPES: Final = 32  # twice the need of the furnished room
OLD: Final = 64
"""A texture unused for so many pictures may be overwritten by another of its size."""
_MATERIAL_TEXTURES: Final[dict[Use, str]] = {
    "albedo": "baseColorTexture",
    "normal": "normalTexture",
    "metallic": "metallicRoughnessTexture",
}


class GpuCache:
    """A cache of meshes and textures, least recently used out first.

    All models of one shape share a mesh, which gets the textures of the model to draw next.
    """

    def __init__(self, *, anisotropy: int) -> None:
        self._anisotropy = anisotropy
        self._shapes: list[_GpuMesh] = []
        self._textures: ContentCache[_GpuTexture] = ContentCache(lambda texture: texture.delete())
        self._pictures = 0

    def mesh(self, model: HashedModel) -> Any:
        """The model as a ``pyrender.Mesh``, one primitive for each part, valid until ``trim``."""
        shape = self._shape(model)
        if shape.shows is None:
            for material, primitive in shape.painted:
                for use, attribute in _MATERIAL_TEXTURES.items():
                    setattr(primitive.material, attribute, self._texture(use, getattr(material, use), model))
            shape.shows = model.key
        return shape.mesh

    def trim(self) -> None:
        """End a picture: free the entries unused for longest. Invalidates all meshes that ``mesh`` has returned."""
        self._pictures += 1
        for shape in self._shapes:
            shape.shows = None
        for shape in self._shapes[:-MAX_SHAPES]:
            shape.delete()
        del self._shapes[:-MAX_SHAPES]
        self._textures.trim()

    def _shape(self, model: HashedModel) -> "_GpuMesh":
        """A shape with the model's textures, or one unused in this picture; the most recently used comes last."""
        alike = [shape for shape in self._shapes if shape.key == model.shape and shape.shows in {None, model.key}]
        shape = max(alike, key=lambda shape: shape.shows is not None, default=None) or _GpuMesh(model)
        self._shapes = [other for other in self._shapes if other is not shape] + [shape]
        return shape

    def _texture(self, use: Use, name: str | None, model: HashedModel) -> "_GpuTexture | None":
        if name is None:
            return None
        image = TextureImage(use, name, model)
        texture = self._textures.get(image.key, lambda: self._uploaded(image.pixels()))
        texture.drawn = self._pictures
        return texture

    def _uploaded(self, pixels: Pixels) -> "tuple[_GpuTexture, int]":
        """A texture and its size. To overwrite an old one takes half the time of a new one."""
        old = self._textures.take(lambda each: self._pictures - each.drawn >= OLD and each.shape == pixels.shape)
        if old is None:
            return _GpuTexture(pixels, self._anisotropy), pixels.nbytes
        old.repaint(pixels)
        return old, pixels.nbytes


class _GpuMesh:
    """A mesh in GPU memory. ``painted`` pairs each primitive with its material; ``shows`` is the model's key."""

    def __init__(self, model: HashedModel) -> None:
        obj = model.obj
        self.key = model.shape
        self.shows: str | None = None
        looks = [obj.materials[part.material] for part in obj.parts]
        self.painted = [(look, _primitive(part, look)) for look, part in zip(looks, obj.parts, strict=True)]
        self.mesh = pyrender.Mesh([primitive for _, primitive in self.painted])

    def delete(self) -> None:
        for primitive in self.mesh.primitives:
            primitive.delete()


class _GpuTexture(pyrender.Texture):  # type: ignore[misc]
    """A texture with mipmaps; its pixels (H, W, channels) uint8 can be replaced by others of the same shape.

    Unlike pyrender's own it is uploaded at once, without copies in main memory.
    """

    def __init__(self, pixels: Pixels, anisotropy: int) -> None:
        super().__init__()
        self.shape = pixels.shape
        self.drawn = 0  # the number of the picture
        self._format = {2: GL.GL_RG, 3: GL.GL_RGB, 4: GL.GL_RGBA}[pixels.shape[2]]
        self._texid = GL.glGenTextures(1)
        self._bind()
        GL.glTexParameteri(self.tex_type, GL.GL_TEXTURE_MAG_FILTER, GL.GL_LINEAR)
        GL.glTexParameteri(self.tex_type, GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR_MIPMAP_LINEAR)
        GL.glTexParameteri(self.tex_type, GL.GL_TEXTURE_WRAP_S, GL.GL_REPEAT)
        GL.glTexParameteri(self.tex_type, GL.GL_TEXTURE_WRAP_T, GL.GL_REPEAT)
        if anisotropy > 1:
            GL.glTexParameterf(self.tex_type, ANISOTROPY, anisotropy)
        height, width, _ = self.shape
        GL.glTexImage2D(self.tex_type, 0, self._format, width, height, 0, self._format, GL.GL_UNSIGNED_BYTE, None)
        self.repaint(pixels)

    def repaint(self, pixels: Pixels) -> None:
        self._bind()
        height, width, _ = self.shape
        rows = np.ascontiguousarray(pixels[::-1])
        GL.glTexSubImage2D(self.tex_type, 0, 0, 0, width, height, self._format, GL.GL_UNSIGNED_BYTE, rows)
        GL.glGenerateMipmap(self.tex_type)
        self._unbind()


def _primitive(part: Part, material: Material) -> Any:
    """A part without textures yet. A MetallicSmoothness map becomes a (roughness, metallic) texture with factors 1."""
    plain, opaque = material.metallic is None, material.opacity is None
    kind = pyrender.Primitive if opaque else BlendedPrimitive
    return kind(
        positions=part.vertices,
        normals=part.normals,
        texcoord_0=part.uvs,
        indices=part.faces,
        material=pyrender.MetallicRoughnessMaterial(
            baseColorFactor=(1.0, 1.0, 1.0, 1.0 if opaque else material.opacity),
            metallicFactor=0.0 if plain else 1.0,
            roughnessFactor=PLAIN_ROUGHNESS if plain else 1.0,
            alphaMode="OPAQUE" if opaque else "BLEND",
            doubleSided=False,
        ),
    )
