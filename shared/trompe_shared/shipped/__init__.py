"""The objects that come with Trompe, so that a first attack needs nothing else (see scripts/make_objects.py)."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Final

__all__ = ["ShippedObject", "shipped_objects"]

_FOLDER: Final = Path(__file__).parent


@dataclass(frozen=True)
class ShippedObject:
    """A textured object and how it is best looked at.

    ``label`` is its class of the shipped classifier, ``distance`` the camera's in metres, ``elevation`` the range of
    camera elevations in degrees, ``path`` the archive that ``load_object`` reads.
    """

    name: str
    label: str
    distance: float
    elevation: tuple[float, float]
    path: Path

    def read(self) -> bytes:
        """The archive's bytes."""
        return self.path.read_bytes()


def shipped_objects() -> dict[str, ShippedObject]:
    """All shipped objects by name, in alphabetical order."""
    table = json.loads((_FOLDER / "objects.json").read_text(encoding="utf-8"))
    return {
        name: ShippedObject(name, row["label"], row["distance"], tuple(row["elevation"]), _FOLDER / f"{name}.zip")
        for name, row in sorted(table.items())
    }
