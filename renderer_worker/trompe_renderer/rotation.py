"""Rotations as unit quaternions (w, x, y, z), so that there is a way from one to another."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["about", "between", "from_euler", "product", "to_matrix"]

Array = NDArray[np.float64]

_AXES: Final = np.eye(3)


def about(axis: ArrayLike, angle: float) -> Array:
    """By ``angle`` (radians) about the unit vector ``axis``."""
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.asarray(axis))])


def product(second: Array, first: Array) -> Array:
    """``first``, then ``second``."""
    (a, u), (b, v) = (second[0], second[1:]), (first[0], first[1:])
    return np.array([a * b - u @ v, *(a * v + b * u + np.cross(u, v))])


def from_euler(degrees: ArrayLike) -> Array:
    """Unity's Euler angles (x, y, z): z first, then x, then y; as ``trompe_shared.geometry.euler_to_matrix``."""
    x, y, z = (about(axis, angle) for axis, angle in zip(_AXES, np.radians(degrees), strict=True))
    return product(y, product(x, z))


def between(start: Array, end: Array, share: float) -> Array:
    """The rotation at ``share`` in [0, 1] of the shortest way from ``start`` to ``end``, at even speed."""
    end = end if start @ end >= 0 else -end
    angle = float(np.arccos(np.clip(start @ end, -1.0, 1.0)))
    if angle < 1e-6:
        return start
    return np.asarray((np.sin((1 - share) * angle) * start + np.sin(share * angle) * end) / np.sin(angle))


def to_matrix(turn: Array) -> Array:
    """(3, 3)."""
    w, x, y, z = turn / np.linalg.norm(turn)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
