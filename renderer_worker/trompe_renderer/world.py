"""The objects that an agent has sent and spawned, how they move as time goes by, and the commands for both."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.dynamics import NO_WALLS, Motion, Place, Walls, motion_of
from trompe_renderer.model import Library, Model, content_key, repainted
from trompe_renderer.rotation import from_euler, to_matrix
from trompe_renderer.scenery import Placement
from trompe_renderer.scenes import CATEGORIES, UPLOADED, Fixture, shipped_model
from trompe_renderer.values import Vector, checked_vector
from trompe_shared.errors import RendererError
from trompe_shared.shipped import shipped_objects

__all__ = ["Instance", "ObjectCommands", "placed"]

FILE_PREFIX: Final = "file:"
MAX_SPAWNED: Final = 64
MAX_STORED_BYTES: Final = 64 * 2**20
MAX_SHOWN_BYTES: Final = 2**30
"""All textures of an agent's spawned objects together."""


@dataclass(frozen=True)
class Instance:
    """A spawned object. It moves once ``delay`` seconds have passed; ``limited`` says whether it stays in view.

    ``radius`` is that of a ball around its origin that it fits in, metres; 0 if it does not move.
    """

    model: Model
    category: int
    place: Place
    scale: Vector
    motion: Motion | None = None
    delay: float = 0.0
    limited: bool = True
    radius: float = 0.0

    def after(self, seconds: float, walls: Walls) -> "Instance":
        """The same object later."""
        if self.motion is None or seconds <= self.delay:
            return replace(self, delay=max(self.delay - seconds, 0.0))
        place, motion = self.motion.moved(self.place, seconds - self.delay, radius=self.radius, walls=walls)
        return replace(self, place=place, motion=motion, delay=0.0)


class ObjectCommands:
    """What an agent may ask of objects; a part of ``Session``."""

    def __init__(self, library: Library) -> None:
        self._library = library
        self._uploads: dict[str, bytes] = {}
        self._fixtures: tuple[Placement, ...] = ()
        self._spawned: dict[int, Instance] = {}
        self._last_number = 0
        self._room: Walls = NO_WALLS
        self._frustum: Walls = NO_WALLS

    def _furnish(self, fixtures: Sequence[Fixture], room: Walls) -> None:
        """Start anew with what belongs to a scene."""
        self._fixtures = tuple(_placement(number, fixture) for number, fixture in enumerate(fixtures, start=1))
        self._last_number = len(fixtures)
        self._spawned = {}
        self._library.textures.hold(self, 0)
        self._room, self._frustum = room, NO_WALLS

    def _placements(self) -> tuple[Placement, ...]:
        return self._fixtures + tuple(_placement(number, item) for number, item in self._spawned.items())

    def _let_pass(self, seconds: float) -> None:
        for number, item in self._spawned.items():
            if item.motion is not None:
                walls = np.concatenate([self._room, self._frustum]) if item.limited else self._room
                self._spawned[number] = item.after(seconds, walls)

    def _spawn(
        self, name: str, place: Place, scale: Vector, *, motion: Motion | None, limited: bool, delay: float = 0.0
    ) -> str:
        if len(self._spawned) >= MAX_SPAWNED:
            raise RendererError(f"{MAX_SPAWNED} objects are spawned; despawn one first.")
        model, category = self._model(name)
        self._admit(model)
        radius = model.obj.radius * max(scale) if motion else 0.0
        self._last_number += 1
        self._spawned[self._last_number] = Instance(model, category, place, scale, motion, delay, limited, radius)
        return str(self._last_number)

    def _model(self, name: str) -> tuple[Model, int]:
        """A spawnable object by its name, or an uploaded one by ``file:`` and its path; and its category."""
        path = name.removeprefix(FILE_PREFIX)
        if path == name:
            return shipped_model(name), CATEGORIES[name]
        if path not in self._uploads:
            raise RendererError(f"There is no upload {path!r}; send a zip and spawn 'file:' + the path answered.")
        return self._library.read(path, self._uploads[path]), CATEGORIES[UPLOADED]

    def send_obj_zip(self, *, file: tuple[str, bytes]) -> tuple[str]:
        """Keep an archive and answer a path that SPAWN_OBJECT takes; the oldest go when an agent keeps too much."""
        data = file[1]
        path = content_key(data)
        kept = {other: archive for other, archive in self._uploads.items() if other != path} | {path: data}
        while len(kept) > 1 and sum(map(len, kept.values())) > MAX_STORED_BYTES:
            kept.pop(next(iter(kept)))
        self._library.uploads.hold(self, sum(map(len, kept.values())))
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
        """Put an object into the world. Nothing here has a movement of its own to remove, or a parent elsewhere."""
        if not all(0 < x < 1e6 for x in scale):
            raise RendererError(f"A scale must be three positive numbers below a million, got {scale}.")
        motion = motion_of(*dynamic) if dynamic else None
        size = checked_vector(scale, "scale")
        return (self._spawn(name, placed(position, rotation), size, motion=motion, limited=frustum_limited),)

    def despawn_object(self, *, instance: int) -> tuple[()]:
        self._spawned_object(instance)
        del self._spawned[instance]
        self._library.textures.hold(self, self._texture_bytes())
        return ()

    def move_object(self, *, instance: int, position: Vector, rotation: Vector) -> tuple[()]:
        """Put an object elsewhere; if it moves by itself, it no longer does."""
        item = self._spawned_object(instance)
        self._spawned[instance] = replace(item, place=placed(position, rotation), motion=None)
        return ()

    def repaint_object(self, *, instance: int, textures: Sequence[tuple[str, tuple[int, int, bytes]]]) -> tuple[()]:
        painted = self._spawned_object(instance)
        pictures = {name: np.frombuffer(data, np.uint8).reshape(h, w, 3) for name, (h, w, data) in textures}
        model = repainted(painted.model, pictures)
        self._admit(model)
        self._spawned[instance] = replace(painted, model=model)
        return ()

    def _admit(self, model: Model) -> None:
        """Raise ``RendererError`` if the textures of ``model`` and of all that is spawned are too large together."""
        size = self._texture_bytes(model)
        if size > MAX_SHOWN_BYTES:
            raise RendererError(
                f"The spawned objects' textures take more than {MAX_SHOWN_BYTES >> 20} MiB; despawn some first."
            )
        self._library.textures.hold(self, size)

    def _texture_bytes(self, *more: Model) -> int:
        """What the textures of all that is spawned take, and those of ``more``."""
        models = [*more, *(item.model for item in self._spawned.values())]
        sizes = {id(texture): texture.nbytes for each in models for texture in each.obj.textures.values()}
        return sum(sizes.values())

    def get_spawnable_objects_names(self) -> tuple[Sequence[str]]:
        return (list(shipped_objects()),)

    def get_categories(self) -> tuple[list[tuple[int, str]]]:
        return ([(number, name) for name, number in CATEGORIES.items()],)

    def _spawned_object(self, instance: int) -> Instance:
        if instance not in self._spawned:
            raise RendererError(f"No object {instance} is spawned; there are {sorted(self._spawned)}.")
        return self._spawned[instance]


def placed(position: Vector, rotation: Vector) -> Place:
    """Position in metres and Euler angles in degrees, as an agent sends them. Raises ``RendererError``."""
    turn = from_euler(checked_vector(rotation, "rotation"))
    return Place(np.array(checked_vector(position, "position")), turn)


def _placement(number: int, item: Instance | Fixture) -> Placement:
    pose: NDArray[np.float64] = np.eye(4)
    pose[:3, :3] = to_matrix(item.place.turn) * np.array(item.scale)
    pose[:3, 3] = item.place.position
    return Placement(item.model, pose, number, item.category)
