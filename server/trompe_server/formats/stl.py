"""STL: bare triangles, text or binary. They get a grey texture; STL itself has no place for one."""

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.assembly import DEFAULT_COLOUR, assemble, check_numbers, painted_flat, safe_name
from trompe_server.formats.upload import Upload
from trompe_server.formats.wavefront import shrunk
from trompe_shared.errors import ObjectError
from trompe_shared.object3d import Material, Object3D, encode_png
from trompe_shared.wavefront import MAX_FACES, Surface, smooth_normals

__all__ = ["looks_binary", "read", "repaint"]

MATERIAL = "surface"
_ROW = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def looks_binary(data: bytes) -> bool:
    """Whether the length is that of a binary STL with as many triangles as it says."""
    return len(data) >= 84 and len(data) == 84 + _ROW.itemsize * int(np.frombuffer(data, "<u4", 1, 80)[0])


def read(upload: Upload, max_texture: int | None = None) -> Object3D:
    """The object of an STL, each face flat. Raises ``ObjectError``."""
    corners = _binary(upload.data) if looks_binary(upload.data) else _text(upload.data)
    if not 0 < len(corners) <= MAX_FACES:
        raise ObjectError(f"The STL has {len(corners)} triangles; from 1 to {MAX_FACES} are read.")
    check_numbers(corners, "The STL")
    vertices = corners.reshape(-1, 3)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    surface = Surface(MATERIAL, vertices, smooth_normals(vertices, np.arange(len(vertices)), faces), faces)
    painted = painted_flat([surface], DEFAULT_COLOUR)
    name = safe_name(upload.stem)
    file = f"{name}_albedo.png"
    files = {file: encode_png(painted.picture)}
    return shrunk(assemble(name, painted.parts, {MATERIAL: Material(MATERIAL, file)}, files), max_texture)


def repaint(upload: Upload, painted: Object3D) -> Upload:
    """Always raises ``ObjectError``: there is no texture in an STL file."""
    raise ObjectError(f"STL has no textures, so {upload.main!r} cannot be written with paint on it; take the GLB.")


def _binary(data: bytes) -> NDArray[np.float32]:
    return np.frombuffer(data, _ROW, offset=84)["corners"].astype(np.float32)


def _text(data: bytes) -> NDArray[np.float32]:
    """Corners (F, 3, 3) of the ``vertex`` lines."""
    rows = [
        line.split()[1:4] for line in data.decode("ascii", "replace").splitlines() if line.lstrip().startswith("vertex")
    ]
    try:
        with np.errstate(over="ignore"):  # too large for single precision is refused as such
            return np.array(rows, np.float64).reshape(-1, 3, 3).astype(np.float32)
    except ValueError as error:
        raise ObjectError(
            f"The STL file ends too early or holds what is no number ({error}); save it again."
        ) from error
