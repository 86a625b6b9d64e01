"""The paper's objects: the table ``objects/objects.json`` of an assets folder."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trompe_shared.errors import ObjectError


@dataclass(frozen=True)
class AssetObject:
    """An object and the paper's views of it.

    ``label``: ImageNet class. ``distance``: of the camera, metres. ``elevation``: range of the camera, degrees.
    ``background``: name of a colour. ``path``: folder for ``load_object``.
    """

    name: str
    label: int
    distance: float
    elevation: tuple[float, float]
    background: str
    path: Path


def asset_objects(assets: Path) -> dict[str, AssetObject]:
    """The objects of a folder by name, in the order of its table. Raises ``ObjectError`` for a bad table."""
    folder = assets / "objects"
    try:
        table = json.loads((folder / "objects.json").read_text(encoding="utf-8"))
        return {name: _object(folder / name, row) for name, row in table.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ObjectError(
            f"{str(folder)!r} must hold an objects.json with a table of objects and the imagenet_class, distance, "
            f"elevation_range and background of each ({type(error).__name__}: {error})."
        ) from error


def _object(path: Path, row: dict[str, Any]) -> AssetObject:
    low, high = row["elevation_range"]
    return AssetObject(path.name, row["imagenet_class"], row["distance"], (low, high), row["background"], path)
