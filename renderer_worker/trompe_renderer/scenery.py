"""What a picture shows: objects in the world, the lights on them, the camera. Values only, no OpenGL."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.model import Model

__all__ = ["Color", "DirectionalLight", "Matrix", "Placement", "Scenery"]

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
class Placement:
    """An object in the world: ``pose`` (4, 4) takes its coordinates to the world's."""

    model: Model
    pose: Matrix


@dataclass(frozen=True)
class Scenery:
    """All that a picture shows. ``camera`` (4, 4) is camera-to-world, OpenGL; colours in [0, 1]."""

    placements: tuple[Placement, ...]
    camera: Matrix
    lights: tuple[DirectionalLight, ...]
    ambient: Color
    background: Color
