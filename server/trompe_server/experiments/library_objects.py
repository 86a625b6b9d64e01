"""Objects with the way they are looked at: those of the paper, from TROMPE_ASSETS, and those that come with Trompe."""

import json
from dataclasses import dataclass
from pathlib import Path

from trompe_server.experiments.pictures import Shown
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import shipped_objects

__all__ = ["LibraryObject", "paper_objects", "shipped", "shown"]

AZIMUTH = 30.0


@dataclass(frozen=True)
class LibraryObject:
    """An object, the camera's distance (metres) and its range of elevations (degrees)."""

    name: str
    obj: Object3D
    distance: float
    elevation: tuple[float, float]


def shipped() -> list[LibraryObject]:
    """The objects that come with Trompe."""
    return [
        LibraryObject(each.name, load_object(each.read()), each.distance, each.elevation)
        for each in shipped_objects().values()
    ]


def paper_objects(assets: Path) -> list[LibraryObject]:
    """The paper's objects."""
    table = json.loads((assets / "objects" / "objects.json").read_text("utf-8"))
    return [
        LibraryObject(
            name,
            load_object(assets / "objects" / name),
            row["distance"],
            (row["elevation_range"][0], row["elevation_range"][1]),
        )
        for name, row in table.items()
    ]


def shown(each: LibraryObject) -> Shown:
    """The object from the middle of its elevations."""
    return Shown(each.name, each.obj, View(Camera(each.distance, AZIMUTH, sum(each.elevation) / 2)))
