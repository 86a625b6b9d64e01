"""A snapshot of the world: objects, lights and camera of one picture. Values only."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.world.model import HashedModel
from trompe_renderer.world.validation import WHITE, Ints, Vector, checked_vector
from trompe_shared.geometry import Light, light_travel_direction

Matrix = NDArray[np.float64]
Color = tuple[float, float, float]


@dataclass(frozen=True)
class Instance:
    """An object in the world: ``pose`` (4, 4) transforms from object to world coordinates.

    ``number`` identifies the instance (0 is the background), ``category`` is its kind, 0 to 255.
    """

    model: HashedModel
    pose: Matrix
    number: int
    category: int


@dataclass(frozen=True)
class WorldLight:
    """A directional light that travels along ``direction``, or a point light at ``position`` (metres), no shadows.

    At ``intensity`` 1 a white matt surface that faces the light, one metre away from a point light, reflects white. A
    point light falls with the square of the distance. ``color`` is linear, 0 to 255. The direction of a point light,
    the position of a directional light and ``multiplier`` (of indirect light) are stored without effect.
    """

    direction: Vector
    intensity: float
    color: Ints = WHITE
    position: Vector = (0.0, 3.0, 0.0)
    multiplier: float = 1.0
    kind: Literal["Directional", "Point"] = "Directional"

    @classmethod
    def of(cls, light: Light) -> "WorldLight":
        """A directional light like ``light``."""
        direction = checked_vector(light_travel_direction(light).tolist(), "direction")
        return cls(direction, light.intensity, light.colour)


@dataclass(frozen=True)
class Sky:
    """A clear sky over grey ground, both infinitely far away."""


Background = Color | Sky
"""Shown behind all objects; a colour is sRGB in [0, 1]."""


@dataclass(frozen=True)
class Snapshot:
    """The content of one picture. ``camera`` (4, 4) is camera-to-world, OpenGL; ``ambient`` in [0, 1], linear.

    Snapshots of the same ``sequence`` belong to one motion: flow is measured between them. ``noise`` numbers the noise
    of engines that are not deterministic.
    """

    instances: tuple[Instance, ...]
    camera: Matrix
    lights: tuple[WorldLight, ...]
    ambient: Color
    background: Background
    sequence: int = 0
    noise: int = 0
