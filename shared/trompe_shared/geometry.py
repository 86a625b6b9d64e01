"""Cameras, lights and views, and their translation to SAILenv's left-handed world and back.

Conventions of all of Trompe: right-handed world, y up, metres, degrees, the object as authored. A camera stands at
``centre + d * (cos e sin a, sin e, cos e cos a)`` and looks at ``centre``; its vertical field of view is 60 degrees.
SAILenv (Unity) is left-handed: it uses the same positions, poses its camera by Euler angles, and shows the mirror image
of a right-handed renderer's picture.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Integral
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_shared.errors import SpecError

FIELD_OF_VIEW: Final = 60.0
"""Vertical field of view of every camera, degrees."""


Matrix = NDArray[np.float64]


def spherical(azimuth: float, elevation: float) -> Matrix:
    """Unit vector (3,) from the origin towards (azimuth, elevation), degrees."""
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])


def look_rotation(azimuth: float, elevation: float, roll: float = 0.0) -> Matrix:
    """Camera-to-world rotation (3, 3) of an OpenGL camera at (azimuth, elevation): columns right, up, back.

    ``roll`` as in ``Camera``. The closed form is well defined straight above and below the object, too.
    """
    a, e = np.radians(azimuth), np.radians(elevation)
    right = [np.cos(a), 0.0, -np.sin(a)]
    up = [-np.sin(e) * np.sin(a), np.cos(e), -np.sin(e) * np.cos(a)]
    upright = np.stack([right, up, spherical(azimuth, elevation)], axis=1)
    return upright @ _turn(roll) if roll else upright


def _turn(degrees: float) -> Matrix:
    """Rotation (3, 3) about z, from x towards y."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Camera:
    """A camera that looks at ``centre`` (x, y, z), metres, from ``distance`` metres; angles in degrees.

    ``roll`` turns the camera counter-clockwise about its line of sight, so the object turns clockwise in the image.
    """

    distance: float
    azimuth: float
    elevation: float
    roll: float = 0.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def position(self) -> Matrix:
        """World position (3,), metres."""
        return np.asarray(self.distance * spherical(self.azimuth, self.elevation) + self.centre)

    def world_to_camera(self) -> Matrix:
        """Rigid transform (4, 4) from world to OpenGL camera coordinates (x right, y up, looks along -z)."""
        rotation = look_rotation(self.azimuth, self.elevation, self.roll).T
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = -rotation @ self.position()
        return matrix


@dataclass(frozen=True)
class Light:
    """A directional light from (azimuth, elevation), degrees, plus ambient light.

    intensity: at 1.0 a white matt surface that faces the light reflects white, without ambient light.
    ambient: light from all sides as a share of white, in [0, 1].
    colour: of the directional light, linear, 0 to 255 as in SAILenv; another one raises ``SpecError``.
    """

    azimuth: float = 0.0
    elevation: float = 75.0
    intensity: float = 1.25
    ambient: float = 0.5
    colour: tuple[int, int, int] = (255, 255, 255)

    def __post_init__(self) -> None:
        _check_colour("The colour of a light", self.colour)


@dataclass(frozen=True)
class View:
    """One camera with one light.

    background: sRGB colour, 0 to 255; another one raises ``SpecError``.
    backdrop: name of a picture that replaces the background colour.
    noise: number of the noise in the picture of a renderer that is not deterministic; others ignore it.
    """

    camera: Camera
    light: Light = field(default_factory=Light)
    background: tuple[int, int, int] = (255, 255, 255)
    backdrop: str | None = None
    noise: int = 0

    def __post_init__(self) -> None:
        _check_colour("The background of a view", self.background)


def _check_colour(name: str, colour: Sequence[object]) -> None:
    if not (len(colour) == 3 and all(isinstance(level, Integral) and level in range(256) for level in colour)):
        raise SpecError(f"{name} must be three whole numbers from 0 to 255, got {tuple(colour)}.")


def sailenv_pose(camera: Camera) -> tuple[Matrix, Matrix]:
    """Position (3,), metres, and Euler angles (3,), degrees, for SAILenv's SET_POSITION and SET_ROTATION."""
    return camera.position(), np.array([180.0 - camera.elevation, camera.azimuth, 180.0 - camera.roll])


def euler_to_matrix(degrees: Matrix) -> Matrix:
    """Rotation (3, 3) of Unity's Euler angles (x, y, z) in degrees: z first, then x, then y."""
    x, y, _ = np.radians(np.asarray(degrees, dtype=np.float64))
    cx, sx, cy, sy = np.cos(x), np.sin(x), np.cos(y), np.sin(y)
    rotate_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    rotate_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.asarray(rotate_y @ rotate_x @ _turn(degrees[2]))


def unity_to_opengl_rotation(degrees: Matrix) -> Matrix:
    """Camera-to-world rotation (3, 3) of an OpenGL camera that replaces Unity's at Euler angles ``degrees`` (3,).

    Unity looks along +z in a left-handed world. The right-handed picture is the mirror image of Unity's.
    """
    rotation = euler_to_matrix(degrees)
    return np.stack([-rotation[:, 0], rotation[:, 1], -rotation[:, 2]], axis=1)


def light_travel_direction(light: Light) -> Matrix:
    """Unit vector (3,) of the light's travel, for SAILenv's SET_LIGHT_DIRECTION."""
    return -spherical(light.azimuth, light.elevation)


def framing_distance(radius: float) -> float:
    """Distance, metres, at which a sphere of ``radius``, metres, fills most of the picture from every side."""
    return 1.05 * radius / math.sin(math.radians(FIELD_OF_VIEW / 2))
