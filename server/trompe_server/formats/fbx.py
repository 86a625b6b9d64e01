"""FBX: mesh and materials through assimp's command line as OBJ, in metres, y upwards.

Versions of assimp differ in what they do about units and axes, and write no base colour of a physical material as OBJ,
so it gets a file without the former and with the latter under its usual name. A repaint replaces textures only, beside
the FBX and inside a binary one.
"""

import re
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.assembly import assemble, repainted, safe_name
from trompe_server.formats.fbx_tree import MAGIC, Tree, parse_tree
from trompe_server.formats.upload import Upload
from trompe_server.formats.wavefront import complete, dissolved
from trompe_shared.errors import ObjectError
from trompe_shared.local_files import base_name, named
from trompe_shared.object3d import Object3D, decode_alpha, object_from_files, with_alpha_of
from trompe_shared.wavefront import Part, beyond_edges

CENTIMETRE: Final = 0.01
"""Metres of FBX's default unit."""
TIMEOUT: Final = 60.0
AXES: Final = (b"CoordAxis", b"UpAxis", b"FrontAxis")
"""Settings of the axes to the right, upwards and to the viewer: by default 0, 1, 2."""
PLACEMENT: Final = ((b"Translation", slice(2), 0.0), (b"Rotation", slice(2, 3), 0.0), (b"Scaling", slice(2), 1.0))
"""Properties of textures, the numbers of each that count, and their value for a texture in its place."""
_NUMBER: Final = rb"-?[0-9]+(?:\.[0-9]*)?(?:[eE][+-]?[0-9]{1,3})?"
_STRING: Final = rb"S.\0\0\0"
_SETTINGS: Final = re.compile(rb'(%s|")(UnitScaleFactor|%s)' % (_STRING, b"|".join(AXES)), re.DOTALL)
_BASE_COLOUR: Final = rb"(?:3dsMax|Maya)\|(?:\w+\|)?(?:base_?[cC]olor(?:_map)?|TEX_color_map)(?:\|file)?"
_LINK: Final = re.compile(rb"(?s)%s%s\Z" % (_STRING, _BASE_COLOUR))
_TEXT_LINK: Final = re.compile(rb'("OP",\s*\d+,\s*\d+,\s*)"%s"' % _BASE_COLOUR)


def _values(data: bytes, name: bytes) -> Iterator[tuple[float, ...]]:
    """The numbers of each property of a name, in a binary or text file."""
    head = b"S" + struct.pack("<I", len(name)) + re.escape(name)
    values = rb"(?:%s\w*){3}(?:I(.{4})|D(.{8})(?:D(.{8})D(.{8}))?)" % _STRING
    for found in re.finditer(head + values, data, re.DOTALL):
        yield tuple(struct.unpack("<i" if len(each) == 4 else "<d", each)[0] for each in found.groups() if each)
    for found in re.finditer(rb'"%s"(?:[^\n,]*,){4}\s*(%s(?:\s*,\s*%s)*)' % (name, _NUMBER, _NUMBER), data):
        yield tuple(map(float, found[1].split(b",")))


def _setting(data: bytes, name: bytes, default: float) -> float:
    return next(_values(data, name), (default,))[0]


def _axes(data: bytes) -> tuple[list[int], NDArray[np.float32]]:
    """(Numbers of the axes to the right, upwards and to the viewer, their signs). Raises ``ObjectError``."""
    numbers = [_setting(data, name, default) for default, name in enumerate(AXES)]
    if sorted(numbers) != [0, 1, 2]:
        raise ObjectError(f"The axes of the FBX, {numbers}, are not three directions; export it again.")
    signs = [-1 if _setting(data, name + b"Sign", 1) < 0 else 1 for name in AXES]
    return [int(number) for number in numbers], np.array(signs, np.float32)


def _refuse_placed_textures(data: bytes) -> None:
    for name, which, idle in PLACEMENT:
        if moved := [values for values in _values(data, name) if any(value != idle for value in values[which])]:
            raise ObjectError(
                f"The FBX scales, turns or moves a texture ({name.decode()} {moved[0]}), which is not supported; apply "
                "that to the texture coordinates in a modelling program."
            )


def _refuse_shape_keys(data: bytes) -> None:
    shares = [struct.unpack("<d", found[1])[0] for found in re.finditer(rb"(?s)DeformPercentD(.{8})", data)]
    shares += [float(found[1]) for found in re.finditer(rb"DeformPercent:\s*(%s)" % _NUMBER, data)]
    if any(shares):
        raise ObjectError("The FBX has shape keys in use (blend shapes); apply them to the mesh and export it again.")


def _refuse_clamped_textures(data: bytes, parts: Sequence[Part]) -> None:
    clamped = any(value == (1,) for name in (b"WrapModeU", b"WrapModeV") for value in _values(data, name))
    if clamped and any(beyond_edges(part.uvs) for part in parts):
        raise ObjectError(
            "The FBX has a texture that does not repeat, and texture coordinates beyond its edges; let it repeat, or "
            "move the coordinates into the texture."
        )


def unit(data: bytes) -> float:
    """The file's unit of length in metres. Raises ``ObjectError`` outside 1e-6 to 1e6 cm."""
    factor = _setting(data, b"UnitScaleFactor", 1.0)
    if not 1e-6 <= factor <= 1e6:
        raise ObjectError(f"The unit of length of the FBX is {factor:g} cm; set a sensible unit and export it again.")
    return factor * CENTIMETRE


def repaint(upload: Upload, painted: Object3D) -> Upload:
    """``upload`` with the textures of ``painted``. Raises ``ObjectError`` for paint on a plain colour."""
    original, tree = read(upload), _tree(upload.data)
    changed = repainted(original, painted)
    beside, inside = upload.flat(), tree.pictures() if tree is not None else {}
    pictures = {**beside, **inside}
    if homeless := sorted(changed.keys() - pictures.keys()):
        raise ObjectError(f"The FBX has plain colours in place of the textures {homeless}; take the GLB.")
    pngs = {name: with_alpha_of(rgb, decode_alpha(pictures[name], name)) for name, rgb in changed.items()}
    files = {found: png for name, png in pngs.items() if (found := named(name, beside)) is not None}
    if tree is not None and pngs.keys() & inside.keys():
        files[base_name(upload.main)] = tree.with_pictures({**pngs}).to_bytes()
    return upload.with_flat(files) if files else upload


def _tree(data: bytes) -> Tree | None:
    return parse_tree(data) if data.startswith(MAGIC) else None


def read(upload: Upload) -> Object3D:
    """Read an FBX and its textures; one inside counts more than a file beside it. Raises ``ObjectError``."""
    scale, (axes, signs), tree = unit(upload.data), _axes(upload.data), _tree(upload.data)
    _refuse_placed_textures(upload.data)
    _refuse_shape_keys(upload.data)
    beside = {name: data for name, data in upload.flat().items() if not name.lower().endswith((".obj", ".mtl"))}
    inside = tree.pictures() if tree is not None else {}
    converted = _converted(_plain(upload.data, tree, inside))
    _refuse_equal_names(converted)
    obj = object_from_files(dissolved(complete({**beside, **inside, **converted})))
    _refuse_clamped_textures(upload.data, obj.parts)
    mirrored = np.linalg.det(np.eye(3)[axes] * signs) < 0
    parts = [
        replace(
            part,
            vertices=part.vertices[:, axes] * signs * np.float32(scale),
            normals=part.normals[:, axes] * signs,
            faces=np.ascontiguousarray(part.faces[:, ::-1]) if mirrored else part.faces,
        )
        for part in obj.parts
    ]
    images = {name: obj.files[name] for m in obj.materials.values() for name in (m.albedo, m.normal) if name}
    return assemble(safe_name(upload.stem), [_turned(part) for part in parts], obj.materials, images)


def _turned(part: Part) -> Part:
    """``part`` with the corners of each face in the order that its normals tell: assimp mirrors those of a mirrored
    node, but leaves their order."""
    corners, normals = part.vertices[part.faces], part.normals[part.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    against = (np.einsum("fk,fck->fc", across, normals) < 0).all(axis=1)
    return replace(part, faces=np.where(against[:, None], part.faces[:, ::-1], part.faces))


def _refuse_equal_names(converted: Mapping[str, bytes]) -> None:
    """Raise ``ObjectError`` for two materials of one name, which an OBJ cannot tell apart."""
    found: dict[bytes, bytes] = {}
    for library in (data for name, data in converted.items() if name.endswith(".mtl")):
        for name, _, definition in (entry.partition(b"\n") for entry in library.split(b"newmtl ")[1:]):
            if found.setdefault(name.strip(), definition.strip()) != definition.strip():
                raise ObjectError(
                    f"The FBX has two materials called {name.strip().decode(errors='replace')!r}; rename one of them "
                    "and export it again."
                )


def _plain(data: bytes, tree: Tree | None, inside: Collection[str]) -> bytes:
    """The file for assimp: without pictures, units and axes, with base colours as diffuse colours."""
    if tree is None:
        data = _TEXT_LINK.sub(rb'\1"DiffuseColor"', data)
    elif inside or re.search(_BASE_COLOUR, data):
        data = tree.with_pictures(dict.fromkeys(inside)).with_links(_LINK, b"DiffuseColor").to_bytes()
    return _SETTINGS.sub(lambda found: found[1] + found[2].lower(), data)


def _converted(data: bytes) -> dict[str, bytes]:
    """OBJ and MTL of an FBX, by assimp."""
    program = shutil.which("assimp")
    if program is None:
        raise ObjectError(
            "Reading FBX needs assimp, which is missing: install the package assimp-utils (Debian, Ubuntu), or "
            "export the model as glTF."
        )
    with tempfile.TemporaryDirectory() as folder:
        source, made = Path(folder, "in.fbx"), Path(folder, "out.obj")
        source.write_bytes(data)
        command = [program, "export", str(source), str(made), "--triangulate"]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise ObjectError(f"assimp took more than {TIMEOUT:g} s to read the FBX; simplify the model.") from error
        if not made.exists():
            reason = next((line for line in reversed(done.stdout.splitlines()) if "ERROR" in line), "no reason given")
            raise ObjectError(f"assimp cannot read the FBX ({reason.strip()[:200]}). Export the model as glTF.")
        return {path.name: path.read_bytes() for path in (made, made.with_suffix(".mtl")) if path.exists()}
