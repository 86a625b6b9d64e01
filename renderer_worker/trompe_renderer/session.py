"""One agent's state: where its camera is, what it has lit, uploaded and spawned. No sockets, no OpenGL.

Each method answers the command of its name in ``trompe_shared.sailenv.COMMANDS`` with the values of the reply, and
refuses by raising a ``TrompeError`` whose message becomes the reason.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.model import Library, Model, content_key
from trompe_renderer.scenery import Color, DirectionalLight, Placement, Scenery
from trompe_shared.errors import RendererError
from trompe_shared.geometry import Light, euler_to_matrix, light_travel_direction, unity_to_opengl_rotation
from trompe_shared.sailenv import LIGHT_NOT_FOUND, MAIN_LIGHT, RIM_LIGHT

__all__ = ["Session"]

SCENE: Final = "object_view/scene"
FILE_PREFIX: Final = "file:"
MAX_SPAWNED: Final = 64
MAX_STORED_BYTES: Final = 64 * 2**20
WHITE: Final = (255, 255, 255)

Vector = tuple[float, float, float]
Ints = tuple[int, int, int]


@dataclass(frozen=True)
class _Lamp:
    """A directional light as the protocol speaks of it. ``position`` and ``multiplier`` are kept and change nothing."""

    direction: Vector
    intensity: float
    color: Ints = WHITE
    position: Vector = (0.0, 3.0, 0.0)
    multiplier: float = 1.0


@dataclass(frozen=True)
class _Instance:
    model: Model
    position: Vector
    rotation: Vector
    scale: Vector

    def pose(self) -> NDArray[np.float64]:
        matrix = np.eye(4)
        matrix[:3, :3] = euler_to_matrix(np.array(self.rotation)) * np.array(self.scale)
        matrix[:3, 3] = self.position
        return matrix


def _default_lamps() -> dict[str, _Lamp]:
    main = Light()
    behind = replace(main, azimuth=180.0, elevation=30.0, intensity=0.0)
    return {name: _Lamp(_travel(light), light.intensity) for name, light in ((MAIN_LIGHT, main), (RIM_LIGHT, behind))}


def _travel(light: Light) -> Vector:
    return _vector(light_travel_direction(light).tolist(), "direction")


class Session:
    """State and answers for one agent; used by one thread."""

    def __init__(self, library: Library) -> None:
        self._library = library
        self._uploads: dict[str, bytes] = {}
        self._error = ""
        self._reset()

    def _reset(self) -> None:
        self._position: Vector = (0.0, 0.0, 0.0)
        self._rotation: Vector = (0.0, 0.0, 0.0)
        self._clear: Ints = WHITE
        self._ambient: Ints = (128, 128, 128)
        self._lamps = _default_lamps()
        self._spawned: dict[int, _Instance] = {}
        self._spawns = 0

    def scenery(self) -> Scenery:
        """What the agent's camera sees, for the engine."""
        camera = np.eye(4)
        camera[:3, :3] = unity_to_opengl_rotation(np.array(self._rotation))
        camera[:3, 3] = self._position
        lit = [lamp for lamp in self._lamps.values() if lamp.intensity > 0]
        return Scenery(
            placements=tuple(Placement(item.model, item.pose()) for item in self._spawned.values()),
            camera=camera,
            lights=tuple(DirectionalLight(np.array(x.direction), _unit(x.color), x.intensity) for x in lit),
            ambient=_unit(self._ambient),
            background=_unit(self._clear),
        )

    def note_refusal(self, reason: str) -> None:
        """Keep the reason of a refusal for ``last_error``."""
        self._error = reason

    def last_error(self) -> tuple[str]:
        reason, self._error = self._error, ""
        return (reason,)

    @property
    def scenes(self) -> list[str]:
        """Names of the scenes there are."""
        return [SCENE]

    def change_scene(self, *, scene: str) -> tuple[()]:
        if scene != SCENE:
            raise RendererError(f"There is no scene {scene!r}; choose {SCENE!r}.")
        self._reset()
        return ()

    def get_categories(self) -> tuple[list[tuple[int, str]]]:
        return ([(0, "none")],)

    def get_position(self) -> tuple[Vector]:
        return (self._position,)

    def set_position(self, *, position: Vector) -> tuple[()]:
        self._position = _vector(position, "position")
        return ()

    def get_rotation(self) -> tuple[Vector]:
        return (self._rotation,)

    def set_rotation(self, *, rotation: Vector) -> tuple[()]:
        self._rotation = _vector(rotation, "rotation")
        return ()

    def toggle_follow(self) -> tuple[()]:
        return ()

    def send_obj_zip(self, *, file: tuple[str, bytes]) -> tuple[str]:
        """Keep an archive and answer a path that SPAWN_OBJECT takes; the oldest go when an agent keeps too much."""
        data = file[1]
        path = content_key(data)
        self._uploads.pop(path, None)
        self._uploads[path] = data
        while len(self._uploads) > 1 and sum(map(len, self._uploads.values())) > MAX_STORED_BYTES:
            self._uploads.pop(next(iter(self._uploads)))
        return (path,)

    def spawn_object(
        self, *, name: str, position: Vector, rotation: Vector, scale: Vector, **_dynamics: Any
    ) -> tuple[str]:
        """Put an uploaded object into the world. Nothing moves here: what a client says of dynamics is ignored."""
        path = name.removeprefix(FILE_PREFIX)
        if not name.startswith(FILE_PREFIX) or path not in self._uploads:
            raise RendererError(
                f"There is no object {name!r}; send a zip and spawn '{FILE_PREFIX}' + the path answered."
            )
        if len(self._spawned) >= MAX_SPAWNED:
            raise RendererError(f"{MAX_SPAWNED} objects are spawned; despawn one first.")
        if not all(0 < x < 1e6 for x in scale):
            raise RendererError(f"A scale must be positive, got {scale}.")
        placed = _vector(position, "position"), _vector(rotation, "rotation"), _vector(scale, "scale")
        instance = _Instance(self._library.read(path, self._uploads[path]), *placed)
        self._spawns += 1
        self._spawned[self._spawns] = instance
        return (str(self._spawns),)

    def despawn_object(self, *, instance: int) -> tuple[()]:
        self._spawned_object(instance)
        del self._spawned[instance]
        return ()

    def move_object(self, *, instance: int, position: Vector, rotation: Vector) -> tuple[()]:
        self._spawned[instance] = replace(
            self._spawned_object(instance),
            position=_vector(position, "position"),
            rotation=_vector(rotation, "rotation"),
        )
        return ()

    def _spawned_object(self, instance: int) -> _Instance:
        if instance not in self._spawned:
            raise RendererError(f"No object {instance} is spawned; there are {sorted(self._spawned)}.")
        return self._spawned[instance]

    def get_spawnable_objects_names(self) -> tuple[Sequence[str]]:
        return ([],)

    def spawn_view_frustum(self) -> tuple[()]:
        return ()

    def set_clear_color(self, *, color: Ints) -> tuple[()]:
        """Background colour; any negative number asks for a sky, which is white here."""
        self._clear = WHITE if min(color) < 0 else _color(color)
        return ()

    def get_ambient_light_color(self) -> tuple[Ints]:
        return (self._ambient,)

    def set_ambient_light_color(self, *, color: Ints) -> tuple[()]:
        self._ambient = _color(color)
        return ()

    def get_lights_names(self) -> tuple[list[str]]:
        return (list(self._lamps),)

    def get_light_type(self, *, light: str) -> tuple[str]:
        self._lamp(light)
        return ("Directional",)

    def get_light_color(self, *, light: str) -> tuple[Ints]:
        return (self._lamp(light).color,)

    def set_light_color(self, *, light: str, color: Ints) -> tuple[()]:
        return self._change(light, color=_color(color))

    def get_light_intensity(self, *, light: str) -> tuple[float]:
        return (self._lamp(light).intensity,)

    def set_light_intensity(self, *, light: str, intensity: float) -> tuple[()]:
        if not 0 <= intensity < 1e6:
            raise RendererError(f"A light's intensity must be 0 or more, got {intensity}.")
        return self._change(light, intensity=intensity)

    def get_light_indirect_multiplier(self, *, light: str) -> tuple[float]:
        return (self._lamp(light).multiplier,)

    def set_light_indirect_multiplier(self, *, light: str, multiplier: float) -> tuple[()]:
        return self._change(light, multiplier=multiplier)

    def get_light_position(self, *, light: str) -> tuple[Vector]:
        return (self._lamp(light).position,)

    def set_light_position(self, *, light: str, position: Vector) -> tuple[()]:
        return self._change(light, position=_vector(position, "position"))

    def get_light_direction(self, *, light: str) -> tuple[Vector]:
        return (self._lamp(light).direction,)

    def set_light_direction(self, *, light: str, direction: Vector) -> tuple[()]:
        if np.linalg.norm(_vector(direction, "direction")) < 1e-6:
            raise RendererError("A light's direction must not be zero.")
        return self._change(light, direction=direction)

    def _lamp(self, light: str) -> _Lamp:
        if light not in self._lamps:
            raise RendererError(f"{LIGHT_NOT_FOUND}: there is no light {light!r}; choose one of {list(self._lamps)}.")
        return self._lamps[light]

    def _change(self, light: str, **values: Any) -> tuple[()]:
        self._lamps[light] = replace(self._lamp(light), **values)
        return ()


def _vector(values: Sequence[float], what: str) -> Vector:
    x, y, z = (float(value) for value in values)
    if not all(abs(value) < 1e6 for value in (x, y, z)):
        raise RendererError(f"A {what} must be three finite numbers, got {tuple(values)}.")
    return (x, y, z)


def _color(values: Ints) -> Ints:
    if not all(0 <= value <= 255 for value in values):
        raise RendererError(f"A colour must be three integers from 0 to 255, got {tuple(values)}.")
    return values


def _unit(color: Ints) -> Color:
    red, green, blue = (value / 255.0 for value in color)
    return (red, green, blue)
