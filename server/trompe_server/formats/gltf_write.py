"""Write any object as a GLB file with the look of SAILenv's renderers."""

import json
import struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.gltf_container import BIN_CHUNK, GLB_MAGIC, JSON_CHUNK
from trompe_shared.object3d import PLAIN_ROUGHNESS, Material, Object3D, encode_png, open_image, roughness_metallic
from trompe_shared.opacity import CUTOFF, opacity_of
from trompe_shared.wavefront import Part

TRILINEAR: Final = {"magFilter": 9729, "minFilter": 9987, "wrapS": 10497, "wrapT": 10497}

ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
FLOAT, UNSIGNED_INT = 5126, 5125

Json = dict[str, Any]


def write_glb(obj: Object3D) -> bytes:
    """``obj`` as GLB 2.0: one mesh, a primitive for each part, all images inside.

    ``extras.centre`` of its scene is the middle of the bounding sphere (x, y, z), metres, at which cameras look.
    """
    writer = _ObjectWriter(obj)
    document = writer.whole()
    return glb(json.dumps(document, separators=(",", ":")).encode(), [(BIN_CHUNK, bytes(writer.binary))])


def glb(text: bytes, chunks: list[tuple[int, bytes]]) -> bytes:
    """The GLB file of a JSON text and other chunks."""
    body = b"".join(_chunk(kind, data) for kind, data in [(JSON_CHUNK, text), *chunks])
    return GLB_MAGIC + struct.pack("<II", 2, 12 + len(body)) + body


def _chunk(kind: int, data: bytes) -> bytes:
    padded = data + (b" " if kind == JSON_CHUNK else b"\0") * (-len(data) % 4)
    return struct.pack("<II", len(padded), kind) + padded


class Writer:
    """The JSON of a glTF file, and the bytes of its first buffer."""

    def __init__(self, document: Json) -> None:
        self.document = document
        self.binary = bytearray()

    def add(self, kind: str, entry: Json) -> int:
        """Append to a list of the document; return the number of the new entry."""
        entries = self.document.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def add_view(self, data: bytes, entry: Json | None = None) -> int:
        """Add a buffer view of new bytes; return its number."""
        place = {"buffer": 0, "byteOffset": append(self.binary, data), "byteLength": len(data)}
        return self.add("bufferViews", place | (entry or {}))

    def add_accessor(self, values: NDArray[np.generic], entry: Json, *, target: int = ARRAY_BUFFER) -> int:
        """Add an accessor of ``values`` (count, components); return its number."""
        row = values.dtype.itemsize * values.shape[1]
        stride = row + -row % 4 if target == ARRAY_BUFFER else row
        rows = np.zeros((len(values), stride), np.uint8)
        rows[:, :row] = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), row)
        view = {"target": target} | ({"byteStride": stride} if stride != row else {})
        return self.add("accessors", entry | {"bufferView": self.add_view(rows.tobytes(), view), "count": len(values)})

    def add_corners(self, faces: NDArray[np.integer]) -> int:
        """Add an accessor of the vertices of triangles (F, 3); return its number."""
        kind = {"componentType": UNSIGNED_INT, "type": "SCALAR"}
        return self.add_accessor(faces.reshape(-1, 1).astype("<u4"), kind, target=ELEMENT_ARRAY_BUFFER)

    def add_uvs(self, uvs: NDArray[np.floating]) -> int:
        """Add an accessor of texture coordinates (V, 2), v upwards; return its number."""
        flipped = np.stack([uvs[:, 0], 1 - uvs[:, 1]], axis=1).astype("<f4")
        return self.add_accessor(flipped, {"componentType": FLOAT, "type": "VEC2"})


def append(binary: bytearray, data: bytes) -> int:
    """Append ``data`` at the next multiple of 4 bytes; return the place."""
    binary += bytes(-len(binary) % 4)
    binary += data
    return len(binary) - len(data)


class _ObjectWriter(Writer):
    def __init__(self, obj: Object3D) -> None:
        super().__init__({kind: [] for kind in ("accessors", "bufferViews", "images", "textures", "materials")})
        self._obj = obj
        self._textures: dict[str, int] = {}

    def whole(self) -> Json:
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
            **self.document,
            "buffers": [{"byteLength": len(self.binary)}],
        }

    def _primitive(self, part: Part) -> Json:
        bounds = {"min": part.vertices.min(axis=0).tolist(), "max": part.vertices.max(axis=0).tolist()}
        triple = {"componentType": FLOAT, "type": "VEC3"}
        return {
            "attributes": {
                "POSITION": self.add_accessor(part.vertices.astype("<f4"), triple | bounds),
                "NORMAL": self.add_accessor(part.normals.astype("<f4"), triple),
                "TEXCOORD_0": self.add_uvs(part.uvs),
            },
            "indices": self.add_corners(part.faces),
        }

    def _material(self, material: Material) -> int:
        files = self._obj.files
        pbr: Json = {"baseColorTexture": {"index": self._texture(material.albedo, files[material.albedo])}}
        if material.metallic is None:
            pbr |= {"metallicFactor": 0.0, "roughnessFactor": PLAIN_ROUGHNESS}
        else:
            maps = roughness_metallic(files[material.metallic], material.metallic)  # glTF's green and blue
            converted = encode_png(np.dstack([np.full(maps.shape[:2], 255, np.uint8), maps]))
            pbr["metallicRoughnessTexture"] = {"index": self._texture(f"{material.metallic} as glTF", converted)}
        entry: Json = {"name": material.name, "pbrMetallicRoughness": pbr}
        if material.normal is not None:
            entry["normalTexture"] = {"index": self._texture(material.normal, files[material.normal])}
        if material.opacity is not None:
            entry["alphaMode"] = "BLEND"
            pbr["baseColorFactor"] = [1.0, 1.0, 1.0, material.opacity]
        elif opacity_of(files[material.albedo]) is not None:
            entry |= {"alphaMode": "MASK", "alphaCutoff": CUTOFF}
        return self.add("materials", entry)

    def _texture(self, name: str, data: bytes) -> int:
        if name not in self._textures:
            data, kind = _portable(data, name)
            view = self.add_view(data)
            image = self.add("images", {"bufferView": view, "mimeType": kind, "name": name.rsplit(".", 1)[0]})
            self._textures[name] = self.add("textures", {"sampler": 0, "source": image})
        return self._textures[name]


def _portable(data: bytes, name: str) -> tuple[bytes, str]:
    """(Image file in an encoding of glTF, its MIME type)."""
    with open_image(data, name) as image:
        if image.format in {"PNG", "JPEG"}:
            return data, f"image/{image.format.lower()}"
        return encode_png(image.convert("RGBA" if image.has_transparency_data else "RGB")), "image/png"
