"""Pictures come in at many doors; each takes textures' kinds of files only, and looks at their sides before decoding.

Pillow can read some 40 formats, some by starting other programs. A file is what its bytes say, whatever it is called.
"""

import io
import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from trompe_server.formats import read_object
from trompe_server.formats.gltf_write import write_glb
from trompe_server.library import Library
from trompe_server.target import SailenvTarget
from trompe_server.target.sailenv import _picture
from trompe_shared.errors import ObjectError, ProtocolError, RendererError, SpecError, TrompeError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D, encode_png, load_object, object_from_files, pack_zip
from trompe_shared.opacity import opacity_of

SIDE = 8
GOOD = encode_png(np.zeros((SIDE, SIDE, 3), np.uint8))
OBJ = b"mtllib t.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
TABLE = {"m": {"albedo": "albedo.png", "normal": "normal.png", "metallic": "metallic.png"}}


def saved(kind: str) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (SIDE, SIDE)).save(buffer, kind)
    return buffer.getvalue()


def psd() -> bytes:
    head = b"8BPS" + struct.pack(">H6xHIIHH", 1, 3, SIDE, SIDE, 8, 3)
    return head + bytes(12) + struct.pack(">H", 0) + bytes(3 * SIDE * SIDE)


def fits() -> bytes:
    cards = {"SIMPLE": "T", "BITPIX": "8", "NAXIS": "2", "NAXIS1": str(SIDE), "NAXIS2": str(SIDE)}
    lines = [f"{name:8}= {value:>20}" for name, value in cards.items()] + ["END"]
    return "".join(f"{line:80}" for line in lines).encode().ljust(2880) + bytes(2880)


def large_png(width: int, height: int) -> bytes:
    """The file says that it is so large; there are no pixels in it."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n"
    for kind, body in ((b"IHDR", header), (b"IDAT", zlib.compress(b"")), (b"IEND", b"")):
        data += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return data


OTHER_FORMATS = {
    "EPS": lambda: saved("EPS"),
    "PSD": psd,
    "FITS": fits,
    "PPM": lambda: saved("PPM"),
    "PCX": lambda: saved("PCX"),
    "ICNS": lambda: saved("ICNS"),
}
PICTURES = [
    *[pytest.param(make, "cannot be read", id=kind) for kind, make in OTHER_FORMATS.items()],
    pytest.param(lambda: large_png(8193, 1), "8192", id="too wide"),
    pytest.param(lambda: large_png(30_000, 30_000), "8192", id="900 million pixels"),
]


def archive(**pictures: bytes) -> dict[str, bytes]:
    """The files of a triangle with all maps, some of them replaced."""
    maps = dict.fromkeys(("albedo", "normal", "metallic"), GOOD) | pictures
    table = json.dumps(TABLE).encode()
    return {"t.obj": OBJ, "t_mat_def.json": table} | {f"{name}.png": data for name, data in maps.items()}


def smuggled(**pictures: bytes) -> Object3D:
    """An object that was read while its files were good, as if somebody had exchanged them since."""
    return replace(object_from_files(archive()), files=archive(**pictures))


def from_gltf(data: bytes) -> None:
    triangle = struct.pack("<15f", 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 1, 1, 0, 0)
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": "t.png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}],
        "buffers": [{"byteLength": len(triangle), "uri": "t.bin"}],
    }
    read_object(pack_zip({"t.gltf": json.dumps(document).encode(), "t.bin": triangle, "t.png": data}), name="t.zip")


def from_mtl(data: bytes) -> None:
    files = {"t.obj": OBJ, "t.mtl": b"newmtl m\nmap_Kd albedo.png\n", "albedo.png": data}
    read_object(pack_zip(files), name="t.zip")


DOORS: dict[str, tuple[type[TrompeError], Callable[[bytes], object]]] = {
    "an albedo map": (ObjectError, lambda data: load_object(pack_zip(archive(albedo=data)))),
    "a normal map": (ObjectError, lambda data: load_object(pack_zip(archive(normal=data)))),
    "a metallic map": (ObjectError, lambda data: load_object(pack_zip(archive(metallic=data)))),
    "a texture of an MTL": (ObjectError, from_mtl),
    "a texture of a glTF": (ObjectError, from_gltf),
    "what alpha is read from": (ObjectError, opacity_of),
    "what is painted over": (
        ObjectError,
        lambda data: smuggled(albedo=data).with_textures({"albedo.png": np.zeros((SIDE, SIDE, 3), np.uint8)}),
    ),
    "what is written as GLB": (ObjectError, lambda data: write_glb(smuggled(metallic=data))),
    "a view that a renderer shows": (ProtocolError, lambda data: _picture(data, (SIDE, SIDE))),
    "a background or mask": (SpecError, lambda data: Library(Path("/nowhere")).add_background(data, "t.png")),
}


@pytest.mark.parametrize("door", DOORS)
def test_every_door_takes_a_picture_of_the_kinds_that_are_read(door: str, tmp_path: Path) -> None:
    if door != "a background or mask":
        DOORS[door][1](GOOD)
    else:
        Library(tmp_path).add_background(GOOD, "t.png")


@pytest.mark.parametrize("kind", OTHER_FORMATS)
def test_pillow_by_itself_would_open_it(kind: str) -> None:
    with Image.open(io.BytesIO(OTHER_FORMATS[kind]())) as picture:
        assert picture.format == kind


@pytest.mark.parametrize(("make", "words"), PICTURES)
@pytest.mark.parametrize("door", DOORS)
def test_no_door_takes_it(door: str, make: Callable[[], bytes], words: str) -> None:
    error, enter = DOORS[door]
    with pytest.raises(error) as raised:
        enter(make())
    assert words in f"{raised.value} {raised.value.__cause__}"


@pytest.mark.parametrize("name", ["albedo", "normal", "metallic"])
def test_a_renderer_refuses_it_and_goes_on(target: SailenvTarget, name: str) -> None:
    view = View(Camera(2.0, 0.0, 0.0))
    for make in OTHER_FORMATS.values():
        with pytest.raises(RendererError, match="cannot be read as an image"):
            target.render(smuggled(**{name: make()}), [view], size=(SIDE, SIDE))
    assert target.render(smuggled(), [view], size=(SIDE, SIDE)).shape == (1, SIDE, SIDE, 3)
