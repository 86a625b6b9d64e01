"""Write any object as a GLB file with the look of SAILenv's renderers."""

import json
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.gltf_container import BIN_CHUNK
from trompe_server.formats.gltf_repaint import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, FLOAT, UNSIGNED_INT, glb
from trompe_shared.object3d import Material, Object3D, encode_png, open_image
from trompe_shared.opacity import CUTOFF, opacity_of
from trompe_shared.wavefront import Part

PLAIN_ROUGHNESS: Final = 0.9
"""Roughness of materials without a map in SAILenv's renderers."""
TRILINEAR: Final = {"magFilter": 9729, "minFilter": 9987, "wrapS": 10497, "wrapT": 10497}

Json = dict[str, Any]


def write_glb(obj: Object3D) -> bytes:
    """``obj`` as GLB 2.0: one mesh, a primitive for each part, all images inside.

    ``extras.centre`` of its scene is the middle of the bounding sphere (x, y, z), metres, at which cameras look.
    """
    writer = _Writer(obj)
    document = writer.document()
    return glb(json.dumps(document, separators=(",", ":")).encode(), [(BIN_CHUNK, bytes(writer.binary))])


class _Writer:
    def __init__(self, obj: Object3D) -> None:
        self._obj = obj
        self.binary = bytearray()
        self._lists: dict[str, list[Json]] = {
            kind: [] for kind in ("accessors", "bufferViews", "images", "textures", "materials")
        }
        self._textures: dict[str, int] = {}

    def document(self) -> Json:
        """The JSON; fills ``binary``."""
        materials = {name: self._material(material) for name, material in self._obj.materials.items()}
        primitives = [self._primitive(part) | {"material": materials[part.material]} for part in self._obj.parts]
        return {
            "asset": {"version": "2.0", "generator": "trompe"},
            "scene": 0,
            "scenes": [{"nodes": [0], "extras": {"centre": self._obj.sphere[0]}}],
            "nodes": [{"mesh": 0, "name": self._obj.name}],
            "meshes": [{"name": self._obj.name, "primitives": primitives}],
            "samplers": [TRILINEAR],
            **self._lists,
            "buffers": [{"byteLength": len(self.binary)}],
        }

    def _add(self, kind: str, entry: Json) -> int:
        self._lists[kind].append(entry)
        return len(self._lists[kind]) - 1

    def _view(self, data: bytes, entry: Json) -> int:
        self.binary += bytes(-len(self.binary) % 4)
        start = len(self.binary)
        self.binary += data
        return self._add("bufferViews", {"buffer": 0, "byteOffset": start, "byteLength": len(data)} | entry)

    def _accessor(self, values: NDArray[np.generic], entry: Json, *, target: int = ARRAY_BUFFER) -> int:
        view = self._view(np.ascontiguousarray(values).tobytes(), {"target": target})
        return self._add("accessors", entry | {"bufferView": view, "count": len(values)})

    def _primitive(self, part: Part) -> Json:
        uvs = np.stack([part.uvs[:, 0], 1 - part.uvs[:, 1]], axis=1)
        bounds = {"min": part.vertices.min(axis=0).tolist(), "max": part.vertices.max(axis=0).tolist()}
        triple = {"componentType": FLOAT, "type": "VEC3"}
        return {
            "attributes": {
                "POSITION": self._accessor(part.vertices.astype("<f4"), triple | bounds),
                "NORMAL": self._accessor(part.normals.astype("<f4"), triple),
                "TEXCOORD_0": self._accessor(uvs.astype("<f4"), {"componentType": FLOAT, "type": "VEC2"}),
            },
            "indices": self._accessor(
                part.faces.reshape(-1).astype("<u4"),
                {"componentType": UNSIGNED_INT, "type": "SCALAR"},
                target=ELEMENT_ARRAY_BUFFER,
            ),
        }

    def _material(self, material: Material) -> int:
        files = self._obj.files
        pbr: Json = {"baseColorTexture": {"index": self._texture(material.albedo, files[material.albedo])}}
        if material.metallic is None:
            pbr |= {"metallicFactor": 0.0, "roughnessFactor": PLAIN_ROUGHNESS}
        else:
            converted = _metallic_roughness(files[material.metallic], material.metallic)
            pbr["metallicRoughnessTexture"] = {"index": self._texture(f"{material.metallic} as glTF", converted)}
        entry: Json = {"name": material.name, "pbrMetallicRoughness": pbr}
        if material.normal is not None:
            entry["normalTexture"] = {"index": self._texture(material.normal, files[material.normal])}
        if material.opacity is not None:
            entry["alphaMode"] = "BLEND"
            pbr["baseColorFactor"] = [1.0, 1.0, 1.0, material.opacity]
        elif opacity_of(files[material.albedo]) is not None:
            entry |= {"alphaMode": "MASK", "alphaCutoff": CUTOFF}
        return self._add("materials", entry)

    def _texture(self, name: str, data: bytes) -> int:
        if name not in self._textures:
            data, kind = _portable(data, name)
            view = self._view(data, {})
            image = self._add("images", {"bufferView": view, "mimeType": kind, "name": name.rsplit(".", 1)[0]})
            self._textures[name] = self._add("textures", {"sampler": 0, "source": image})
        return self._textures[name]


def _portable(data: bytes, name: str) -> tuple[bytes, str]:
    """(Image file in an encoding of glTF, its MIME type)."""
    with open_image(data, name) as image:
        if image.format in {"PNG", "JPEG"}:
            return data, f"image/{image.format.lower()}"
        return encode_png(image.convert("RGBA" if image.has_transparency_data else "RGB")), "image/png"


def _metallic_roughness(data: bytes, name: str) -> bytes:
    """glTF's map, green roughness and blue metallic, from Unity's, red metallic and alpha smoothness."""
    with open_image(data, name) as image:
        smoothness = np.array(image.getchannel("A")) if "A" in image.getbands() else None
        metallic = np.array(image.convert("RGB"))[..., 0]
    plain = np.full(metallic.shape, round(255 * PLAIN_ROUGHNESS), np.uint8)
    roughness = plain if smoothness is None else 255 - smoothness
    return encode_png(np.stack([np.full_like(metallic, 255), roughness, metallic], axis=-1))
