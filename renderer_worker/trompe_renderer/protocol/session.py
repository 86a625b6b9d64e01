"""The state of one agent: scene, camera, lights, background. No sockets, no OpenGL, no clock.

Each method answers the command of its name in ``trompe_shared.sailenv.COMMANDS`` with the values of the reply, if any.
It refuses with a ``TrompeError`` whose message becomes the reason.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from trompe_renderer.protocol.object_commands import ObjectCommands
from trompe_renderer.protocol.upload import ModelCache
from trompe_renderer.world.movement import frustum_walls
from trompe_renderer.world.objects import ObjectRequest
from trompe_renderer.world.scenario import read_scenario
from trompe_renderer.world.scenes import OBJECT_VIEW, SceneSetup, scene_named
from trompe_renderer.world.snapshot import Matrix, Sky, Snapshot, WorldLight
from trompe_renderer.world.validation import Ints, Vector, checked_color, checked_number, checked_vector, unit_color
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError, TrompeError
from trompe_shared.geometry import FIELD_OF_VIEW, unity_to_opengl_rotation
from trompe_shared.sailenv import EXTENSIONS, LIGHT_NOT_FOUND

FRUSTUM_NEAR: Final = 0.3
FRUSTUM_FAR: Final = 15.0
"""Metres; the values in SAILenv's git client."""


def _checked_direction(value: Vector) -> Vector:
    direction = checked_vector(value, "direction")
    if np.linalg.norm(direction) < 1e-6:
        raise RendererError("A light's direction must not be zero.")
    return direction


def _commands(setting: str, check: Callable[[Any], Any]) -> tuple[Callable[..., tuple[Any]], Callable[..., None]]:
    """The methods that read and set a field of ``WorldLight``; ``check`` raises ``RendererError``."""

    def get(self: "Session", *, light: str) -> tuple[Any]:
        return (getattr(self._light(light), setting),)

    def put(self: "Session", *, light: str, **value: Any) -> None:
        self._lights[light] = replace(self._light(light), **{setting: check(value[setting])})

    return get, put


class Session(ObjectCommands):
    """State and answers for one agent, used by one thread. ``size`` is (width, height) of its images, pixels."""

    def __init__(self, cache: ModelCache, engine: EngineInfo) -> None:
        super().__init__(cache)
        self.size = (1, 1)
        self._engine = engine
        self._sequence = self._noise = 0
        self._error = ""
        self._refusals: list[str] = []
        self.change_scene(scene=OBJECT_VIEW)

    def _load(self, scene: SceneSetup) -> None:
        """Restart in ``scene``; the camera stays."""
        self._sequence += 1
        self._lights, self._ambient = dict(scene.lights), scene.ambient
        self._reset_objects(scene.static_objects, scene.walls)
        self._background = scene.background

    def snapshot(self) -> Snapshot:
        """The world as the agent's camera sees it now."""
        return Snapshot(
            instances=self._instances(),
            camera=self._camera(),
            lights=tuple(light for light in self._lights.values() if light.intensity > 0),
            ambient=unit_color(self._ambient),
            background=self._background,
            sequence=self._sequence,
            noise=self._noise,
        )

    def _camera(self) -> Matrix:
        camera = np.eye(4)
        camera[:3, :3] = unity_to_opengl_rotation(np.array(self._rotation))
        camera[:3, 3] = self._position
        return camera

    def note_refusal(self, reason: str) -> None:
        """Store the reason of a refusal for LAST_ERROR."""
        self._error = reason

    def take_refusals(self) -> list[str]:
        """Reasons of the refusals within the last command, which did the rest."""
        refusals, self._refusals = self._refusals, []
        return refusals

    def last_error(self) -> tuple[str]:
        reason, self._error = self._error, ""
        return (reason,)

    def change_scene(self, *, scene: str) -> None:
        setup = scene_named(scene)
        self._load(setup)
        self._position, self._rotation = setup.position, setup.rotation

    def load_scenario(self, *, scenario: Mapping[str, Any]) -> tuple[str, ...]:
        """Load a scene and spawn objects; the camera stays. Answers an id for each object, "" for a refused one."""
        script = read_scenario(scenario)
        self._load(scene_named(script.scene))
        if script.frustum_far is not None:
            self._set_frustum(script.frustum_far)
        return tuple(map(self._enter, script.objects))

    def _enter(self, item: ObjectRequest | str) -> str:
        try:
            if isinstance(item, str):
                raise RendererError(item)
            return self._spawn(item)
        except TrompeError as error:
            self._refusals.append(str(error))
            return ""

    def spawn_view_frustum(self) -> None:
        """Make moving objects bounce off the camera's present view frustum."""
        self._set_frustum(FRUSTUM_FAR)

    def _set_frustum(self, far: float) -> None:
        aspect = self.size[0] / self.size[1]
        self._frustum = frustum_walls(
            self._camera(), field_of_view=FIELD_OF_VIEW, aspect=aspect, near=FRUSTUM_NEAR, far=far
        )

    def get_position(self) -> tuple[Vector]:
        return (self._position,)

    def set_position(self, *, position: Vector) -> None:
        self._position = checked_vector(position, "position")

    def get_rotation(self) -> tuple[Vector]:
        return (self._rotation,)

    def set_rotation(self, *, rotation: Vector) -> None:
        self._rotation = checked_vector(rotation, "rotation")

    def toggle_follow(self) -> None:
        """No effect: it concerns Unity's window on the screen."""

    def set_clear_color(self, *, color: Ints) -> None:
        """Set the background: a colour, or the sky if any number is negative."""
        self._background = Sky() if min(color) < 0 else unit_color(checked_color(color))

    def set_noise(self, *, number: int) -> None:
        self._noise = number

    def get_ambient_light_color(self) -> tuple[Ints]:
        return (self._ambient,)

    def set_ambient_light_color(self, *, color: Ints) -> None:
        self._ambient = checked_color(color)

    def get_lights_names(self) -> tuple[list[str]]:
        return (list(self._lights),)

    def get_light_type(self, *, light: str) -> tuple[str]:
        return (self._engine.to_text() if light == EXTENSIONS else self._light(light).kind,)

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
