"""Where the cameras of a job stand: what they look at, from how far, from which heights. No torch."""

from dataclasses import dataclass
from typing import Final

from trompe_shared.api import ViewOptions
from trompe_shared.geometry import framing_distance
from trompe_shared.object3d import Object3D
from trompe_shared.shipped import shipped_objects

DEFAULT_ELEVATION: Final = (0.0, 50.0)
ORIGIN: Final = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Framing:
    """centre: the point that cameras look at, metres. distance: metres from it. elevation: range, degrees."""

    centre: tuple[float, float, float]
    distance: float
    elevation: tuple[float, float]


def framing_of(obj: Object3D, views: ViewOptions, *, shipped: str | None = None) -> Framing:
    """The framing of ``views``; what they leave open is that of the ``shipped`` object of this name, else fits the
    object."""
    own = shipped_objects().get(shipped) if shipped is not None else None
    centre, radius = obj.sphere if views.looks_at == "object" else (ORIGIN, obj.radius)
    return Framing(
        centre,
        views.distance or (own.distance if own is not None else framing_distance(radius)),
        views.elevation or (own.elevation if own is not None else DEFAULT_ELEVATION),
    )
