"""Objects with the way they are looked at: those of the paper, from TROMPE_ASSETS, and those that come with Trompe."""

from dataclasses import dataclass
from pathlib import Path

from trompe_server.attack import grid_views
from trompe_server.experiments.pictures import Shown
from trompe_shared.asset_objects import AssetObject, asset_objects
from trompe_shared.geometry import COLOURS, Camera, View
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import ShippedObject, shipped_objects

__all__ = ["LibraryObject", "loaded", "paper_objects", "shipped", "shown"]

AZIMUTH = 30.0


@dataclass(frozen=True)
class LibraryObject:
    """An object, the camera's distance (metres), its range of elevations (degrees), and the background (sRGB)."""

    name: str
    obj: Object3D
    distance: float
    elevation: tuple[float, float]
    background: tuple[int, int, int]

    def views(self, *, azimuths: int = 6, elevations: int = 10) -> list[View]:
        """The paper's grid of views."""
        return grid_views(
            distance=self.distance,
            elevation=self.elevation,
            azimuths=azimuths,
            elevations=elevations,
            background=self.background,
        )


def loaded(each: ShippedObject | AssetObject) -> LibraryObject:
    """The object itself; those that come with Trompe stand before white."""
    background = COLOURS[each.background if isinstance(each, AssetObject) else "white"]
    return LibraryObject(each.name, load_object(each.path), each.distance, each.elevation, background)


def shipped() -> list[LibraryObject]:
    """The objects that come with Trompe."""
    return [loaded(each) for each in shipped_objects().values()]


def paper_objects(assets: Path) -> list[LibraryObject]:
    """The paper's objects."""
    return [loaded(each) for each in asset_objects(assets).values()]


def shown(each: LibraryObject) -> Shown:
    """The object from the middle of its elevations."""
    return Shown(each.name, each.obj, View(Camera(each.distance, AZIMUTH, sum(each.elevation) / 2)))
