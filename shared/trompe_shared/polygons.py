"""Split concave polygons into triangles by cutting off ears; a fan of one folds over itself."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_shared.errors import ObjectError

MAX_CONCAVE: Final = 1000
"""Most corners of a concave polygon; the time grows with the square of their number."""
FOLD: Final = 1e-3
"""Area of a folded triangle, as a part of its polygon's, that shows."""


def unfold(corners: NDArray[np.int64], positions: NDArray[np.floating], fans: NDArray[np.int64]) -> None:
    """Split concave polygons anew, in place.

    corners: (F, 3, n), the triangles' corners, of which the first number is that of the position. positions: (P, 3).
    fans: (R, 2), the first triangle and the number of triangles of each polygon with more than three corners. Raises
    ``ObjectError`` for a concave polygon with too many corners.
    """
    owner = np.repeat(np.arange(len(fans)), fans[:, 1])
    place = np.arange(len(owner)) - np.repeat(np.cumsum(fans[:, 1]) - fans[:, 1], fans[:, 1])
    a, b, c = np.moveaxis(positions[corners[fans[owner, 0] + place, :, 0]].astype(np.float64), 1, 0)
    areas = np.cross(b - a, c - a)
    normals = np.stack([np.bincount(owner, areas[:, axis], len(fans)) for axis in range(3)], axis=1)
    along = np.einsum("ij,ij->i", areas, normals[owner])
    folded = along < -FOLD * np.einsum("ij,ij->i", normals, normals)[owner]
    for ring in np.unique(owner[folded]):
        first, count = fans[ring]
        if count > MAX_CONCAVE - 2:
            raise ObjectError(
                f"The mesh has a concave polygon with {count + 2} corners; at most {MAX_CONCAVE} are read. Split it "
                "into triangles in a modelling program."
            )
        fan = corners[first : first + count]
        ring_corners = np.concatenate([fan[0, :2], fan[:, 2]])
        flat = _flattened(positions[ring_corners[:, 0]].astype(np.float64), normals[ring])
        corners[first : first + count] = ring_corners[_ears(flat)]


def _flattened(points: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 3) in the plane with a normal, (n, 2), counter-clockwise as seen from its tip."""
    right = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    plane = np.stack([right, np.cross(normal, right)], axis=1) / np.square(normal).sum()
    return np.asarray((points - points[0]) @ plane)


def _ears(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Triangles (n - 2, 3) of a polygon (n, 2), cut off one by one; a fan of what has no ear, as it crosses itself."""
    left, triangles = list(range(len(points))), []
    while len(left) > 3 and (ear := next((k for k in range(len(left)) if _is_ear(points, left, k)), None)) is not None:
        triangles.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    triangles += [(left[0], left[k], left[k + 1]) for k in range(1, len(left) - 1)]
    return np.array(triangles)


def _is_ear(points: NDArray[np.float64], left: Sequence[int], k: int) -> bool:
    """Whether corner ``k`` is convex and its triangle holds no other corner."""
    triangle = points[[left[k - 1], left[k], left[(k + 1) % len(left)]]]
    edges = np.roll(triangle, -1, axis=0) - triangle
    to = points[left][:, None] - triangle  # (n, 3, 2)
    inside = (edges[:, 0] * to[..., 1] - edges[:, 1] * to[..., 0] > 0).all(axis=1).any()
    return bool(np.linalg.det(edges[:2]) >= 0 and not inside)
