"""The lights of an agent's world, and the commands that read and set them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from trompe_renderer.scenery import DirectionalLight, PointLight
from trompe_renderer.values import Ints, Vector, checked_color, checked_number, checked_vector, unit_color
from trompe_shared.errors import RendererError
from trompe_shared.geometry import Light, light_travel_direction
from trompe_shared.sailenv import LIGHT_NOT_FOUND

__all__ = ["Lamp", "LightCommands", "lamp_of"]

WHITE = (255, 255, 255)


@dataclass(frozen=True)
class Lamp:
    """A light as the protocol speaks of it.

    The direction of a point light and the position of a directional one are kept and change nothing, nor does
    ``multiplier``: there is no light that has bounced.
    """

    direction: Vector
    intensity: float
    color: Ints = WHITE
    position: Vector = (0.0, 3.0, 0.0)
    multiplier: float = 1.0
    kind: Literal["Directional", "Point"] = "Directional"

    def light(self) -> DirectionalLight | PointLight:
        """The light that the engine knows."""
        color = unit_color(self.color)
        if self.kind == "Point":
            return PointLight(np.array(self.position), color, self.intensity)
        return DirectionalLight(np.array(self.direction), color, self.intensity)


def lamp_of(light: Light) -> Lamp:
    """A white directional lamp that stands for ``light``."""
    return Lamp(checked_vector(light_travel_direction(light).tolist(), "direction"), light.intensity)


class LightCommands:
    """What an agent may ask of its lights; a part of ``Session``."""

    def __init__(self) -> None:
        self._lamps: dict[str, Lamp] = {}
        self._ambient: Ints = WHITE

    def _light_up(self, lamps: Mapping[str, Lamp], ambient: Ints) -> None:
        self._lamps, self._ambient = dict(lamps), ambient

    def get_ambient_light_color(self) -> tuple[Ints]:
        return (self._ambient,)

    def set_ambient_light_color(self, *, color: Ints) -> tuple[()]:
        self._ambient = checked_color(color)
        return ()

    def get_lights_names(self) -> tuple[list[str]]:
        return (list(self._lamps),)

    def get_light_type(self, *, light: str) -> tuple[str]:
        return (self._lamp(light).kind,)

    def get_light_color(self, *, light: str) -> tuple[Ints]:
        return (self._lamp(light).color,)

    def set_light_color(self, *, light: str, color: Ints) -> tuple[()]:
        return self._change(light, color=checked_color(color))

    def get_light_intensity(self, *, light: str) -> tuple[float]:
        return (self._lamp(light).intensity,)

    def set_light_intensity(self, *, light: str, intensity: float) -> tuple[()]:
        return self._change(light, intensity=checked_number(intensity, "light's intensity", low=0.0))

    def get_light_indirect_multiplier(self, *, light: str) -> tuple[float]:
        return (self._lamp(light).multiplier,)

    def set_light_indirect_multiplier(self, *, light: str, multiplier: float) -> tuple[()]:
        return self._change(light, multiplier=checked_number(multiplier, "light's indirect multiplier", low=0.0))

    def get_light_position(self, *, light: str) -> tuple[Vector]:
        return (self._lamp(light).position,)

    def set_light_position(self, *, light: str, position: Vector) -> tuple[()]:
        return self._change(light, position=checked_vector(position, "position"))

    def get_light_direction(self, *, light: str) -> tuple[Vector]:
        return (self._lamp(light).direction,)

    def set_light_direction(self, *, light: str, direction: Vector) -> tuple[()]:
        if np.linalg.norm(checked_vector(direction, "direction")) < 1e-6:
            raise RendererError("A light's direction must not be zero.")
        return self._change(light, direction=direction)

    def _lamp(self, light: str) -> Lamp:
        if light not in self._lamps:
            raise RendererError(f"{LIGHT_NOT_FOUND}: there is no light {light!r}; choose one of {list(self._lamps)}.")
        return self._lamps[light]

    def _change(self, light: str, **values: Any) -> tuple[()]:
        self._lamps[light] = replace(self._lamp(light), **values)
        return ()
