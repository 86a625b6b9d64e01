"""The commands that read and set lights."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from trompe_renderer.world.lights import WorldLight
from trompe_renderer.world.validation import WHITE, Ints, Vector, checked_color, checked_number, checked_vector
from trompe_shared.errors import RendererError
from trompe_shared.sailenv import LIGHT_NOT_FOUND


def _checked_direction(value: Vector) -> Vector:
    direction = checked_vector(value, "direction")
    if np.linalg.norm(direction) < 1e-6:
        raise RendererError("A light's direction must not be zero.")
    return direction


def _commands(setting: str, check: Callable[[Any], Any]) -> tuple[Callable[..., tuple[Any]], Callable[..., None]]:
    """The methods that read and set a field of ``WorldLight``; ``check`` raises ``RendererError``."""

    def get(self: "LightCommands", *, light: str) -> tuple[Any]:
        return (getattr(self._light(light), setting),)

    def put(self: "LightCommands", *, light: str, **value: Any) -> None:
        self._lights[light] = replace(self._light(light), **{setting: check(value[setting])})

    return get, put


class LightCommands:
    """The part of ``Session`` for lights."""

    def __init__(self) -> None:
        self._lights: dict[str, WorldLight] = {}
        self._ambient: Ints = WHITE

    def _reset_lights(self, lights: Mapping[str, WorldLight], ambient: Ints) -> None:
        self._lights, self._ambient = dict(lights), ambient

    def get_ambient_light_color(self) -> tuple[Ints]:
        return (self._ambient,)

    def set_ambient_light_color(self, *, color: Ints) -> None:
        self._ambient = checked_color(color)

    def get_lights_names(self) -> tuple[list[str]]:
        return (list(self._lights),)

    def get_light_type(self, *, light: str) -> tuple[str]:
        return (self._light(light).kind,)

    get_light_color, set_light_color = _commands("color", checked_color)
    get_light_intensity, set_light_intensity = _commands(
        "intensity", partial(checked_number, what="light's intensity", low=0.0)
    )
    get_light_indirect_multiplier, set_light_indirect_multiplier = _commands(
        "multiplier", partial(checked_number, what="light's indirect multiplier", low=0.0)
    )
    get_light_position, set_light_position = _commands("position", partial(checked_vector, what="position"))
    get_light_direction, set_light_direction = _commands("direction", _checked_direction)

    def _light(self, name: str) -> WorldLight:
        if name not in self._lights:
            raise RendererError(f"{LIGHT_NOT_FOUND}: there is no light {name!r}; choose one of {list(self._lights)}.")
        return self._lights[name]
