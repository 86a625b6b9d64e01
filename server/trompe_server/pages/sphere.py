"""Map of the views of a result: azimuth by elevation, coloured by what became of each view."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

LEFT, RIGHT, TOP, BOTTOM = 50.0, 700.0, 15.0, 485.0
LEAST, MOST = 4.0, 11.0
"""Radii of dots of no and of full confidence."""
CROWD: Final = 200
"""Views above which the dots shrink, so that their area stays the same."""
ROUND: Final = 10
"""Degrees to which the range of elevations is widened."""
AZIMUTHS: Final = range(-180, 181, 60)


@dataclass(frozen=True)
class Sphere:
    """Input of the template, in SVG units. ``counts``: number of views by what became of them."""

    dots: Sequence[Mapping[str, Any]]
    counts: Mapping[str, int]
    x_ticks: Sequence[Mapping[str, Any]]
    y_ticks: Sequence[Mapping[str, Any]]


def sphere(sets: Sequence[Sequence[Mapping[str, Any]]]) -> Sphere:
    """The map of ``viewer_record``s in sets; the larger dots, which could hide others, are drawn first."""
    heights = [view["elevation"] for views in sets for view in views]
    low, high = _range(heights)

    def x(azimuth: float) -> float:
        return round(LEFT + (RIGHT - LEFT) * (azimuth + 180) / 360, 1)

    def y(elevation: float) -> float:
        return round(BOTTOM - (BOTTOM - TOP) * (elevation - low) / (high - low), 1)

    scale = min(1.0, math.sqrt(CROWD / max(1, len(heights))))
    dots = [
        {
            "x": x((view["azimuth"] + 180) % 360 - 180),
            "y": y(view["elevation"]),
            "r": round(scale * (LEAST + (MOST - LEAST) * view["confidence"]), 1),
            "fate": view["fate"],
            "set": number,
            "view": index,
            "title": f"{view['says_before']}, then {view['says_after']}",
        }
        for number, views in enumerate(sets)
        for index, view in enumerate(views)
    ]
    step = ROUND if high - low <= 60 else 3 * ROUND
    return Sphere(
        dots=sorted(dots, key=lambda dot: -dot["r"]),
        counts={fate: sum(dot["fate"] == fate for dot in dots) for fate in ("fooled", "kept", "never")},
        x_ticks=[{"at": x(degrees), "text": f"{degrees}°"} for degrees in AZIMUTHS],
        y_ticks=[{"at": y(degrees), "text": f"{degrees}°"} for degrees in range(low, high + 1, step)],
    )


def _range(elevations: Iterable[float]) -> tuple[int, int]:
    """Ends of the axis: whole tens of degrees around the views."""
    found = sorted(elevations)
    low, high = math.floor(found[0] / ROUND) * ROUND, math.ceil(found[-1] / ROUND) * ROUND
    return (low, high) if low < high else (low - ROUND, high + ROUND)
