"""The scenes: their objects, lights and first camera; and the categories of objects.

A furnished scene is a folder beside this file, written by scripts/make_room.py: ``scene.json`` and archives of its own
objects. It may name objects shipped with Trompe, too.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from trompe_renderer.world.model import HashedModel, model_of
from trompe_renderer.world.movement import NO_WALLS, Pose, Walls, room_walls
from trompe_renderer.world.objects import WorldObject
from trompe_renderer.world.snapshot import Background, Sky, WorldLight
from trompe_renderer.world.validation import Ints, Vector
from trompe_shared.errors import RendererError
from trompe_shared.geometry import Light
from trompe_shared.object3d import load_object
from trompe_shared.sailenv import MAIN_LIGHT, RIM_LIGHT
from trompe_shared.shipped import shipped_objects

OBJECT_VIEW: Final = "object_view/scene"
ROOM: Final = "room_01/scene"
SCENES: Final = (OBJECT_VIEW, ROOM)
UPLOADED: Final = "uploaded"

_STRUCTURE: Final = ("ceiling", "cupboard", "door", "floor", "picture", "rug", "wall", "window")
CATEGORIES: Final[Mapping[str, int]] = {
    name: number for number, name in enumerate(("none", UPLOADED, *shipped_objects(), *_STRUCTURE))
}
"""Category ids by name, the same in all scenes; "none" is the background."""


@dataclass(frozen=True)
class SceneSetup:
    """A scene as loaded. Its objects cannot be moved or removed.

    ``position`` and ``rotation`` (Euler angles, degrees) are the camera's.
    """

    lights: Mapping[str, WorldLight]
    ambient: Ints
    background: Background
    walls: Walls
    static_objects: tuple[WorldObject, ...] = ()
    position: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)


@cache
def scene_named(name: str) -> SceneSetup:
    """One of ``SCENES``. Raises ``RendererError`` for another name."""
    if name == OBJECT_VIEW:
        return _object_view()
    if name not in SCENES:
        raise RendererError(f"There is no scene {name!r}; choose one of {list(SCENES)}.")
    return _read(Path(__file__).parent / name.removesuffix("/scene"))


@cache
def shipped_model(name: str) -> HashedModel:
    """An object shipped with Trompe. Raises ``RendererError`` for another name."""
    objects = shipped_objects()
    if name not in objects:
        raise RendererError(
            f"There is no object {name!r}; choose one of {list(objects)}, or send a zip and spawn 'file:' "
            "+ the answered path."
        )
    return model_of(load_object(objects[name].read()))


def _object_view() -> SceneSetup:
    """The paper's scene for one object: two lights in front of white."""
    rim = Light(azimuth=180.0, elevation=30.0, intensity=0.0)
    return SceneSetup(
        lights={MAIN_LIGHT: WorldLight.of(Light()), RIM_LIGHT: WorldLight.of(rim)},
        ambient=(128, 128, 128),
        background=(1.0, 1.0, 1.0),
        walls=NO_WALLS,
    )


def _read(folder: Path) -> SceneSetup:
    table = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    return SceneSetup(
        static_objects=tuple(_static_object(folder, row) for row in table["static_objects"]),
        lights={
            name: WorldLight(**{key: _tuple(x) for key, x in row.items()}) for name, row in table["lights"].items()
        },
        ambient=_tuple(table["ambient"]),
        background=Sky(),
        position=_tuple(table["camera"]["position"]),
        rotation=_tuple(table["camera"]["rotation"]),
        walls=room_walls(table["walls"]["low"], table["walls"]["high"]),
    )


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _static_object(folder: Path, row: Mapping[str, Any]) -> WorldObject:
    own = folder / f"{row['object']}.zip"
    model = model_of(load_object(own)) if own.is_file() else shipped_model(row["object"])
    return WorldObject(model, CATEGORIES[row["object"]], Pose.of(row["position"], row["rotation"]))
