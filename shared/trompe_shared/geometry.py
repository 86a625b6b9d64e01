"""Cameras, lights and views, and their translation to SAILenv's left-handed world and back.

Conventions (used everywhere in Trompe): right-handed world, y up, metres, angles in degrees, the
object at the origin. A camera sits at ``d * (cos e sin a, sin e, cos e cos a)`` and looks at the origin; its
vertical field of view is 60 degrees. SAILenv (Unity) is left-handed: it uses the same position numbers, poses its
camera by Euler angles, and shows the mirror image of what a right-handed renderer shows.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "FIELD_OF_VIEW",
    "Camera",
    "Light",
    "View",
    "direction_to_angles",
    "euler_to_matrix",
    "light_travel_direction",
    "look_rotation",
    "sailenv_pose",
    "spherical",
    "unity_to_opengl_rotation",
]

FIELD_OF_VIEW: Final = 60.0
"""Vertical field of view of every camera, degrees."""

Matrix = NDArray[np.float64]


def spherical(azimuth: float, elevation: float) -> Matrix:
    """Unit vector (3,) that points from the origin to (azimuth, elevation), both in degrees."""
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])


def look_rotation(azimuth: float, elevation: float) -> Matrix:
    """Camera-to-world rotation (3, 3) of an OpenGL camera at (azimuth, elevation): columns right, up, back.

    Closed form, so that it is well defined straight above and below the object (|elevation| = 90) too.
    """
    a, e = np.radians(azimuth), np.radians(elevation)
    right = [np.cos(a), 0.0, -np.sin(a)]
    up = [-np.sin(e) * np.sin(a), np.cos(e), -np.sin(e) * np.cos(a)]
    return np.stack([right, up, spherical(azimuth, elevation)], axis=1)


@dataclass(frozen=True)
class Camera:
    """A camera that looks at the origin. ``distance`` in metres, ``azimuth`` and ``elevation`` in degrees."""

    distance: float
    azimuth: float
    elevation: float

    def position(self) -> Matrix:
        """World position (3,), metres."""
        return self.distance * spherical(self.azimuth, self.elevation)

    def world_to_camera(self) -> Matrix:
        """Rigid transform (4, 4) from world to OpenGL camera coordinates (x right, y up, looks along -z)."""
        rotation = look_rotation(self.azimuth, self.elevation).T
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = -rotation @ self.position()
        return matrix


@dataclass(frozen=True)
class Light:
    """A directional light that shines from (azimuth, elevation), plus ambient light.

    ``intensity`` is relative: at 1.0 a white matt surface that faces the light reflects white, before ambient is added.
    ``ambient`` is the share of white that reaches every surface from everywhere, in [0, 1].
    """

    azimuth: float = 0.0
    elevation: float = 75.0
    intensity: float = 1.25
    ambient: float = 0.5


@dataclass(frozen=True)
class View:
    """One camera with one light. ``background`` is an sRGB colour, three ints in 0..255."""

    camera: Camera
    light: Light = field(default_factory=Light)
    background: tuple[int, int, int] = (255, 255, 255)


def sailenv_pose(camera: Camera) -> tuple[Matrix, Matrix]:
    """Position (3,) and Euler angles (3,) in degrees, as SAILenv's SET_POSITION and SET_ROTATION want them."""
    return camera.position(), np.array([180.0 - camera.elevation, camera.azimuth, 180.0])


def euler_to_matrix(degrees: Matrix) -> Matrix:
    """Rotation (3, 3) of Unity's Euler angles (x, y, z) in degrees: z first, then x, then y."""
    x, y, z = np.radians(np.asarray(degrees, dtype=np.float64))
    cx, sx, cy, sy, cz, sz = np.cos(x), np.sin(x), np.cos(y), np.sin(y), np.cos(z), np.sin(z)
    rotate_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    rotate_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rotate_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(rotate_y @ rotate_x @ rotate_z)


def unity_to_opengl_rotation(degrees: Matrix) -> Matrix:
    """Camera-to-world rotation (3, 3) of an OpenGL camera that stands in for Unity's at Euler angles ``degrees``.

    Unity looks along +z in a left-handed world. The right-handed picture with this rotation is Unity's, mirrored left-
    right.
    """
    rotation = euler_to_matrix(degrees)
    return np.stack([-rotation[:, 0], rotation[:, 1], -rotation[:, 2]], axis=1)


def light_travel_direction(light: Light) -> Matrix:
    """Unit vector (3,) along which the light travels: SAILenv's SET_LIGHT_DIRECTION."""
    return -spherical(light.azimuth, light.elevation)


def direction_to_angles(direction: Matrix) -> tuple[float, float]:
    """(azimuth, elevation) in degrees of the place a light travelling along ``direction`` shines from.

    Raises ``ValueError`` for a zero or non-finite vector.
    """
    norm = float(np.linalg.norm(direction))
    if not np.isfinite(norm) or norm < 1e-12:
        raise ValueError(f"a light direction must be a finite vector of non-zero length, got {direction!r}")
    x, y, z = -np.asarray(direction, dtype=np.float64) / norm
    return float(np.degrees(np.arctan2(x, z))), float(np.degrees(np.arcsin(np.clip(y, -1.0, 1.0))))
