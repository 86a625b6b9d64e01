"""The views an attack is made for, and the ones it is judged on."""

from collections.abc import Sequence

import numpy as np

from trompe_shared.geometry import FIELD_OF_VIEW, Camera, Light, View
from trompe_shared.object3d import Object3D

__all__ = ["framing_distance", "grid_views", "random_views"]


def framing_distance(obj: Object3D) -> float:
    """Distance, metres, at which the object fills most of the picture from every side."""
    return 1.05 * obj.radius / float(np.sin(np.radians(FIELD_OF_VIEW / 2)))


def grid_views(
    *,
    distance: float,
    elevation: tuple[float, float],
    azimuths: int,
    elevations: int,
    background: tuple[int, int, int],
) -> list[View]:
    """The paper's views: a grid of azimuths (0..360, both ends) and elevations, lit from the front at elevation 75."""
    return [
        View(Camera(distance, float(a), float(e)), Light(), background)
        for e in np.linspace(*elevation, elevations)
        for a in np.linspace(0, 360, azimuths)
    ]


def random_views(
    n: int,
    *,
    distance: float,
    elevation: tuple[float, float],
    background: tuple[int, int, int],
    generator: np.random.Generator,
) -> Sequence[View]:
    """``n`` views as one may meet the object, to be attacked as a pool or to be held out.

    Any azimuth, elevations of the range, distance +-10 %, light from azimuth +-70 and elevation 35..88.
    """
    draw = generator.uniform
    return [
        View(
            Camera(distance * draw(0.9, 1.1), draw(0, 360), draw(*elevation)),
            Light(azimuth=draw(-70, 70), elevation=draw(35, 88)),
            background,
        )
        for _ in range(n)
    ]
