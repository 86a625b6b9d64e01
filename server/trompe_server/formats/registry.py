"""Supported formats, their recognition, and the two operations on all of them: read and repaint."""

import posixpath
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from trompe_server.formats import fbx, gltf, gltf_repaint, ply, stl, wavefront
from trompe_server.formats.upload import Upload, is_litter
from trompe_shared.errors import ObjectError
from trompe_shared.local_files import base_name
from trompe_shared.object3d import MAX_ARCHIVE_BYTES, Object3D, definition_of, unpack


@dataclass(frozen=True)
class Format:
    """endings: of the mesh file; one without gets the last. beginnings: of its bytes.

    read, repaint: raise ``ObjectError``.
    """

    name: str
    endings: tuple[str, ...]
    beginnings: tuple[bytes, ...]
    read: Callable[[Upload], Object3D]
    repaint: Callable[[Upload, Object3D], Upload]


FORMATS: Final = (
    Format("obj", (".obj",), (), wavefront.read, wavefront.repaint),
    Format("gltf", (".gltf", ".glb"), (b"glTF", b"{"), gltf.read, gltf_repaint.repaint),
    Format("fbx", (".fbx",), (b"Kaydara FBX Binary", b"; FBX"), fbx.read, fbx.repaint),
    Format("ply", (".ply",), (b"ply\n", b"ply\r"), ply.read, ply.repaint),
    Format("stl", (".stl",), (), stl.read, stl.repaint),
)
"""In order of precedence for archives with meshes of several formats."""


@dataclass(frozen=True)
class Imported:
    """An object and the name of its file format (``sailenv``: an OBJ with a mat_def)."""

    obj: Object3D
    format: str


@dataclass(frozen=True)
class Exported:
    """Bytes of a file and the ending of its name."""

    data: bytes
    ending: str


def facts_of(obj: Object3D) -> dict[str, Any]:
    """What an ``ObjectInfo`` says about the object itself."""
    return {
        "materials": sorted(obj.materials),
        "textures": {name: image.shape[:2] for name, image in obj.textures.items()},
        "triangles": sum(len(part.faces) for part in obj.parts),
        "radius": obj.radius,
    }


def read_object(data: bytes, *, name: str, max_texture: int | None = None) -> Imported:
    """Read the bytes of a model file or zip called ``name``.

    max_texture: longest side of a texture; larger ones are reduced. Raises ``ObjectError``.
    """
    upload, found = _opened(data, name)
    sailenv = found.name == "obj" and definition_of(upload.flat()) is not None
    return Imported(wavefront.shrunk(found.read(upload), max_texture), "sailenv" if sailenv else found.name)


def repaint_file(data: bytes, painted: Object3D, *, name: str) -> Exported:
    """The model file or zip with the textures of ``painted``, an object read from it. Raises ``ObjectError``."""
    upload, found = _opened(data, name)
    changed = found.repaint(upload, painted)
    out = data if changed == upload else changed.to_bytes()
    return Exported(out, ".zip" if out[:2] == b"PK" else posixpath.splitext(changed.main)[1].lower())


def _opened(data: bytes, name: str) -> tuple[Upload, Format]:
    if len(data) > MAX_ARCHIVE_BYTES:
        raise ObjectError(f"The file has more than {MAX_ARCHIVE_BYTES >> 20} MiB.")
    if data[:2] == b"PK":
        return _in_archive(unpack(data))
    found = _recognised(data, name)
    main = base_name(name if name.lower().endswith(found.endings) else f"{name or 'object'}{found.endings[-1]}")
    return Upload(main, {main: data}, packed=False), found


def _recognised(data: bytes, name: str) -> Format:
    by_name = {format.name: format for format in FORMATS}
    head = data[:64].removeprefix(b"\xef\xbb\xbf").lstrip() if data[:4] != b"ply\n" else data
    for format in FORMATS:
        if head.startswith(format.beginnings):
            return format
    if stl.looks_binary(data) or head.lower().startswith(b"solid") or name.lower().endswith(".stl"):
        return by_name["stl"]
    if name.lower().endswith(".obj"):
        return by_name["obj"]
    raise ObjectError(
        f"{name!r} is not a supported model file. Send a zip of an OBJ with its materials and textures, glTF or GLB, "
        "FBX, PLY or STL."
    )


def _in_archive(files: Mapping[str, bytes]) -> tuple[Upload, Format]:
    for format in FORMATS:
        meshes = sorted(path for path in files if path.lower().endswith(format.endings) and not is_litter(path))
        if len(meshes) > 1:
            raise ObjectError(f"The archive contains several models, {meshes[:8]}; send them one by one.")
        if meshes:
            return Upload(meshes[0], files, packed=True), format
    inner = next((path for path in sorted(files) if path.lower().endswith(".zip")), None)
    remedy = "zip an .obj, .gltf, .glb, .fbx or .ply" if inner is None else f"unpack {inner!r} and send that model"
    raise ObjectError(f"The archive contains no model, only {sorted(files)[:8]}; {remedy}.")
