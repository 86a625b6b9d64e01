"""Texture coordinates for meshes without any, by xatlas, and vertex colours baked into the new texture."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.pictures import Pixels, encode_srgb
from trompe_shared.errors import ObjectError
from trompe_shared.wavefront import area

BAKED_SIDE: Final = 512
"""Approximate side, in texels, of a generated texture."""
MAX_UNWRAPPED: Final = 100_000
"""Most triangles to unwrap; xatlas takes up to half a minute for them."""
EXTENT: Final = 100.0
"""Extent of a mesh for xatlas, which drops triangles smaller than about 1e-8 units."""
PADDING: Final = 2
GUTTER: Final = 4
"""Texels by which colours extend beyond the edges of charts, for filtering."""


@dataclass(frozen=True)
class Unwrapped:
    """A mesh split at seams.

    source: (V,) int64, the original vertex of each new vertex.
    faces:  (F, 3) int32, the original triangles in their order.
    uvs:    (V, 2) float32 in [0, 1].
    """

    source: NDArray[np.int64]
    faces: NDArray[np.int32]
    uvs: NDArray[np.float32]


def laid_out(uvs: NDArray[np.float32] | None, faces: NDArray[np.int32]) -> bool:
    """Whether any triangle (F, 3) has area in the texture; programs give plain surfaces one point for all corners."""
    return uvs is not None and area(uvs, faces) > 0


def unwrap(meshes: Sequence[tuple[NDArray[np.float32], NDArray[np.int32]]]) -> tuple[list[Unwrapped], tuple[int, int]]:
    """Lay out meshes (vertices (V, 3), faces (F, 3)) in one texture of size (H, W); deterministic.

    Raises ``ObjectError`` if xatlas is missing or the meshes are too large for it.
    """
    count = sum(len(faces) for _, faces in meshes)
    if count > MAX_UNWRAPPED:
        raise ObjectError(
            f"The mesh has no texture coordinates and {count} triangles; the limit is {MAX_UNWRAPPED}. "
            "Unwrap it in a modelling program."
        )
    atlas = _generated(meshes)
    unwrapped = []
    for number in range(len(meshes)):
        source, faces, uvs = atlas[number]
        uvs = np.clip(np.nan_to_num(uvs), 0.0, 1.0)  # NaN for meshes without area
        unwrapped.append(Unwrapped(source.astype(np.int64), faces.astype(np.int32), uvs))
    return unwrapped, (max(1, atlas.height), max(1, atlas.width))


def _generated(meshes: Sequence[tuple[NDArray[np.float32], NDArray[np.int32]]]) -> Any:
    try:
        import xatlas  # type: ignore[import-not-found]
    except ImportError as error:
        raise ObjectError(
            "The mesh has no texture coordinates, and xatlas, which generates them, is missing: "
            "pip install 'trompe[server]', or unwrap the mesh in a modelling program."
        ) from error
    atlas = xatlas.Atlas()
    extent = max(float(np.ptp(vertices, axis=0).max()) for vertices, _ in meshes)
    for vertices, faces in meshes:
        scaled = (vertices - vertices.mean(axis=0)) * (EXTENT / max(extent, 1e-30))
        atlas.add_mesh(scaled.astype(np.float32), faces.astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding, options.bilinear = BAKED_SIDE, PADDING, True
    options.max_chart_size = 2 * BAKED_SIDE
    atlas.generate(xatlas.ChartOptions(), options)
    if max(atlas.width, atlas.height) > 4 * BAKED_SIDE:
        raise ObjectError(
            "The mesh has no texture coordinates, and its triangles are too long and thin to be unwrapped here; unwrap "
            "it in a modelling program."
        )
    return atlas


def bake(meshes: Sequence[tuple[Unwrapped, NDArray[np.float64]]], *, size: tuple[int, int]) -> Pixels:
    """Texture (H, W, 3) of linear vertex colours (V, 3), interpolated over each triangle."""
    colours = np.zeros((*size, 3))
    covered = np.zeros(size, bool)
    for unwrapped, of_vertices in meshes:
        corners = unwrapped.uvs[unwrapped.faces].astype(np.float64) * [size[1], size[0]]
        corners[..., 1] = size[0] - corners[..., 1]
        for triangle, values in zip(corners, of_vertices[unwrapped.faces], strict=True):
            _fill(triangle, values, colours, covered)
    for _ in range(GUTTER):
        _spread(colours, covered)
    if covered.any():
        colours[~covered] = colours[covered].mean(axis=0)
    return encode_srgb(colours)


def _fill(
    triangle: NDArray[np.float64], values: NDArray[np.float64], colours: NDArray[np.float64], covered: NDArray[np.bool_]
) -> None:
    """Interpolate ``values`` (3, 3) over the texels with centres in ``triangle`` (3, 2), within a tolerance."""
    height, width = covered.shape
    low = np.maximum(np.floor(triangle.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(triangle.max(axis=0)).astype(int) + 1, [width, height])
    edges = np.stack([triangle[1] - triangle[0], triangle[2] - triangle[0]], axis=1)
    if abs(np.linalg.det(edges)) < 1e-9:
        return
    x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
    second, third = np.einsum("ij,jhw->ihw", np.linalg.inv(edges), np.stack([x - triangle[0, 0], y - triangle[0, 1]]))
    weights = np.stack([1 - second - third, second, third], axis=-1)  # (h, w, corner)
    inside = weights.min(axis=-1) >= -1e-6
    window = slice(low[1], high[1]), slice(low[0], high[0])
    colours[window][inside] = weights[inside] @ values
    covered[window][inside] = True


def _spread(colours: NDArray[np.float64], covered: NDArray[np.bool_]) -> None:
    """Extend the colours of covered texels to their uncovered neighbours."""
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        near, values = np.roll(covered, step, axis), np.roll(colours, step, axis)
        fresh = near & ~covered
        colours[fresh] = values[fresh]
        covered |= fresh
