"""STL: triangles without material, text or binary. They get a grey texture, which STL itself cannot store."""

import io
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.assembly import check_numbers, painted_object
from trompe_server.formats.upload import Upload, refusing
from trompe_shared.errors import ObjectError
from trompe_shared.object3d import Object3D
from trompe_shared.wavefront import MAX_FACES, Surface, smooth_normals

HEADER: Final = 84
TRIANGLE: Final = 50
"""Bytes of a binary STL's header and of one triangle."""


def looks_binary(data: bytes) -> bool:
    """Whether ``data`` has the length of a binary STL with as many triangles as its header announces."""
    return len(data) == _end(data)


def _end(data: bytes) -> int:
    """The length of a binary STL with this header."""
    return HEADER + TRIANGLE * int.from_bytes(data[80:HEADER], "little")


def read(upload: Upload) -> Object3D:
    """Read an STL with flat-shaded faces. Raises ``ObjectError``."""
    vertices = _corners(upload.data)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    if not 0 < len(faces) <= MAX_FACES:
        raise ObjectError(f"The STL has {len(faces)} triangles; expected 1 to {MAX_FACES}.")
    check_numbers(vertices, "The STL")
    surface = Surface("surface", vertices, smooth_normals(vertices, np.arange(len(vertices)), faces), faces)
    return painted_object(upload.stem, surface)


def repaint(upload: Upload, painted: Object3D) -> Upload:
    """Raise ``ObjectError``: an STL file has no texture."""
    raise ObjectError(f"STL has no textures, so {upload.main!r} cannot hold the paint; take the GLB.")


def _corners(data: bytes) -> NDArray[np.float32]:
    """Corners (3 F, 3) of all solids of the file, three for each triangle."""
    end = _end(data)
    with refusing("The STL file", remedy="Save it again."), np.errstate(over="ignore"):
        from trimesh.exchange.stl import load_stl  # takes a second to import

        loaded = load_stl(io.BytesIO(data[:end] if end <= len(data) else data))  # bytes may follow the triangles
        solids = loaded["geometry"].values() if "geometry" in loaded else [loaded]
        if not solids:
            raise ObjectError("The STL file has no triangles, neither as text nor in binary; save it again.")
        corners: NDArray[np.float32] = np.concatenate([solid["vertices"] for solid in solids]).astype(np.float32)
        return corners
