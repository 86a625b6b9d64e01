"""Objects of flat surfaces, made from a few numbers."""

import json

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trompe_shared.object3d import Object3D, encode_png, object_from_files

Floats = NDArray[np.float64]
Surface = tuple[ArrayLike, ArrayLike, NDArray[np.uint8]]
"""Corners (F, 3, 3) in metres, texture coordinates (F, 3, 2), and texture (H, W, 3)."""


def object_of(*surfaces: Surface) -> Object3D:
    """An object with a material for each surface (m0, m1, ... with textures m0.png, m1.png, ...)."""
    lines: list[str] = []
    corners_so_far = 0
    files: dict[str, bytes] = {}
    for number, (corners, uvs, texture) in enumerate(surfaces):
        points, coordinates = np.reshape(corners, (-1, 3)), np.reshape(uvs, (-1, 2))
        lines += ["v {!r} {!r} {!r}".format(*map(float, row)) for row in points]
        lines += ["vt {!r} {!r}".format(*map(float, row)) for row in coordinates]
        lines.append(f"usemtl m{number}")
        for first in range(corners_so_far + 1, corners_so_far + len(points) + 1, 3):
            lines.append("f " + " ".join(f"{k}/{k}" for k in range(first, first + 3)))
        corners_so_far += len(points)
        files[f"m{number}.png"] = encode_png(texture)
    table = {f"m{number}": {"albedo": f"m{number}.png"} for number in range(len(surfaces))}
    mesh = "\n".join(lines).encode()
    return object_from_files({"made.obj": mesh, "made_mat_def.json": json.dumps(table).encode()} | files)


def quad(
    texture: NDArray[np.uint8], *, half: float = 0.1, z: float = 0.0, repeat: float = 1.0
) -> tuple[Floats, Floats, NDArray[np.uint8]]:
    """A square that faces a camera at azimuth 0, with the texture upright and repeated ``repeat`` times each way.

    half: half a side in metres.
    """
    square = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    uvs = repeat * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    rows = [0, 1, 2, 0, 2, 3]
    return square[rows].reshape(-1, 3, 3), uvs[rows].reshape(-1, 3, 2), texture


def with_alpha(obj: Object3D, name: str, alpha: NDArray[np.uint8]) -> Object3D:
    """``obj`` with an alpha channel (H, W), of the texture's size, in one of its albedo files."""
    return object_from_files({**obj.files, name: encode_png(np.dstack([obj.textures[name], alpha]))})
