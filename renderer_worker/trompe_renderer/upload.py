"""Objects in the memory of the graphics card. Only the thread that owns the OpenGL context may come here."""

from collections import OrderedDict
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_renderer import cutout  # noqa: F401 (makes pyrender test alpha)
from trompe_renderer.model import Model, content_key
from trompe_renderer.platform import ANISOTROPY, GL, pyrender
from trompe_shared.object3d import Material, Part, decode_rgb, open_image
from trompe_shared.opacity import opacity_of

__all__ = ["Uploads"]

MAX_SHAPES: Final = 32  # twice what a furnished room needs
MAX_TEXTURES: Final = 256
MAX_TEXTURE_BYTES: Final = 512 * 2**20
OLD: Final = 64
"""Pictures after which a texture that was on none of them may be painted over with another of its size."""
PLAIN_ROUGHNESS: Final = 0.9
"""Roughness of a material whose maps do not give one."""

_MATERIAL_TEXTURES: Final = {
    "albedo": "baseColorTexture",
    "normal": "normalTexture",
    "metallic": "metallicRoughnessTexture",
}

Pixels = NDArray[np.uint8]


class Uploads:
    """Meshes and textures of what was drawn last, found by their content.

    A mesh serves all models of its shape: it is given the textures of the one that is drawn next.
    """

    def __init__(self, *, anisotropy: int = 1) -> None:
        self._anisotropy = anisotropy
        self._shapes: list[_Shape] = []
        self._textures: OrderedDict[str, _Texture] = OrderedDict()
        self._pictures = 0

    def mesh(self, model: Model) -> Any:
        """The model as a ``pyrender.Mesh``, one primitive for each part; it stays as it is until ``trim``."""
        shape = self._shape(model)
        if shape.shows is None:
            for material, primitive in shape.painted:
                for use, attribute in _MATERIAL_TEXTURES.items():
                    setattr(primitive.material, attribute, self._texture(use, getattr(material, use), model))
            shape.shows = model.key
        return shape.mesh

    def trim(self) -> None:
        """Free what has not been drawn for long. Not to be called while a scene holds a mesh that it will draw."""
        self._pictures += 1
        for shape in self._shapes:
            shape.shows = None
        for shape in self._shapes[:-MAX_SHAPES]:
            shape.delete()
        del self._shapes[:-MAX_SHAPES]
        size = sum(texture.nbytes for texture in self._textures.values())
        while size > MAX_TEXTURE_BYTES or len(self._textures) > MAX_TEXTURES:
            _, texture = self._textures.popitem(last=False)
            size -= texture.nbytes
            texture.delete()

    def _shape(self, model: Model) -> "_Shape":
        """A shape that shows the model already, or that shows nothing in this scene; the one used last comes last."""
        alike = [shape for shape in self._shapes if shape.key == model.shape and shape.shows in {None, model.key}]
        shape = max(alike, key=lambda shape: shape.shows is not None, default=None) or _Shape(model)
        self._shapes = [other for other in self._shapes if other is not shape] + [shape]
        return shape

    def _texture(self, use: str, name: str | None, model: Model) -> "_Texture | None":
        if name is None:
            return None
        key = model.albedos.get(name) or f"{model.shape} {use} {name}"
        if use == "albedo":
            key += _opacity(model.obj.files[name])[0]
        if key not in self._textures:
            pixels = _pixels(use, name, model)
            self._textures[key] = self._repainted(pixels) or _Texture(pixels, self._anisotropy)
        self._textures.move_to_end(key)
        self._textures[key].drawn = self._pictures
        return self._textures[key]

    def _repainted(self, pixels: Pixels) -> "_Texture | None":
        """An old texture, now with these ``pixels``: half the time of making a new one."""
        for key, texture in self._textures.items():
            if self._pictures - texture.drawn < OLD:
                return None  # and those that follow are younger
            if texture.shape == pixels.shape:
                texture.repaint(pixels)
                return self._textures.pop(key)
        return None


class _Shape:
    """A mesh on the card. ``painted`` are its primitives with what they are to look like."""

    def __init__(self, model: Model) -> None:
        obj = model.obj
        self.key = model.shape
        self.shows: str | None = None
        looks = [obj.materials[part.material] for part in obj.parts]
        self.painted = [(look, _primitive(part, look)) for look, part in zip(looks, obj.parts, strict=True)]
        self.mesh = pyrender.Mesh([primitive for _, primitive in self.painted])

    def delete(self) -> None:
        for primitive in self.mesh.primitives:
            primitive.delete()


class _Texture(pyrender.Texture):  # type: ignore[misc]
    """A texture with mipmaps whose pixels (H, W, channels) can be replaced by others of the same shape."""

    def __init__(self, pixels: Pixels, anisotropy: int) -> None:
        super().__init__(sampler=_trilinear())
        self._anisotropy = anisotropy
        self.shape, self.nbytes = pixels.shape, pixels.nbytes
        self.drawn = 0  # the number of the picture
        self._format = {2: GL.GL_RG, 3: GL.GL_RGB, 4: GL.GL_RGBA}[pixels.shape[2]]
        self._waiting: Pixels | None = pixels

    def repaint(self, pixels: Pixels) -> None:
        if not self._in_context():
            self._waiting = pixels
            return
        self._bind()
        height, width, _ = self.shape
        rows = np.ascontiguousarray(pixels[::-1])
        GL.glTexSubImage2D(self.tex_type, 0, 0, 0, width, height, self._format, GL.GL_UNSIGNED_BYTE, rows)
        GL.glGenerateMipmap(self.tex_type)
        self._unbind()

    def _add_to_context(self) -> None:
        """As pyrender does it, without its four copies of the pixels, of which none is kept."""
        if self._waiting is None:
            raise ValueError("the texture was deleted")
        self._texid = GL.glGenTextures(1)
        self._bind()
        height, width, _ = self.shape
        rows = np.ascontiguousarray(self._waiting[::-1])
        kind = self._format, GL.GL_UNSIGNED_BYTE
        GL.glTexImage2D(self.tex_type, 0, self._format, width, height, 0, *kind, rows)
        GL.glGenerateMipmap(self.tex_type)
        sampler = self.sampler
        for name, value in (
            (GL.GL_TEXTURE_MAG_FILTER, sampler.magFilter),
            (GL.GL_TEXTURE_MIN_FILTER, sampler.minFilter),
            (GL.GL_TEXTURE_WRAP_S, sampler.wrapS),
            (GL.GL_TEXTURE_WRAP_T, sampler.wrapT),
        ):
            GL.glTexParameteri(self.tex_type, name, value)
        if self._anisotropy > 1:
            GL.glTexParameterf(self.tex_type, ANISOTROPY, self._anisotropy)
        self._unbind()
        self._waiting = None


def _primitive(part: Part, material: Material) -> Any:
    """A part without textures yet. Unity's MetallicSmoothness becomes a texture (roughness, metallic), factors 1."""
    plain = material.metallic is None
    return pyrender.Primitive(
        positions=part.vertices,
        normals=part.normals,
        texcoord_0=part.uvs,
        indices=part.faces,
        material=pyrender.MetallicRoughnessMaterial(
            metallicFactor=0.0 if plain else 1.0,
            roughnessFactor=PLAIN_ROUGHNESS if plain else 1.0,
            alphaMode="OPAQUE",
            doubleSided=False,
        ),
    )


def _trilinear() -> Any:
    gltf = pyrender.GLTF
    return pyrender.Sampler(
        magFilter=gltf.LINEAR, minFilter=gltf.LINEAR_MIPMAP_LINEAR, wrapS=gltf.REPEAT, wrapT=gltf.REPEAT
    )


def _pixels(use: str, name: str, model: Model) -> Pixels:
    """A texture as the card wants it, (H, W, channels), row 0 on top: RGB, RGBA to cut out, roughness and metal."""
    if use == "albedo":
        texture, opacity = model.obj.textures[name], _opacity(model.obj.files[name])[1]
        if opacity is None or opacity.shape != texture.shape[:2]:
            return texture
        return np.dstack([texture, opacity])
    data = model.obj.files[name]
    return decode_rgb(data, name) if use == "normal" else _roughness_metallic(data, name)


@lru_cache(maxsize=32)
def _opacity(data: bytes) -> tuple[str, Pixels | None]:
    """What an albedo file cuts out of its surfaces, with a name for it (none for nothing)."""
    opacity = opacity_of(data)
    return ("", None) if opacity is None else (f" cut out by {content_key(opacity)}", opacity)


def _roughness_metallic(data: bytes, name: str) -> Pixels:
    """(H, W, 2) uint8 from a MetallicSmoothness file: 1 - alpha (smoothness), red."""
    with open_image(data, name) as image:
        smoothness = image.getchannel("A") if "A" in image.getbands() else None
        metallic = np.array(image.convert("RGB"))[..., 0]
    plain = np.full(metallic.shape, round(255 * PLAIN_ROUGHNESS), np.uint8)
    roughness = plain if smoothness is None else 255 - np.array(smoothness)
    return np.stack([roughness, metallic], axis=-1)
