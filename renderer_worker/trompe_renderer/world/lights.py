"""Lights of the world."""

from dataclasses import dataclass
from typing import Literal

from trompe_renderer.world.validation import WHITE, Ints, Vector, checked_vector
from trompe_shared.geometry import Light, light_travel_direction


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
        """White directional light like ``light``."""
        return cls(checked_vector(light_travel_direction(light).tolist(), "direction"), light.intensity)
