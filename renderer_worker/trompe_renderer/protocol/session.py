"""The state of one agent: scene, camera, lights, background, objects. No sockets, no OpenGL, no clock.

Each method answers the command of its name in ``trompe_shared.sailenv.COMMANDS`` with the values of the reply, if any.
It refuses with a ``TrompeError`` whose message becomes the reason.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from trompe_renderer.protocol.limits import MIB
from trompe_renderer.protocol.upload import ModelCache
from trompe_renderer.world.model import HashedModel, content_key, repainted
from trompe_renderer.world.movement import NO_WALLS, Pose, frustum_walls, motion_of
from trompe_renderer.world.objects import ObjectRequest, WorldObject
from trompe_renderer.world.scenario import read_scenario
from trompe_renderer.world.scenes import CATEGORIES, OBJECT_VIEW, UPLOADED, SceneSetup, scene_named, shipped_model
from trompe_renderer.world.snapshot import Matrix, Sky, Snapshot, WorldLight
from trompe_renderer.world.validation import Ints, Vector, checked_color, checked_number, checked_vector, unit_color
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError, TrompeError
from trompe_shared.geometry import FIELD_OF_VIEW, unity_to_opengl_rotation
from trompe_shared.sailenv import EXTENSIONS, LIGHT_NOT_FOUND
from trompe_shared.shipped import shipped_objects

FILE_PREFIX: Final = "file:"
MAX_SPAWNED: Final = 64
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


class Session:
    """State and answers for one agent, used by one thread. ``size`` is (width, height) of its images, pixels."""

    def __init__(self, cache: ModelCache, engine: EngineInfo) -> None:
        self.size = (1, 1)
        self._cache, self._limits, self._engine = cache, cache.limits, engine
        self._uploads: dict[str, bytes] = {}
        self._sequence = self._noise = 0
        self._error = ""
        self._refusals: list[TrompeError] = []
        self.change_scene(scene=OBJECT_VIEW)

    def _load(self, scene: SceneSetup) -> None:
        """Restart in ``scene``; the camera stays."""
        self._sequence += 1
        self._lights, self._ambient, self._background = dict(scene.lights), scene.ambient, scene.background
        self._static = tuple(item.instance(number) for number, item in enumerate(scene.static_objects, start=1))
        self._last_number = len(self._static)
        self._spawned: dict[int, WorldObject] = {}
        self._cache.textures.hold(self, 0)
        self._room, self._frustum = scene.walls, NO_WALLS

    def snapshot(self) -> Snapshot:
        """The world as the agent's camera sees it now."""
        return Snapshot(
            instances=self._static + tuple(item.instance(number) for number, item in self._spawned.items()),
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

    def advance(self, seconds: float) -> None:
        """Let time pass for moving objects."""
        for number, item in self._spawned.items():
            if item.motion is not None:
                walls = np.concatenate([self._room, self._frustum]) if item.limited else self._room
                self._spawned[number] = item.after(seconds, walls)

    def note_refusal(self, reason: str) -> None:
        """Store the reason of a refusal for LAST_ERROR."""
        self._error = reason

    def take_refusals(self) -> list[TrompeError]:
        """The refusals within the last command, which did the rest."""
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
            self._refusals.append(error)
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

    def send_obj_zip(self, *, file: tuple[str, bytes]) -> tuple[str]:
        """Store an archive and answer a path for SPAWN_OBJECT. Beyond the limit the oldest archives go."""
        data = file[1]
        path = content_key(data)
        kept = {other: archive for other, archive in self._uploads.items() if other != path} | {path: data}
        while len(kept) > 1 and sum(map(len, kept.values())) > self._limits.uploads:
            kept.pop(next(iter(kept)))
        self._cache.uploads.hold(self, sum(map(len, kept.values())))
        self._uploads = kept
        return (path,)

    def spawn_object(
        self,
        *,
        name: str,
        position: Vector,
        rotation: Vector,
        scale: Vector,
        frustum_limited: bool = True,
        dynamic: tuple[str, str] | None = None,
        **_of_unity: bool,
    ) -> tuple[str]:
        """Add an object. ``remove_dynamics`` and ``use_parent`` have no effect: objects have no physics or parents."""
        if not all(0 < x < 1e6 for x in scale):
            raise RendererError(f"A scale must be three positive numbers below a million, got {scale}.")
        motion = motion_of(*dynamic) if dynamic else None
        pose = _checked_pose(position, rotation)
        return (self._spawn(ObjectRequest(name, pose, scale, motion, limited=frustum_limited)),)

    def despawn_object(self, *, instance: int) -> None:
        self._spawned_object(instance)
        del self._spawned[instance]
        self._cache.textures.hold(self, _texture_size(item.model for item in self._spawned.values()))

    def move_object(self, *, instance: int, position: Vector, rotation: Vector) -> None:
        """Set an object's pose. This ends its own movement."""
        item = self._spawned_object(instance)
        self._spawned[instance] = replace(item, pose=_checked_pose(position, rotation), motion=None)

    def repaint_object(self, *, instance: int, textures: Sequence[tuple[str, tuple[int, int, bytes]]]) -> None:
        painted = self._spawned_object(instance)
        pictures = {name: np.frombuffer(data, np.uint8).reshape(h, w, 3) for name, (h, w, data) in textures}
        model = repainted(painted.model, pictures)
        self._admit(model, instead_of=instance)
        self._spawned[instance] = replace(painted, model=model)

    def _admit(self, model: HashedModel, *, instead_of: int | None = None) -> None:
        """Raise ``RendererError`` if the textures of ``model`` and of all other spawned objects exceed the limit."""
        others = (item.model for number, item in self._spawned.items() if number != instead_of)
        size, limit = _texture_size([model, *others]), self._limits.textures
        if size > limit:
            raise RendererError(f"The spawned objects' textures take more than {limit // MIB} MiB. Despawn some first.")
        self._cache.textures.hold(self, size)

    def get_spawnable_objects_names(self) -> tuple[Sequence[str]]:
        return (list(shipped_objects()),)

    def get_categories(self) -> tuple[list[tuple[int, str]]]:
        return ([(number, name) for name, number in CATEGORIES.items()],)

    def _spawn(self, wanted: ObjectRequest) -> str:
        if len(self._spawned) >= MAX_SPAWNED:
            raise RendererError(f"{MAX_SPAWNED} objects are spawned. Despawn one first.")
        model, category = self._model(wanted.name)
        self._admit(model)
        radius = model.obj.radius * max(wanted.scale) if wanted.motion else 0.0
        placed = (wanted.pose, wanted.scale, wanted.motion, wanted.delay, wanted.limited)
        self._last_number += 1
        self._spawned[self._last_number] = WorldObject(model, category, *placed, radius)
        return str(self._last_number)

    def _model(self, name: str) -> tuple[HashedModel, int]:
        """Model and category of a shipped object by its name, or of an upload by ``file:`` and its path."""
        path = name.removeprefix(FILE_PREFIX)
        if path == name:
            return shipped_model(name), CATEGORIES[name]
        if path not in self._uploads:
            raise RendererError(f"There is no upload {path!r}. Send a zip and spawn 'file:' + the answered path.")
        return self._cache.read(path, self._uploads[path]), CATEGORIES[UPLOADED]

    def _spawned_object(self, instance: int) -> WorldObject:
        if instance not in self._spawned:
            raise RendererError(f"No object {instance} is spawned; there are {sorted(self._spawned)}.")
        return self._spawned[instance]


def _texture_size(models: Iterable[HashedModel]) -> int:
    """Bytes of the textures of all models; one that several share counts once."""
    sizes = {id(texture): texture.nbytes for each in models for texture in each.obj.textures.values()}
    return sum(sizes.values())


def _checked_pose(position: Vector, degrees: Vector) -> Pose:
    return Pose.of(checked_vector(position, "position"), checked_vector(degrees, "rotation"))
