"""The commands that upload, spawn, move and repaint objects."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from trompe_renderer.protocol.limits import MIB
from trompe_renderer.protocol.upload import ModelCache
from trompe_renderer.world.model import HashedModel, content_key, repainted
from trompe_renderer.world.movement import NO_WALLS, Pose, Walls, motion_of
from trompe_renderer.world.objects import ObjectRequest, WorldObject
from trompe_renderer.world.scenes import CATEGORIES, UPLOADED, shipped_model
from trompe_renderer.world.snapshot import Instance
from trompe_renderer.world.validation import Vector, checked_vector
from trompe_shared.errors import RendererError
from trompe_shared.shipped import shipped_objects

FILE_PREFIX: Final = "file:"
MAX_SPAWNED: Final = 64


class ObjectCommands:
    """The part of ``Session`` for objects."""

    def __init__(self, cache: ModelCache) -> None:
        self._cache, self._limits = cache, cache.limits
        self._uploads: dict[str, bytes] = {}
        self._static: tuple[Instance, ...] = ()
        self._spawned: dict[int, WorldObject] = {}
        self._last_number = 0
        self._room: Walls = NO_WALLS
        self._frustum: Walls = NO_WALLS

    def _reset_objects(self, static_objects: Sequence[WorldObject], room: Walls) -> None:
        self._static = tuple(item.instance(number) for number, item in enumerate(static_objects, start=1))
        self._last_number = len(static_objects)
        self._spawned = {}
        self._cache.textures.hold(self, 0)
        self._room, self._frustum = room, NO_WALLS

    def _instances(self) -> tuple[Instance, ...]:
        return self._static + tuple(item.instance(number) for number, item in self._spawned.items())

    def advance(self, seconds: float) -> None:
        """Let time pass for moving objects."""
        for number, item in self._spawned.items():
            if item.motion is not None:
                walls = np.concatenate([self._room, self._frustum]) if item.limited else self._room
                self._spawned[number] = item.after(seconds, walls)

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
        size, pose = checked_vector(scale, "scale"), _checked_pose(position, rotation)
        return (self._spawn(ObjectRequest(name, pose, size, motion, limited=frustum_limited)),)

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
