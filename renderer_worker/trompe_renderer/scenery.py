"""What a picture shows: objects in the world, the lights on them, the camera. Values only, no OpenGL."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.model import Model

__all__ = [
    "Backdrop",
    "Color",
    "DirectionalLight",
    "Matrix",
    "Photograph",
    "Placement",
    "PointLight",
    "Scenery",
    "Sky",
    "viewing",
]

Matrix = NDArray[np.float64]
Color = tuple[float, float, float]


@dataclass(frozen=True)
class DirectionalLight:
    """Light that travels along ``direction`` (3,); ``color`` in [0, 1], linear.

    At ``intensity`` 1 a white matt surface that faces the light reflects white.
    """

    direction: Matrix
    color: Color
    intensity: float


@dataclass(frozen=True)
class PointLight:
    """Light that leaves ``position`` (3,) in all directions and casts no shadow; ``color`` in [0, 1], linear.

    At ``intensity`` 1 a white matt surface that faces the light one metre away reflects white; light falls with the
    square of the distance.
    """

    position: Matrix
    color: Color
    intensity: float


@dataclass(frozen=True)
class Placement:
    """An object in the world: ``pose`` (4, 4) takes its coordinates to the world's.

    ``number`` tells instances apart (0 stands for nothing), ``category`` is what kind of thing it is, 0 to 255.
    """

    model: Model
    pose: Matrix
    number: int
    category: int


@dataclass(frozen=True)
class Sky:
    """A clear sky over a grey ground, both infinitely far away."""


@dataclass(frozen=True)
class Photograph:
    """A picture of the image's size that shows where no object is, as a right-handed camera sees it.

    ``pixels`` (H, W, 3) uint8, sRGB, row 0 on top; ``key`` is another for other pixels.
    """

    key: str
    pixels: NDArray[np.uint8] = field(compare=False, repr=False)


Backdrop = Color | Sky | Photograph
"""What stands behind all objects; a colour is sRGB, in [0, 1]."""


@dataclass(frozen=True)
class Scenery:
    """All that a picture shows. ``camera`` (4, 4) is camera-to-world, OpenGL; ``ambient`` in [0, 1], linear.

    Two pictures belong to one motion if their ``take`` is the same.
    """

    placements: tuple[Placement, ...]
    camera: Matrix
    lights: tuple[DirectionalLight | PointLight, ...]
    ambient: Color
    backdrop: Backdrop
    take: int = 0

    @property
    def poses(self) -> Mapping[int, Matrix]:
        """Where each instance stands, by its number."""
        return {placement.number: placement.pose for placement in self.placements}


def viewing(camera: Matrix, projection: Matrix) -> Matrix:
    """(4, 4) from the world to clip space."""
    return np.asarray(projection @ np.linalg.inv(camera))
