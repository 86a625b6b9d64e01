"""A snapshot of the world: objects, lights and camera of one picture. Values only."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.world.lights import WorldLight
from trompe_renderer.world.model import HashedModel

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
