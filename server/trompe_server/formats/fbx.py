"""FBX: mesh and materials through assimp's command line as OBJ, in metres.

A repaint replaces textures only, beside the FBX and inside a binary one.
"""

import re
import shutil
import struct
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from trompe_server.formats.assembly import assemble, repainted, safe_name
from trompe_server.formats.fbx_tree import MAGIC, Tree, parse_tree
from trompe_server.formats.pictures import decode
from trompe_server.formats.upload import Upload
from trompe_server.formats.wavefront import complete, dissolved
from trompe_shared.errors import ObjectError
from trompe_shared.local_files import base_name, named
from trompe_shared.object3d import Object3D, object_from_files, with_alpha_of

CENTIMETRE: Final = 0.01
"""Metres of FBX's default unit."""
TIMEOUT: Final = 60.0
_BINARY: Final = re.compile(rb"S\x0f\0\0\0UnitScaleFactorS\x06\0\0\0doubleS\x06\0\0\0NumberS\0\0\0\0D(.{8})", re.DOTALL)
_TEXT: Final = re.compile(rb'"UnitScaleFactor"(?:[^\n,]*,){4}\s*([0-9]+(?:\.[0-9]*)?(?:[eE][+-]?[0-9]{1,3})?)')


def unit(data: bytes) -> float:
    """The file's unit of length in metres. Raises ``ObjectError`` outside 1e-6 to 1e6 cm."""
    found = _BINARY.search(data)
    text = _TEXT.search(data)
    factor = struct.unpack("<d", found[1])[0] if found else float(text[1]) if text else 1.0
    if not 1e-6 <= factor <= 1e6:
        raise ObjectError(f"The unit of length of the FBX is {factor:g} cm; set a sensible unit and export it again.")
    return float(factor) * CENTIMETRE


def repaint(upload: Upload, painted: Object3D) -> Upload:
    """``upload`` with the textures of ``painted``. Raises ``ObjectError`` for paint on a plain colour."""
    original, tree = read(upload), _tree(upload.data)
    changed = repainted(original, painted)
    beside, inside = upload.flat(), tree.pictures() if tree is not None else {}
    pictures = {**beside, **inside}
    if homeless := sorted(changed.keys() - pictures.keys()):
        raise ObjectError(f"The FBX has plain colours in place of the textures {homeless}; take the GLB.")
    pngs = {name: with_alpha_of(rgb, decode(pictures[name], name)[1]) for name, rgb in changed.items()}
    files = {found: png for name, png in pngs.items() if (found := named(name, beside)) is not None}
    if tree is not None and pngs.keys() & inside.keys():
        files[base_name(upload.main)] = tree.with_pictures({**pngs}).to_bytes()
    return upload.with_flat(files) if files else upload


def _tree(data: bytes) -> Tree | None:
    return parse_tree(data) if data.startswith(MAGIC) else None


def read(upload: Upload) -> Object3D:
    """Read an FBX and its textures; one inside counts more than a file beside it. Raises ``ObjectError``."""
    scale, tree = unit(upload.data), _tree(upload.data)
    beside = {name: data for name, data in upload.flat().items() if not name.lower().endswith((".obj", ".mtl"))}
    inside = tree.pictures() if tree is not None else {}
    bare = upload.data if tree is None or not inside else tree.with_pictures(dict.fromkeys(inside)).to_bytes()
    obj = object_from_files(dissolved(complete({**beside, **inside, **_converted(bare)})))
    parts = [replace(part, vertices=part.vertices * np.float32(scale)) for part in obj.parts]
    images = {name: obj.files[name] for m in obj.materials.values() for name in (m.albedo, m.normal) if name}
    return assemble(safe_name(upload.stem), parts, obj.materials, images)


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
