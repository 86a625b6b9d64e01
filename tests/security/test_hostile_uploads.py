"""What strangers may send: each of these uploads is refused with a word that helps, or read safely."""

import io
import json
import os
import random
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.small_models import OBJ, PICTURE, glb, gltf_buffer, gltf_files, gltf_json, large_png, refusal, zipped
from tests.worker_process import memory
from trompe_server.formats import import_file, read_object
from trompe_shared.errors import ObjectError
from trompe_shared.local_files import pack_zip

MTL = b"newmtl m\nKd 1 1 1\nmap_Kd t.png\n"
STL_TEXT = (
    b"solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n"
    b"endfacet\nendsolid s\n"
)
PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)
FBX = (
    b"; FBX 7.3.0 project file\nFBXHeaderExtension: {\n FBXVersion: 7300\n}\nGlobalSettings: {\n Version: 1000\n"
    b' Properties70: {\n  P: "UnitScaleFactor", "double", "Number", "",100\n }\n}\nObjects: {\n'
    b' Geometry: 1, "Geometry::g", "Mesh" {\n  Vertices: *9 {\n   a: 0,0,0,1,0,0,0,1,0\n  }\n'
    b"  PolygonVertexIndex: *3 {\n   a: 0,1,-3\n  }\n  GeometryVersion: 124\n }\n"
    b' Model: 2, "Model::m", "Mesh" {\n  Version: 232\n }\n}\nConnections: {\n C: "OO",2,0\n C: "OO",1,2\n}\n'
)


def obj_files(**changes: bytes) -> dict[str, bytes]:
    """The files of a textured triangle, some replaced; ``__`` stands for a dot."""
    return {"t.obj": OBJ, "t.mtl": MTL, "t.png": PICTURE} | {k.replace("__", "."): v for k, v in changes.items()}


def stl_binary() -> bytes:
    """One triangle."""
    return bytes(80) + struct.pack("<I12fH", 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)


def ply_binary() -> bytes:
    """The triangle of ``PLY``, with colours."""
    header = (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
        b"property float x\nproperty float y\nproperty float z\n"
        b"property uchar red\nproperty uchar green\nproperty uchar blue\n"
        b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = b"".join(struct.pack("<3f3B", *point, 200, 10 * k, 0) for k, point in enumerate(np.eye(3)))
    return header + rows + struct.pack("<B3i", 3, 0, 1, 2)


def valid_files() -> dict[str, bytes]:
    """One valid file of each kind, by name."""
    return {
        "t-obj.zip": pack_zip(obj_files()),
        "t-sailenv.zip": sailenv(b'{"m": {"albedo": "t.png", "normal": null, "metallic": null}}'),
        "t.glb": glb(gltf_json()),
        "t-gltf.zip": pack_zip(gltf_files()),
        "t-text.ply": PLY,
        "t.ply": ply_binary(),
        "t-text.stl": STL_TEXT,
        "t.stl": stl_binary(),
        "t.obj": OBJ.replace(b"mtllib t.mtl\n", b""),
    }


# Archives


def renamed(name: str) -> bytes:
    """A good archive with one more file of that name."""
    return zipped({**obj_files(), name: b"x"})


def with_link() -> bytes:
    buffer = io.BytesIO(zipped(obj_files()))
    with zipfile.ZipFile(buffer, "a") as archive:
        link = zipfile.ZipInfo("secret.png")
        link.external_attr = 0o120777 << 16
        archive.writestr(link, "/etc/passwd")
    return buffer.getvalue()


def twice() -> bytes:
    buffer = io.BytesIO(zipped(obj_files()))
    with zipfile.ZipFile(buffer, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("t.obj", b"")
    return buffer.getvalue()


def promising(size: int) -> bytes:
    """An archive whose directory says that t.png unpacks to ``size`` bytes."""
    data = bytearray(pack_zip(obj_files()))
    entry = data.rindex(b"t.png") - 46
    struct.pack_into("<I", data, entry + 24, size)
    return bytes(data)


def encrypted() -> bytes:
    data = bytearray(zipped(obj_files()))
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    return bytes(data)


def damaged() -> bytes:
    data = bytearray(pack_zip(obj_files()))
    data[data.index(PICTURE) + 20] ^= 0xFF
    return bytes(data)


ARCHIVES: dict[str, tuple[Callable[[], bytes], str]] = {
    "a zip bomb": (lambda: zipped({**obj_files(), "t.bin": bytes(100 * 2**20)}), "times its size"),
    "a zip that promises 4 GiB": (lambda: promising(2**32 - 2), "more than 512 MiB"),
    "a zip of a thousand files": (lambda: zipped({f"{k}.txt": b"" for k in range(1000)}), "1000 files; at most 256"),
    "a path out of the folder": (lambda: renamed("../../../etc/cron.d/job"), "leads out of it; zip one folder"),
    "an absolute path": (lambda: renamed("/etc/cron.d/job"), "leads out of it; zip one folder"),
    "a path on a drive": (lambda: renamed("C:/Windows/job.exe"), "leads out of it; zip one folder"),
    "a path out of the folder on Windows": (lambda: renamed("..\\..\\job.exe"), "leads out of it; zip one folder"),
    "a symbolic link": (with_link, "link"),
    "two files of one name": (twice, "two files of one name"),
    "an encrypted zip": (encrypted, "damaged or encrypted"),
    "a zip with a flipped byte": (damaged, "damaged or encrypted"),
    "a zip cut short": (lambda: zipped(obj_files())[:-30], "not a zip"),
    "an empty zip": (lambda: zipped({}), "contains no model"),
    "a zip in a zip": (lambda: zipped({"inner.zip": zipped(obj_files())}), "contains no model"),
    "a zip of two models": (lambda: zipped({**obj_files(), "u.obj": OBJ}), "several models"),
}


# Images


def jpeg() -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (64, 64)).save(buffer, "JPEG")
    return buffer.getvalue()


POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\n(/etc/passwd) run\n%%EOF\n"
SVG = b'<?xml version="1.0"?><!DOCTYPE s [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><svg>&b;&b;&b;</svg>'

IMAGES = {
    "an image without rows": (lambda: large_png(8, 0), "cannot be read"),
    "an image whose pixels are missing": (lambda: large_png(4096, 4096), "cannot be read"),
    "an image with a text that unpacks to 100 MB": (
        lambda: large_png(8, 8, chunks=((b"zTXt", b"Comment\0\0" + zlib.compress(bytes(100 * 2**20))),)),
        "cannot be read",
    ),
    "a program in PostScript": (lambda: POSTSCRIPT, "cannot be read"),
    "an XML bomb": (lambda: SVG, "cannot be read"),
    "a JPEG cut short": (lambda: jpeg()[:-200], "cannot be read"),
    "no image at all": (lambda: b"#!/bin/sh\nrm -rf /\n", "cannot be read"),
}


# OBJ


def sailenv(table: bytes) -> bytes:
    """A zip in SAILenv's format with a material definition."""
    return zipped({"t.obj": OBJ, "t_mat_def.json": table, "t.png": PICTURE})


def with_statement(line: bytes) -> bytes:
    return zipped(obj_files(t__obj=OBJ + line + b"\n"))


def many_triangles() -> bytes:
    return zipped(obj_files(t__obj=OBJ + (b"f" + b" 1/1 2/2 3/3" * 20000 + b"\n") * 35))


OBJS = {
    "an index of 5000 digits": (lambda: with_statement(b"f 1/1 2/2 " + b"9" * 5000), "cannot be read"),
    "an object as large as a galaxy": (lambda: with_statement(b"v 1e20 0 0"), "beyond 1e+06"),
    "texture coordinates beyond all bounds": (lambda: with_statement(b"vt 1e30 0"), "beyond 1e+06"),
    "a line of 2 MB": (lambda: with_statement(b"f" + b" 1/1" * 500_000), "characters"),
    "a mesh that is one point": (
        lambda: zipped(obj_files(t__obj=OBJ.replace(b"v 1", b"v 0").replace(b"v 0 1", b"v 0 0"))),
        "no extent",
    ),
    "a colour that is none": (lambda: zipped(obj_files(t__mtl=b"newmtl m\nKd red green blue\n")), "not a colour"),
    "a texture out of the folder": (lambda: sailenv(b'{"m": {"albedo": "../../../../etc/passwd"}}'), "passwd"),
    "a hundred thousand brackets": (lambda: sailenv(b'{"m":' * 100_000), "not a material definition"),
}


# glTF


def changed(**changes: Any) -> bytes:
    """A GLB of which parts of the JSON are others."""
    return glb(gltf_json() | changes)


def external(**changes: Any) -> bytes:
    return zipped(gltf_files(**changes))


def accessor(**changes: Any) -> bytes:
    """A GLB whose positions are described otherwise."""
    document = gltf_json()
    document["accessors"][0] |= changes
    return glb(document)


def draco() -> bytes:
    """A GLB whose positions are only in the bytes of a picture, as if Draco had compressed them."""
    document = gltf_json()
    del document["accessors"][0]["bufferView"]
    document["accessors"].append({"componentType": 5125, "count": 3, "type": "SCALAR"})
    compressed = {"KHR_draco_mesh_compression": {"bufferView": 2, "attributes": {"POSITION": 0}}}
    document["meshes"][0]["primitives"][0] |= {"indices": 2, "extensions": compressed}
    return glb(document)


def sparse(count: int) -> dict[str, Any]:
    """Other values for rows whose numbers are the bits of positions."""
    rows = {"bufferView": 0, "byteOffset": 12, "componentType": 5125}
    return {"count": count, "indices": rows, "values": {"bufferView": 0}}


def image_at(uri: str) -> bytes:
    return external(images=[{"uri": uri}])


def army() -> bytes:
    """A mesh of 2100 triangles, a thousand times."""
    document = gltf_json()
    document["meshes"][0]["primitives"] *= 2100
    nodes = [{"children": list(range(1, 1001))}, *[{"mesh": 0}] * 1000]
    return glb(document | {"nodes": nodes})


GLTFS = {
    "two hundred thousand nodes": (lambda: changed(nodes=[{}] * 200_000), "not valid at nodes"),
    "JSON of a hundred thousand brackets": (lambda: glb(b'{"a":' + b"[" * 100_000), "not valid"),
    "JSON of 40 MB": (lambda: glb(b" " * (40 * 2**20)), "bytes"),
    "a node that is its own child": (lambda: changed(nodes=[{"children": [0]}]), "tree"),
    "nodes in a circle": (lambda: changed(nodes=[{"children": [1]}, {"children": [0]}]), "tree"),
    "nodes that multiply": (lambda: changed(nodes=[{"children": [k + 1, k + 1]} for k in range(64)] + [{}]), "tree"),
    "2.1 million triangles of 2100": (army, "more than 2000000 triangles"),
    "an image on another machine": (lambda: image_at("http://169.254.169.254/latest"), "below its own folder"),
    "an image that is a file of this machine": (lambda: image_at("file:///etc/passwd"), "below its own folder"),
    "an image out of the folder": (lambda: image_at("../../../../etc/passwd"), "below its own folder"),
    "an image out of the folder, escaped": (lambda: image_at("%2e%2e/%2e%2e/etc/passwd"), "below its own folder"),
    "an image at an absolute path": (lambda: image_at("/etc/passwd"), "below its own folder"),
    "a data URI that is no base64": (lambda: image_at("data:image/png;base64,!!!"), "data URI"),
    "a buffer that is not there": (lambda: external(buffers=[{"byteLength": 9}]), "0 bytes"),
    "a buffer that is too short": (lambda: external(buffers=[{"byteLength": 10**9, "uri": "t.bin"}]), "should have"),
    "an accessor beyond its view": (lambda: accessor(count=4), "beyond its buffer view"),
    "an accessor that starts beyond its view": (lambda: accessor(byteOffset=2**39), "beyond its buffer view"),
    "an accessor of 10^12 numbers": (lambda: accessor(count=10**12), "not valid at accessors"),
    "an accessor of less than nothing": (lambda: accessor(count=-3), "not valid at accessors"),
    "an accessor of no view": (lambda: accessor(bufferView=99), "buffer view 99"),
    "a view before its start": (lambda: changed(bufferViews=[{"buffer": 0, "byteOffset": -8, "byteLength": 8}]), "not"),
    "a view beyond the buffer": (lambda: changed(bufferViews=[{"buffer": 0, "byteLength": 10**9}] * 3), "beyond"),
    "a sparse accessor of a billion rows": (lambda: accessor(sparse=sparse(10**9)), "not valid at accessors"),
    "a sparse accessor beyond its view": (lambda: accessor(sparse=sparse(10**6)), "beyond its buffer view"),
    "a sparse accessor of rows that are not there": (lambda: accessor(sparse=sparse(3)), "changes row"),
    "indices that are fractions": (
        lambda: changed(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "indices": 0}]}]),
        "whole numbers",
    ),
    "a mesh that is not there": (lambda: changed(nodes=[{"mesh": 2**30}]), "mesh"),
    "a negative index": (lambda: changed(nodes=[{"mesh": -1}]), "not valid at nodes"),
    "a place that is not a number": (
        lambda: glb(json.dumps(gltf_json()).replace('"mesh": 0', '"mesh": 0, "scale": [NaN, 1, 1]').encode()),
        "not valid",
    ),
    "a place beyond all bounds": (lambda: changed(nodes=[{"mesh": 0, "translation": [1e11, 0, 0]}]), "beyond 1e+06"),
    "compressed meshes": (lambda: changed(extensionsRequired=["EXT_meshopt_compression"]), "meshopt"),
    "instances of an extension": (lambda: changed(extensionsUsed=["EXT_mesh_gpu_instancing"]), "gpu_instancing"),
    "meshes that Draco did not compress": (lambda: draco(), "cannot be decompressed by Draco"),
    "a skin that is not there": (lambda: changed(nodes=[{"mesh": 0, "skin": 0}]), "names skin 0, but has 0"),
    "lists where there should be names": (lambda: changed(meshes={"primitives": "all"}), "not valid at meshes"),
    "a chunk beyond the file": (lambda: glb(gltf_json()).replace(b"\0JSON", b"\xffJSON"), "beyond it"),
    "glTF of another version": (lambda: changed(asset={"version": "1.0"}), "glTF 2.0"),
    "a GLB cut short": (lambda: glb(gltf_json())[:15], "too early"),
}


# The others


OTHERS = {
    "a PLY of 10^12 vertices": ("t.ply", lambda: PLY.replace(b"vertex 3", b"vertex 1000000000000"), "header"),
    "a PLY of a face with 4 billion corners": (
        "t.ply",
        lambda: ply_binary().replace(b"list uchar", b"list uint")[:-13] + struct.pack("<I3i", 2**32 - 1, 0, 1, 2),
        "cannot be read",
    ),
    "a PLY that names a vertex it has not": ("t.ply", lambda: ply_binary()[:-4] + struct.pack("<i", 99), "vertex 99"),
    "a PLY with a texture out of the folder": (
        "t.ply",
        lambda: (
            PLY.replace(b"element vertex", b"comment TextureFile ../../etc/passwd\nelement vertex")
            .replace(b"property float z\n", b"property float z\nproperty float s\nproperty float t\n")
            .replace(b"0 0 0\n1 0 0\n0 1 0\n", b"0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n")
        ),
        "below its own folder",
    ),
    "a PLY whose faces are single numbers": (
        "t.ply",
        lambda: PLY.replace(b"list uchar int", b"int").replace(b"3 0 1 2", b"1"),
        "no mesh",
    ),
    "a PLY with fractions as faces": ("t.ply", lambda: PLY.replace(b"list uchar int", b"list uchar float"), "no mesh"),
    "a PLY whose header does not end": ("t.ply", lambda: PLY[:60], "no complete header"),
    "a PLY cut short": ("t.ply", lambda: PLY[: PLY.rindex(b"3 0 1 2")], "too early"),
    "a PLY with a word for a number": ("t.ply", lambda: PLY.replace(b"1 0 0\n", b"1 one 0\n"), "cannot be read"),
    "a binary PLY that mixes polygons with texture coordinates": (
        "t.ply",
        lambda: (
            ply_binary()
            .replace(b"element vertex", b"comment TextureFile t.png\nelement vertex")
            .replace(b"face 1", b"face 2")
            .replace(b"indices\n", b"indices\nproperty list uchar float texcoord\n")
            + struct.pack("<BB4iB", 0, 4, 0, 1, 2, 0, 0)
        ),
        "different sizes",
    ),
    "a binary PLY cut in a polygon": ("t.ply", lambda: ply_binary()[:-1], "cannot be read"),
    "a PLY of a face with -1 corners": (
        "t.ply",
        lambda: ply_binary().replace(b"list uchar", b"list char")[:-13] + struct.pack("<b3i", -1, 0, 1, 2),
        "a list of -1 items",
    ),
    "an STL of less triangles than it says": ("t.stl", lambda: stl_binary()[:-10], "no triangles"),
    "an STL that is not a number": ("t.stl", lambda: STL_TEXT.replace(b"vertex 1", b"vertex nan"), "not finite"),
    "an STL with half a triangle": ("t.stl", lambda: STL_TEXT.replace(b"vertex 0 1 0\n", b""), "cannot be read"),
    "no FBX": ("t.fbx", lambda: b"Kaydara FBX Binary  \x00\x1a\x00" + random.Random(0).randbytes(4096), "FBX"),
    "an FBX whose unit is a light year": ("t.fbx", lambda: FBX.replace(b'"",100', b'"",9e17'), "unit"),
    "a program": ("t.exe", lambda: b"MZ" + bytes(4096), "not a supported model"),
    "nothing": ("t.glb", lambda: b"", "not a supported model"),
}

UPLOADS = (
    [pytest.param("t.zip", make, words, id=name) for name, (make, words) in {**ARCHIVES, **OBJS}.items()]
    + [pytest.param("t.zip", many_triangles, "more than 2000000", id="2.1 million triangles", marks=pytest.mark.slow)]
    + [
        pytest.param("t.zip", lambda make=make: zipped(obj_files(t__png=make())), words, id=name)
        for name, (make, words) in IMAGES.items()
    ]
    + [pytest.param("t.glb", make, words, id=name) for name, (make, words) in GLTFS.items()]
    + [pytest.param(name, make, words, id=title) for title, (name, make, words) in OTHERS.items()]
)


@pytest.mark.parametrize(("name", "make", "words"), UPLOADS)
def test_a_hostile_upload_is_refused_with_a_word_that_helps(name: str, make: Callable[[], bytes], words: str) -> None:
    message = refusal(make(), name)
    assert words in message
    assert len(message) < 700
    assert "Traceback" not in message


def test_the_files_that_the_hostile_ones_are_made_of_are_read() -> None:
    for name, data in valid_files().items():
        assert read_object(data, name=name).obj.radius > 0, name


def test_a_triangle_as_long_as_a_street_and_as_thin_as_a_hair_is_laid_out() -> None:
    obj = read_object(PLY.replace(b"0 1 0\n3", b"0 131072 1\n3"), name="t.ply").obj
    assert obj.n_texels < 2**21


# Limits of the process that reads


def big_glb() -> bytes:
    document = gltf_json()
    document["images"] = [{"bufferView": 2, "mimeType": "image/png"}]
    picture = large_png(8192, 8192, data=zlib.compress(bytes(8192 * (3 * 8192 + 1)), 1))
    document["bufferViews"][2]["byteLength"] = len(picture)
    data = gltf_buffer()[:60] + picture
    return glb(document | {"buffers": [{"byteLength": len(data)}]}, data)


def test_an_upload_that_takes_too_much_memory_is_refused_and_the_next_one_is_read() -> None:
    with pytest.raises(ObjectError, match="400 MiB of memory"):
        import_file(big_glb(), name="t.glb", memory=400 * 2**20)
    assert import_file(glb(gltf_json()), name="t.glb").facts["triangles"] == 1


def test_an_upload_that_takes_too_long_is_given_up() -> None:
    with pytest.raises(ObjectError, match=r"more than 0\.05 s"):
        import_file(glb(gltf_json()), name="t.glb", seconds=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "make", "words"), UPLOADS)
def test_a_hostile_upload_is_refused_in_its_own_process_too(name: str, make: Callable[[], bytes], words: str) -> None:
    with pytest.raises(ObjectError, match=r"\w+ \w+"):
        import_file(make(), name=name, seconds=60)


# Fuzzing

FUZZED = 100_000
GROWTH = 256 * 2**20
"""Bytes by which the process may grow."""


def mutated(data: bytes, generator: random.Random) -> bytes:
    """``data`` with a few bytes changed, a part taken out, doubled or put elsewhere, or a number made extreme."""
    out = bytearray(data)
    for _ in range(generator.randint(1, 4)):
        at, length = generator.randrange(len(out) + 1), generator.randint(1, 16)
        piece = bytes(out[at : at + length])
        match generator.randrange(6):
            case 0:
                out[at : at + length] = generator.randbytes(len(piece))
            case 1:
                del out[at : at + length]
            case 2:
                out[at:at] = piece * generator.randint(1, 50)
            case 3:
                other = generator.randrange(len(out) + 1)
                out[other : other + length] = piece
            case 4:
                extreme = [b"\xff" * 4, bytes(4), b"\0\0\xc0\x7f", b"\xff\xff\xff\x7f", *b"-1 1e308 nan { [".split()]
                out[at : at + length] = generator.choice(extreme)
            case _:
                out = out[: max(at, 1)]
    return bytes(out)


def inner(name: str, data: bytes, generator: random.Random) -> bytes:
    """A mutation of one of the files in an archive, or of any other file itself; now and then of the archive."""
    if not name.endswith(".zip") or generator.random() < 0.2:
        return mutated(data, generator)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        files = {info.filename: archive.read(info) for info in archive.infolist()}
    victim = generator.choice(sorted(files))
    return pack_zip(files | {victim: mutated(files[victim], generator)})


def read_or_refused(name: str, data: bytes) -> bool:
    """Whether an upload is read. Raises what is no refusal."""
    try:
        obj = read_object(data, name=name).obj
    except ObjectError:
        return False
    assert np.isfinite(obj.radius)
    assert all(part.faces.max() < len(part.vertices) for part in obj.parts)
    return True


def fuzz(count: int, seed: int) -> dict[str, int]:
    """How many of ``count`` mutated files were read, and how many were refused."""
    generator, files = random.Random(seed), valid_files()
    found = {"read": 0, "refused": 0}
    for number in range(count):
        name, data = generator.choice(sorted(files.items()))
        hostile = inner(name, data, generator)
        try:
            found["read" if read_or_refused(name, hostile) else "refused"] += 1
        except Exception as error:
            raise AssertionError(f"input {number} of seed {seed}, {name}: {error!r}\n{hostile[:2000]!r}") from error
    return found


def test_three_hundred_fuzzed_uploads_are_read_or_refused() -> None:
    found = fuzz(300, seed=1)
    assert min(found.values()) > 20, found


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_hundred_thousand_fuzzed_uploads_are_read_or_refused_and_memory_stays() -> None:
    fuzz(2000, seed=2)
    before = memory(os.getpid())
    found = fuzz(FUZZED, seed=3)
    grown = memory(os.getpid()) - before
    assert min(found.values()) > FUZZED // 20, found
    assert grown < GROWTH


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("assimp") is None, reason="assimp-utils is not installed")
def test_a_thousand_fuzzed_fbx_files_are_read_or_refused() -> None:
    generator = random.Random(4)
    found = [read_or_refused("t.fbx", mutated(FBX, generator)) for _ in range(1000)]
    assert 20 < sum(found) < 950
