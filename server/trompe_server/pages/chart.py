"""The chart of an experiment: each job's seconds against what it achieved, and the jobs that no other one beats."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from trompe_server.experiments.front import front_of

__all__ = ["Chart", "Point", "chart"]

LEFT, RIGHT, TOP, BOTTOM = 60.0, 700.0, 20.0, 310.0
STEPS: Final = (1, 2, 5)
COLOURS: Final = 8
"""Of objects; those beyond are squares, not discs."""


@dataclass(frozen=True)
class Point:
    """A job: ``drop`` is its A_drop, within 0..1 or below."""

    job: str
    object: str
    seconds: float
    drop: float


@dataclass(frozen=True)
class Chart:
    """What the template draws, in its own units. ``looks``: the CSS classes of each object's points."""

    points: Sequence[dict[str, Any]]
    front: str
    x_ticks: Sequence[dict[str, Any]]
    y_ticks: Sequence[dict[str, Any]]
    looks: Mapping[str, str]
    measure: str


def chart(points: Sequence[Point], *, measure: str) -> Chart:
    """``measure`` names what ``drop`` is."""
    if not points:
        return Chart((), "", (), (), {}, measure)
    seconds = [point.seconds for point in points]
    marks = _marks(min(seconds), max(seconds))
    low, high = marks[0], marks[-1]
    bottom = min(0.0, *(p.drop for p in points))

    def x(seconds: float) -> float:
        return round(LEFT + (RIGHT - LEFT) * math.log(seconds / low) / math.log(high / low), 1)

    def y(drop: float) -> float:
        return round(BOTTOM - (BOTTOM - TOP) * (drop - bottom) / (1 - bottom), 1)

    front = front_of(points, cost=lambda point: point.seconds, gain=lambda point: point.drop)
    looks = {name: _look(number) for number, name in enumerate(sorted({point.object for point in points}))}
    return Chart(
        points=[
            {
                "job": point.job,
                "x": x(point.seconds),
                "y": y(point.drop),
                "look": looks[point.object],
                "title": f"{point.object}: A_drop {point.drop:.2f} in {point.seconds:.0f} s",
            }
            for point in points
        ],
        front=" ".join(f"{x(point.seconds)},{y(point.drop)}" for point in front),
        x_ticks=[{"at": x(value), "text": f"{value:g}"} for value in marks],
        y_ticks=[{"at": y(value / 5), "text": f"{value / 5:.1f}"} for value in range(math.ceil(5 * bottom), 6)],
        looks=looks,
        measure=measure,
    )


def _look(number: int) -> str:
    return f"series-{number % COLOURS}" + " square" * (number // COLOURS % 2)


def _marks(low: float, high: float) -> list[float]:
    """Round numbers from the last below ``low`` to the first above ``high``."""
    powers = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 2)
    steps = [step * 10.0**power for power in powers for step in STEPS]
    first = max(k for k, step in enumerate(steps) if step < low)
    last = min(k for k, step in enumerate(steps) if step > high)
    return steps[first : last + 1]
