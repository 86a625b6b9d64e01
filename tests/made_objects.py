"""Objects made by script, each awkward in one way: GLB files as people bring them."""

import json
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trompe_server.formats import read_object
from trompe_server.formats.gltf_container import BIN_CHUNK
from trompe_server.formats.gltf_write import glb
from trompe_shared.object3d import Object3D, encode_png, load_object
from trompe_shared.shipped import shipped_objects

Json = dict[str, Any]
Pixels = NDArray[np.uint8]
Triple = tuple[float, float, float]

SQUARE: Final = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], "<f4")
UVS: Final = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4")
CORNERS: Final = np.array([0, 1, 2, 0, 2, 3], "<u2")


class Scene:
    """A glTF being written; tests add to it. Its first mesh is shown."""

    def __init__(self) -> None:
        self.data = b""
        self.document: Json = {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}

    def add(self, kind: str, entry: Json) -> int:
        self.document.setdefault(kind, []).append(entry)
        return len(self.document[kind]) - 1

    def view(self, data: bytes) -> int:
        self.data += bytes(-len(self.data) % 4)
        start = len(self.data)
        self.data += data
        return self.add("bufferViews", {"buffer": 0, "byteOffset": start, "byteLength": len(data)})

    def accessor(self, values: NDArray[Any], **more: Any) -> int:
        kinds = {"f": 5126, "H": 5123, "B": 5121, "I": 5125, "h": 5122}
        width = 1 if values.ndim == 1 else values.shape[1]
        kind = {"componentType": kinds[values.dtype.char], "type": ("SCALAR", "VEC2", "VEC3", "VEC4")[width - 1]}
        return self.add("accessors", kind | {"count": len(values), "bufferView": self.view(values.tobytes())} | more)

    def image(self, picture: Pixels) -> int:
        return self.add("images", {"bufferView": self.view(encode_png(picture)), "mimeType": "image/png"})

    def texture(self, picture: Pixels) -> int:
        return self.add("textures", {"source": self.image(picture)})

    def material(self, texture: int | None = None, *, factor: list[float] | None = None, **more: Any) -> int:
        pbr: Json = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
        if texture is not None:
            pbr["baseColorTexture"] = {"index": texture}
        if factor is not None:
            pbr["baseColorFactor"] = factor
        return self.add("materials", {"pbrMetallicRoughness": pbr, **more})

    def square(self, material: int | None, *, uvs: NDArray[Any] | None = UVS, **attributes: int) -> int:
        """A mesh of one primitive, of two metres a side."""
        normals = np.tile(np.array([0, 0, 1], "<f4"), (4, 1))
        return self.mesh(SQUARE, CORNERS, uvs, material, NORMAL=self.accessor(normals), **attributes)

    def mesh(
        self,
        positions: NDArray[Any],
        corners: NDArray[Any],
        uvs: NDArray[Any] | None,
        material: int | None,
        **attributes: int,
    ) -> int:
        """A mesh of one primitive, flat if ``attributes`` (accessors by name) has no normals."""
        found = {"POSITION": self.accessor(positions)}
        if uvs is not None:
            found["TEXCOORD_0"] = self.accessor(uvs)
        primitive: Json = {"attributes": found | attributes, "indices": self.accessor(corners)}
        if material is not None:
            primitive["material"] = material
        return self.add("meshes", {"primitives": [primitive]})

    def to_glb(self) -> bytes:
        document = self.document | {"buffers": [{"byteLength": len(self.data)}]}
        return glb(json.dumps(document).encode(), [(BIN_CHUNK, self.data)])


def read(data: bytes | Scene) -> Object3D:
    """The object in a GLB file or a scene."""
    return read_object(data.to_glb() if isinstance(data, Scene) else data, name="scene.glb").obj


Mesh = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
"""Positions (V, 3), corners (3 F,) and texture coordinates (V, 2)."""


def sheet(low: Triple, high: Triple) -> Mesh:
    """An upright rectangle that faces the viewer (+z), textured once."""
    (left, bottom, z), (right, top, _) = low, high
    return np.array([[left, bottom, z], [right, bottom, z], [right, top, z], [left, top, z]], "<f4"), CORNERS, UVS


def box(low: Triple, high: Triple) -> Mesh:
    """A box, each side textured once."""
    sides = []
    for axis, outwards in ((axis, outwards) for axis in range(3) for outwards in (False, True)):
        side = np.zeros((4, 3))
        side[:, axis] = outwards
        side[:, [(axis + 1) % 3, (axis + 2) % 3]] = [[0, 0], [1, 0], [1, 1], [0, 1]]
        sides.append(side if outwards else side[::-1])
    positions = np.array(low) + np.concatenate(sides) * (np.array(high) - low)
    corners = np.concatenate([CORNERS + 4 * k for k in range(6)])
    return positions.astype("<f4"), corners.astype("<u2"), np.tile(UVS, (6, 1))


def flat(colour: Triple, alpha: Pixels) -> Pixels:
    """A picture (H, W, 4) of one colour, in [0, 255], with ``alpha`` (H, W)."""
    return np.dstack([np.broadcast_to(np.array(colour, np.uint8), (*alpha.shape, 3)), alpha])


CANDLE, GLASS, LATTICE, FLAG = (230, 200, 40), (40, 60, 220), (30, 160, 60), (200, 40, 120)
"""Colours of the lantern, sRGB."""


def lantern(*, opacity: float = 0.4) -> bytes:
    """A candle (opaque, whatever its alpha) inside a box of glass (blended), under a lattice (masked), with a flag.

    All but the candle are double-sided. 0.4 m tall; the lattice has a hole of half its size.
    """
    scene = Scene()
    solid, hole = np.full((64, 64), 255, np.uint8), np.full((64, 64), 255, np.uint8)
    hole[16:48, 16:48] = 40
    both: Json = {"doubleSided": True}
    blended = both | {"alphaMode": "BLEND", "factor": [1.0, 1.0, 1.0, opacity]}
    masked = both | {"alphaMode": "MASK", "alphaCutoff": 0.3}
    for name, mesh, picture, options in (
        ("candle", box((-0.04, -0.09, -0.04), (0.04, 0.06, 0.04)), flat(CANDLE, solid // 9), {}),
        ("glass", box((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1)), flat(GLASS, solid), blended),
        ("lattice", sheet((-0.1, 0.1, 0.0), (0.1, 0.3, 0.0)), flat(LATTICE, hole), masked),
        ("flag", sheet((0.1, -0.05, 0.0), (0.2, 0.05, 0.0)), flat(FLAG, solid), both),
    ):
        number = scene.mesh(*mesh, scene.material(scene.texture(picture), name=name, **options))
        if number:
            scene.document["nodes"].append({"mesh": number})
            scene.document["scenes"][0]["nodes"].append(number)
    return scene.to_glb()


def copy_of(
    name: str, *, scale: float = 1.0, offset: Triple = (0, 0, 0), side: int | None = None, pieces: int = 1
) -> bytes:
    """A shipped object, scaled and then moved by ``offset`` metres, in ``pieces`` with a material each.

    side: of its textures, in texels; 0 for colours without textures.
    """
    obj, scene, numbers = load_object(shipped_objects()[name].path), Scene(), []
    for part in obj.parts:
        picture = Image.fromarray(obj.textures[obj.albedo_of(part)])
        colour = [*(np.array(picture).mean((0, 1)) / 255).tolist(), 1.0]
        for faces in np.array_split(part.faces, pieces):
            used, corners = np.unique(faces, return_inverse=True)
            sized = picture if side is None else picture.resize((max(side, 1),) * 2)
            material = scene.material(factor=colour) if side == 0 else scene.material(scene.texture(np.array(sized)))
            positions = (part.vertices[used] * scale + np.array(offset)).astype("<f4")
            uvs = np.stack([part.uvs[used, 0], 1 - part.uvs[used, 1]], 1).astype("<f4")
            normals = scene.accessor(part.normals[used].astype("<f4"))
            numbers.append(scene.mesh(positions, corners.ravel().astype("<u4"), uvs, material, NORMAL=normals))
    scene.document["nodes"] = [{"mesh": number} for number in numbers]
    scene.document["scenes"] = [{"nodes": list(range(len(numbers)))}]
    return scene.to_glb()
