"""The scenes there are: what stands in them, how they are lit, where the camera starts. And all kinds of things.

A furnished scene is a folder beside this file, written by scripts/make_room.py: ``scene.json`` and the archives of the
objects it is made of; other objects that it names are those that come with Trompe.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

from trompe_renderer.dynamics import NO_WALLS, Place, Walls, room_walls
from trompe_renderer.lights import Lamp, lamp_of
from trompe_renderer.model import Model, model_of
from trompe_renderer.rotation import from_euler
from trompe_renderer.scenery import Sky
from trompe_renderer.values import Ints, Vector
from trompe_shared.errors import RendererError
from trompe_shared.geometry import Light
from trompe_shared.object3d import load_object
from trompe_shared.sailenv import MAIN_LIGHT, RIM_LIGHT
from trompe_shared.shipped import shipped_objects

__all__ = ["CATEGORIES", "OBJECT_VIEW", "SCENES", "UPLOADED", "Fixture", "Scene", "scene_named", "shipped_model"]

OBJECT_VIEW: Final = "object_view/scene"
ROOM: Final = "room_01/scene"
SCENES: Final = (OBJECT_VIEW, ROOM)
UPLOADED: Final = "uploaded"

_STRUCTURE: Final = ("ceiling", "cupboard", "door", "floor", "picture", "rug", "wall", "window")
CATEGORIES: Final[Mapping[str, int]] = {
    name: number for number, name in enumerate(("none", UPLOADED, *shipped_objects(), *_STRUCTURE))
}
"""Ids of all kinds of things in all scenes, by name; "none" is where nothing is."""


@dataclass(frozen=True)
class Fixture:
    """Something that belongs to a scene and can be neither moved nor removed."""

    model: Model
    category: int
    place: Place
    scale: Vector


@dataclass(frozen=True)
class Scene:
    """How a scene is when it is loaded. ``position`` and ``rotation`` (degrees) are the camera's."""

    name: str
    fixtures: tuple[Fixture, ...]
    lamps: Mapping[str, Lamp]
    ambient: Ints
    backdrop: Ints | Sky
    position: Vector
    rotation: Vector
    walls: Walls


@cache
def scene_named(name: str) -> Scene:
    """Raises ``RendererError`` if there is no such scene."""
    if name == OBJECT_VIEW:
        return _object_view()
    if name not in SCENES:
        raise RendererError(f"There is no scene {name!r}; choose one of {list(SCENES)}.")
    return _read(Path(__file__).parent / name.removesuffix("/scene"), name)


@cache
def shipped_model(name: str) -> Model:
    """An object that comes with Trompe. Raises ``RendererError`` for another name."""
    objects = shipped_objects()
    if name not in objects:
        raise RendererError(
            f"There is no object {name!r}; choose one of {list(objects)}, or send a zip and spawn 'file:' + the path "
            "answered."
        )
    return model_of(load_object(objects[name].read()))


def _object_view() -> Scene:
    """Nothing but two lights in front of white: the paper's scene, for one object."""
    light = Light()
    behind = replace(light, azimuth=180.0, elevation=30.0, intensity=0.0)
    return Scene(
        name=OBJECT_VIEW,
        fixtures=(),
        lamps={MAIN_LIGHT: lamp_of(light), RIM_LIGHT: lamp_of(behind)},
        ambient=(128, 128, 128),
        backdrop=(255, 255, 255),
        position=(0.0, 0.0, 0.0),
        rotation=(0.0, 0.0, 0.0),
        walls=NO_WALLS,
    )


def _read(folder: Path, name: str) -> Scene:
    table = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    lamps = {light: Lamp(**{key: _tuple(x) for key, x in row.items()}) for light, row in table["lights"].items()}
    return Scene(
        name=name,
        fixtures=tuple(_fixture(folder, row) for row in table["fixtures"]),
        lamps=lamps,
        ambient=_tuple(table["ambient"]),
        backdrop=Sky(),
        position=_tuple(table["camera"]["position"]),
        rotation=_tuple(table["camera"]["rotation"]),
        walls=room_walls(table["walls"]["low"], table["walls"]["high"]),
    )


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _fixture(folder: Path, row: Mapping[str, Any]) -> Fixture:
    own = folder / f"{row['object']}.zip"
    model = model_of(load_object(own)) if own.is_file() else shipped_model(row["object"])
    place = Place(row["position"], from_euler(row["rotation"]))
    return Fixture(model, CATEGORIES[row["object"]], place, (1.0, 1.0, 1.0))
