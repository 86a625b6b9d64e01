"""Read the scene of a glTF or GLB file as an object.

Each distinct (image, colour factor, treatment of alpha) becomes one albedo texture. Equal materials share their texels;
an image with two factors becomes two textures, because an attack paints them differently.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.assembly import assemble, flat_picture, free_name, safe_name
from trompe_server.formats.gltf_container import Container, at, open_container
from trompe_server.formats.gltf_schema import Material, TextureInfo
from trompe_server.formats.gltf_shapes import Instance, Shape, instances, placed, read_shape
from trompe_server.formats.pictures import cutout_alpha, metallic_smoothness, scaled_normals, tinted
from trompe_server.formats.unwrap import Unwrapped, bake, laid_out, unwrap
from trompe_server.formats.upload import Upload
from trompe_shared.errors import ObjectError
from trompe_shared.local_files import base_name
from trompe_shared.object3d import PLAIN_ROUGHNESS, Object3D, decode_alpha, decode_rgb, encode_png, with_alpha_of
from trompe_shared.object3d import Material as Maps
from trompe_shared.wavefront import Part

Key = tuple[int, int]
"""(Number of a mesh, number of one of its primitives)."""
KEPT: tuple[float, float] = (1.0, 0.5)
"""Factor and cutoff that leave alpha unchanged."""
PLAIN: tuple[float, float] = (0.0, PLAIN_ROUGHNESS)
"""Metallic and roughness of SAILenv's materials without a map."""


@dataclass(frozen=True)
class Slot:
    """An albedo texture: its image (``None``: a flat colour) and the changes to it.

    factor: linear. alpha: (factor, cutoff) for cut-out materials, ``KEPT`` for blended ones. unwrapped: the material
    (-1: none) of the primitives that get their texture coordinates here.
    """

    image: int | None
    factor: tuple[float, float, float]
    alpha: tuple[float, float] | None
    unwrapped: int | None = None


@dataclass
class Model:
    """A glTF file as an object, with the origin of each texture and part."""

    container: Container
    files: dict[str, bytes] = field(default_factory=dict)
    slots: dict[Slot, str] = field(default_factory=dict)
    """File name of each slot's texture."""
    users: dict[Slot, set[int | None]] = field(default_factory=dict)
    """The glTF materials of each slot."""
    shapes: dict[Key, Shape] = field(default_factory=dict)
    materials: dict[str, Maps] = field(default_factory=dict)
    parts: list[Part] = field(default_factory=list)
    _names: dict[tuple[int | None, bool], str] = field(default_factory=dict)
    _converted: dict[tuple[object, ...], str] = field(default_factory=dict)

    def object(self) -> Object3D:
        """The object. Raises ``ObjectError``."""
        return assemble(safe_name(self.container.upload.stem), self.parts, self.materials, self.files)

    def add(self) -> None:
        """Read all meshes of the scene."""
        standing = list(instances(self.container))
        for mesh in dict.fromkeys(instance.mesh for instance in standing):
            numbered = enumerate(at(self.container.document.meshes, mesh, "mesh").primitives)
            self.shapes |= {(mesh, k): read_shape(self.container, each) for k, each in numbered if each.mode >= 4}
        self._unwrap()
        for shape in self.shapes.values():
            self._paint(shape)
        for instance in standing:
            own = (shape for (mesh, _), shape in self.shapes.items() if mesh == instance.mesh)
            self.parts += [part for shape in own for part in self._place(shape, instance)]

    def _unwrap(self) -> None:
        """Unwrap the shapes without texture coordinates; those of one material share a texture."""
        needy: dict[int | None, list[Key]] = {}
        for key, shape in self.shapes.items():
            if _needs_unwrapping(shape, self.container.material(shape.material)):
                needy.setdefault(shape.material, []).append(key)
        for index, keys in needy.items():
            shapes = [self.shapes[key] for key in keys]
            cuts, size = unwrap([(shape.vertices, shape.faces) for shape in shapes])
            self.shapes |= {key: replace(s, cut=cut) for key, s, cut in zip(keys, shapes, cuts, strict=True)}
            self._add_baked(index, list(zip(shapes, cuts, strict=True)), size)

    def _add_baked(self, index: int | None, pieces: list[tuple[Shape, Unwrapped]], size: tuple[int, int]) -> None:
        slot = self._slot(index, unwrapped=True)
        if any(shape.colours is not None for shape, _ in pieces):
            picture = bake([(cut, (_colours(shape) * slot.factor)[cut.source]) for shape, cut in pieces], size=size)
        else:
            picture = flat_picture(slot.factor, size)
        self.slots[slot] = self._new_file(f"{self._material_name(index)}_albedo.png", _albedo_png(picture, None, slot))

    def _slot(self, index: int | None, *, unwrapped: bool) -> Slot:
        material = self.container.material(index)
        red, green, blue, opacity = material.pbr.base_color_factor
        alpha = {"OPAQUE": None, "MASK": (opacity, material.alpha_cutoff), "BLEND": KEPT}[material.alpha_mode]
        info = material.pbr.base_color_texture
        image = None if info is None else self._image_of(info)
        if unwrapped:
            return Slot(None, (red, green, blue), alpha, -1 if index is None else index)
        return Slot(image, (red, green, blue), alpha)

    def _image_of(self, info: TextureInfo) -> int:
        image = at(self.container.document.textures, info.index, "texture").image
        if image is None:
            raise ObjectError(f"Texture {info.index} of the glTF has no supported image; use PNG, JPEG or WebP.")
        return image

    def _paint(self, shape: Shape) -> None:
        """Add the material of ``shape`` with its textures."""
        slot = self._slot(shape.material, unwrapped=shape.cut is not None)
        self.users.setdefault(slot, set()).add(shape.material)
        if slot not in self.slots:
            self.slots[slot] = self._add_albedo(slot, self._material_name(shape.material))
        key = shape.material, shape.cut is not None
        if key not in self._names:
            wanted = self._material_name(shape.material) + ("_unwrapped" if key[1] else "")
            self._names[key] = free_name(wanted, self._names.values())
            material = self.container.material(shape.material)
            opacity = material.pbr.base_color_factor[3] if material.alpha_mode == "BLEND" else None
            maps = self._names[key], self.slots[slot], self._normal(material), self._metallic(material)
            self.materials[self._names[key]] = Maps(*maps, opacity)

    def _material_name(self, index: int | None) -> str:
        default = "default" if index is None else f"material_{index}"
        return safe_name(self.container.material(index).name or default, default=default)

    def _add_albedo(self, slot: Slot, material: str) -> str:
        if slot.image is None:
            return self._new_file(f"{material}_albedo.png", _albedo_png(flat_picture(slot.factor), None, slot))
        data = self.container.image_bytes(slot.image)
        name = self._new_file(f"{self._image_name(slot.image)}.png", data)
        rgb, alpha = decode_rgb(data, name), decode_alpha(data, name)
        if not _kept_as_is(slot, data, alpha is not None):
            self.files[name] = _albedo_png(tinted(rgb, slot.factor), alpha, slot)
        return name

    def _new_file(self, wanted: str, data: bytes) -> str:
        name = free_name(wanted, self.files)
        self.files[name] = data
        return name

    def _image_name(self, index: int) -> str:
        image = at(self.container.document.images, index, "image")
        uri = image.uri if image.uri is not None and not image.uri.startswith("data:") else None
        return safe_name(image.name or base_name(uri or "").rsplit(".", 1)[0], default=f"image_{index}")

    def _normal(self, material: Material) -> str | None:
        info = material.normal_texture
        if info is None:
            return None
        image = self._image_of(info)
        key = ("normal", image, info.scale)
        if key not in self._converted:
            data = self.container.image_bytes(image)
            rgb = decode_rgb(data, f"{self._image_name(image)} (a normal map)")
            scaled = scaled_normals(rgb, info.scale)
            ending = _ending(data) if scaled is rgb else None
            kept = data if ending is not None else encode_png(scaled)
            self._converted[key] = self._new_file(f"{self._image_name(image)}.{ending or 'png'}", kept)
        return self._converted[key]

    def _metallic(self, material: Material) -> str | None:
        pbr = material.pbr
        factors = pbr.metallic_factor, pbr.roughness_factor
        info = pbr.metallic_roughness_texture
        image = None if info is None else self._image_of(info)
        if image is None and factors == PLAIN:
            return None
        key = ("metallic", image, *factors)
        if key not in self._converted:
            pixels = np.full((1, 1, 3), 255, np.uint8)
            if image is not None:
                pixels = decode_rgb(self.container.image_bytes(image), "metallic map")
            converted = metallic_smoothness(pixels, metallic=factors[0], roughness=factors[1])
            flat = f"{safe_name(material.name or 'material')}_metallic"
            stem = flat if image is None else self._image_name(image)
            self._converted[key] = self._new_file(f"{stem}.png", encode_png(converted))
        return self._converted[key]

    def _place(self, shape: Shape, instance: Instance) -> tuple[Part, ...]:
        """The shape at the place of an instance; both sides if the material is double-sided."""
        part = placed(shape, instance, self._names[shape.material, shape.cut is not None])
        if not self.container.material(shape.material).double_sided:
            return (part,)
        return part, replace(part, normals=-part.normals, faces=np.ascontiguousarray(part.faces[:, ::-1]))


def read(upload: Upload) -> Object3D:
    """Read a .gltf or .glb file. Raises ``ObjectError``."""
    return load(upload).object()


def load(upload: Upload) -> Model:
    """As ``read``, with the origin of textures and parts."""
    model = Model(open_container(upload))
    model.add()
    if not model.parts:
        raise ObjectError("The glTF's scene has no triangles; export a scene with a mesh.")
    return model


def _colours(shape: Shape) -> NDArray[np.float64]:
    return np.ones((len(shape.vertices), 3)) if shape.colours is None else shape.colours


def _needs_unwrapping(shape: Shape, material: Material) -> bool:
    if shape.colours is not None and material.maps:
        raise ObjectError(
            f"Material {material.name or shape.material!r} has textures and vertex colours; bake them into its base "
            "colour texture."
        )
    return shape.colours is not None or not (material.maps or laid_out(shape.uvs, shape.faces))


def _ending(data: bytes) -> str | None:
    """File name ending of a PNG or JPEG; ``None`` for other encodings."""
    return "png" if data[:4] == b"\x89PNG" else "jpg" if data[:3] == b"\xff\xd8\xff" else None


def _kept_as_is(slot: Slot, data: bytes, has_alpha: bool) -> bool:
    """Whether an image file can serve unchanged."""
    alpha_fits = not has_alpha if slot.alpha is None else slot.alpha == KEPT
    return _ending(data) == "png" and slot.factor == (1.0, 1.0, 1.0) and alpha_fits


def _albedo_png(rgb: NDArray[np.uint8], alpha: NDArray[np.uint8] | None, slot: Slot) -> bytes:
    if slot.alpha is None:
        return encode_png(rgb)
    factor, cutoff = slot.alpha
    opaque = np.full(rgb.shape[:2], 255, np.uint8)
    return with_alpha_of(rgb, cutout_alpha(opaque if alpha is None else alpha, factor=factor, cutoff=cutoff))
