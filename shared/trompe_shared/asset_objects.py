"""The paper's objects, in the folder that TROMPE_ASSETS names: what its ``objects/objects.json`` says of each."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trompe_shared.errors import ObjectError

__all__ = ["AssetObject", "asset_objects"]


@dataclass(frozen=True)
class AssetObject:
    """An object and how the paper looks at it.

    ``label`` is its class of ImageNet, ``distance`` the camera's in metres, ``elevation`` the range of camera
    elevations in degrees, ``background`` the name of a colour, ``path`` the folder that ``load_object`` reads.
    """

    name: str
    label: int
    distance: float
    elevation: tuple[float, float]
    background: str
    path: Path


def asset_objects(assets: Path) -> dict[str, AssetObject]:
    """The objects in a folder by name, in its table's order. Raises ``ObjectError`` where there is no such table."""
    folder = assets / "objects"
    try:
        table = json.loads((folder / "objects.json").read_text(encoding="utf-8"))
        return {name: _object(folder / name, row) for name, row in table.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ObjectError(
            f"{str(folder)!r} must hold an objects.json with a table of objects, and of each its imagenet_class, "
            f"distance, elevation_range and background ({type(error).__name__}: {error})."
        ) from error


def _object(path: Path, row: dict[str, Any]) -> AssetObject:
    low, high = row["elevation_range"]
    return AssetObject(path.name, row["imagenet_class"], row["distance"], (low, high), row["background"], path)
