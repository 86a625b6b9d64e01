"""A textured triangle in several formats."""

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trompe_server.formats import gltf_write, read_object
from trompe_server.formats.fbx_tree import Node, Tree
from trompe_server.formats.gltf_container import BIN_CHUNK
from trompe_shared.errors import ObjectError
from trompe_shared.local_files import pack_zip
from trompe_shared.object3d import Object3D, encode_png

Json = dict[str, Any]

PICTURE = encode_png(np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3))
OBJ = b"mtllib t.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl paint\nf 1/1 2/2 3/3\n"
CORNERS = struct.pack("<15f", 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 1, 1, 0, 0)
"""Positions, then texture coordinates."""


def triangle_zip(*, colour: tuple[int, int, int] = (200, 30, 30)) -> bytes:
    """The archive of an object, one textured triangle of a colour, as SAILenv wants it."""
    materials, picture = b'{"paint": {"albedo": "paint.png"}}', encode_png(np.full((8, 8, 3), colour, np.uint8))
    return pack_zip({"triangle.obj": TRIANGLE, "triangle_mat_def.json": materials, "paint.png": picture})


def gltf_json() -> Json:
    """The triangle as glTF, with positions, texture coordinates and picture in ``gltf_buffer``."""
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 2, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 24},
            {"buffer": 0, "byteOffset": 60, "byteLength": len(PICTURE)},
        ],
        "buffers": [{"byteLength": len(gltf_buffer())}],
    }


def gltf_buffer() -> bytes:
    """The buffer of ``gltf_json``."""
    return CORNERS + PICTURE


def gltf_files(picture: bytes = PICTURE, **changes: Any) -> dict[str, bytes]:
    """The triangle as glTF with buffer and picture in separate files, and ``changes`` to the JSON."""
    document = gltf_json()
    document |= {
        "images": [{"uri": "tex/t.png"}],
        "bufferViews": document["bufferViews"][:2],
        "buffers": [{"byteLength": len(CORNERS), "uri": "t.bin"}],
        **changes,
    }
    return {"t.gltf": json.dumps(document).encode(), "t.bin": CORNERS, "tex/t.png": picture}


def zipped(files: Mapping[str, bytes], *, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A zip as other programs make it."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def glb(document: Json | bytes, data: bytes | None = None) -> bytes:
    """A GLB of JSON and one buffer, by default ``gltf_buffer``."""
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    return gltf_write.glb(text, [(BIN_CHUNK, gltf_buffer() if data is None else data)])


def with_picture_inside(fbx: Tree, picture: bytes) -> bytes:
    """The FBX file with ``picture`` in its only video."""
    content = Node(b"Content", 1, b"R" + len(picture).to_bytes(4, "little") + picture, None)

    def filled(node: Node) -> Node:
        children = node.children or ()
        if node.name == b"Video":
            return replace(node, children=(*children, content))
        return replace(node, children=tuple(map(filled, children))) if node.name == b"Objects" else node

    return replace(fbx, nodes=tuple(map(filled, fbx.nodes))).to_bytes()


def large_png(width: int, height: int, *, chunks: tuple[tuple[bytes, bytes], ...] = (), data: bytes = b"") -> bytes:
    """A PNG file with that size in its header and, unless ``data`` is given, no pixels."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = (b"IDAT", data or zlib.compress(b""))
    file = b"\x89PNG\r\n\x1a\n"
    for kind, body in ((b"IHDR", header), *chunks, pixels, (b"IEND", b"")):
        file += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return file


def corners(obj: Object3D) -> np.ndarray:
    """Positions of all corners (F, 3, 3), part by part."""
    return np.concatenate([part.vertices[part.faces] for part in obj.parts])


def painted(obj: Object3D) -> Object3D:
    """``obj`` with every texel changed a little."""
    return obj.with_textures(
        {name: np.where(t > 127, t - 9, t + 9).astype(np.uint8) for name, t in obj.textures.items()}
    )


def same_paint(one: Object3D, other: Object3D) -> None:
    """Assert that two objects have the same triangles, texture coordinates and texels."""
    assert (corners(one) == corners(other)).all()
    for mine, theirs in zip(one.parts, other.parts, strict=True):
        np.testing.assert_allclose(mine.uvs[mine.faces], theirs.uvs[theirs.faces], atol=1e-7)
        assert (one.textures[one.albedo_of(mine)] == other.textures[other.albedo_of(theirs)]).all()


def refusal(data: bytes, name: str) -> str:
    """The message of the error that reading an upload raises."""
    with pytest.raises(ObjectError) as raised:
        read_object(data, name=name)
    return str(raised.value)
