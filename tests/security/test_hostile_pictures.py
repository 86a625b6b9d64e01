"""Pictures come in at many doors; each takes textures' kinds of files only, and looks at their sides before decoding.

Pillow can read some 40 formats, some by starting other programs. A file is what its bytes say, whatever it is called.
"""

import io
import json
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.small_models import OBJ, gltf_files, large_png, with_picture_inside
from trompe_server.formats import read_object
from trompe_server.formats.fbx_tree import Tree, parse_tree
from trompe_server.formats.gltf_write import write_glb
from trompe_server.library import Library
from trompe_server.renderers import SailenvTarget
from trompe_shared.errors import ObjectError, ProtocolError, RendererError, SpecError, TrompeError
from trompe_shared.geometry import Camera, View
from trompe_shared.local_files import pack_zip
from trompe_shared.object3d import Object3D, encode_png, load_object, object_from_files
from trompe_shared.opacity import opacity_of
from trompe_shared.sailenv_client import _picture

SIDE = 8
GOOD = encode_png(np.zeros((SIDE, SIDE, 3), np.uint8))
MTL = b"newmtl m\nmap_Kd albedo.png\n"
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


OTHER_FORMATS: dict[str, Callable[[], bytes]] = {
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


@cache
def fbx() -> Tree:
    """The triangle as assimp writes it, without its picture. Written anew, for assimp cannot read its own file."""
    if shutil.which("assimp") is None:
        pytest.skip("assimp-utils is not installed")
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "t.obj").write_bytes(OBJ)
        Path(folder, "t.mtl").write_bytes(MTL)
        command = ["assimp", "export", "t.obj", "t.fbx", "-ffbx"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        return parse_tree(Path(folder, "t.fbx").read_bytes())


def read(files: dict[str, bytes]) -> None:
    read_object(pack_zip(files), name="t.zip")


DOORS: dict[str, tuple[type[TrompeError], Callable[[bytes], object]]] = {
    "an albedo map": (ObjectError, lambda data: load_object(pack_zip(archive(albedo=data)))),
    "a normal map": (ObjectError, lambda data: load_object(pack_zip(archive(normal=data)))),
    "a metallic map": (ObjectError, lambda data: load_object(pack_zip(archive(metallic=data)))),
    "a texture of an MTL": (ObjectError, lambda data: read({"t.obj": OBJ, "t.mtl": MTL, "albedo.png": data})),
    "a texture of a glTF": (ObjectError, lambda data: read(gltf_files(data))),
    "a texture beside an FBX": (ObjectError, lambda data: read({"t.fbx": fbx().to_bytes(), "albedo.png": data})),
    "a texture inside an FBX": (ObjectError, lambda data: read_object(with_picture_inside(fbx(), data), name="t.fbx")),
    "what alpha is read from": (ObjectError, opacity_of),
    "what is painted over": (
        ObjectError,
        lambda data: smuggled(albedo=data).with_textures({"albedo.png": np.full((SIDE, SIDE, 3), 9, np.uint8)}),
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
        with pytest.raises(RendererError, match="it is none of PNG, JPEG"):
            target.render(smuggled(**{name: make()}), [view], size=(SIDE, SIDE))
    assert target.render(smuggled(), [view], size=(SIDE, SIDE)).shape == (1, SIDE, SIDE, 3)
