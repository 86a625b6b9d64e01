"""The chart of an experiment: seconds against what was achieved, and what nothing else beats in both.

Objects differ in how hard they are, so a job on one does not beat a job on another: configurations are compared, by
their means over the same objects. Where all jobs are on one object and differ, the jobs themselves are compared.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any, Final

from trompe_server.experiments.front import front_of
from trompe_server.experiments.groups import grouped

__all__ = ["Chart", "Mean", "Point", "chart", "means_of"]

LEFT, RIGHT, TOP, BOTTOM = 60.0, 700.0, 20.0, 310.0
STEPS: Final = (1, 2, 5)
COLOURS: Final = 8
"""Of objects; those beyond are squares, not discs."""


@dataclass(frozen=True)
class Point:
    """A job: ``drop`` is its A_drop, within 0..1 or below. ``configuration``: what was asked of it, in words."""

    job: str
    object: str
    configuration: str
    seconds: float
    drop: float

    @property
    def words(self) -> str:
        """What it is, and what it cost and gave."""
        return f"{self.object}, {_words(self)}"


@dataclass(frozen=True)
class Mean:
    """A configuration: the means of its jobs."""

    configuration: str
    seconds: float
    drop: float

    @property
    def words(self) -> str:
        """What it is, and what it costs and gives."""
        return _words(self)


@dataclass(frozen=True)
class Chart:
    """What the template draws, in its own units. ``looks``: the CSS classes of each object's points.

    ``means`` are empty where all jobs are on one object and each is a configuration; ``best`` are those on the
    ``front``, in words, ``common`` the objects that they are means over.
    """

    points: Sequence[dict[str, Any]]
    means: Sequence[dict[str, Any]]
    common: Sequence[str]
    best: Sequence[str]
    front: str
    x_ticks: Sequence[dict[str, Any]]
    y_ticks: Sequence[dict[str, Any]]
    looks: Mapping[str, str]
    measure: str


def chart(points: Sequence[Point], *, measure: str) -> Chart:
    """``measure`` names what ``drop`` is."""
    if not points:
        return Chart((), (), (), (), "", (), (), {}, measure)
    seconds = [point.seconds for point in points]
    marks = _marks(min(seconds), max(seconds))
    low, high = marks[0], marks[-1]
    bottom = min(0.0, *(p.drop for p in points))

    def x(seconds: float) -> float:
        return round(LEFT + (RIGHT - LEFT) * math.log(seconds / low) / math.log(high / low), 1)

    def y(drop: float) -> float:
        return round(BOTTOM - (BOTTOM - TOP) * (drop - bottom) / (1 - bottom), 1)

    def drawn(one: Point | Mean) -> dict[str, Any]:
        return {"x": x(one.seconds), "y": y(one.drop), "title": one.words}

    looks = {name: _look(number) for number, name in enumerate(sorted({point.object for point in points}))}
    alone = len(looks) == 1 and len({point.configuration for point in points}) == len(points)
    means, common = ([], set()) if alone else means_of(points)
    compared: Sequence[Point | Mean] = points if alone else means
    front = front_of(compared, cost=lambda one: one.seconds, gain=lambda one: one.drop)
    return Chart(
        points=[drawn(point) | {"job": point.job, "look": looks[point.object]} for point in points],
        means=[drawn(mean) for mean in means],
        common=sorted(common),
        best=[] if alone else [one.words for one in front],
        front=" ".join(f"{x(one.seconds)},{y(one.drop)}" for one in front),
        x_ticks=[{"at": x(value), "text": f"{value:g}"} for value in marks],
        y_ticks=[{"at": y(value / 5), "text": f"{value / 5:.1f}"} for value in range(math.ceil(5 * bottom), 6)],
        looks=looks,
        measure=measure,
    )


def means_of(points: Sequence[Point]) -> tuple[list[Mean], set[str]]:
    """The configurations, and the objects on which all of them have a point: each is a mean over these alone.

    One that has points on less than half of the objects, as one that has just begun, is left out. None where there are
    no common objects. An object counts once, whatever the number of its jobs.
    """
    groups = grouped(points, lambda point: point.configuration)
    objects = {name: {point.object for point in group} for name, group in groups.items()}
    enough = len(set.union(*objects.values())) / 2
    compared = [name for name, mine in objects.items() if len(mine) >= enough]
    common = set.intersection(*(objects[name] for name in compared)) if compared else set()
    means = []
    for name in compared if common else ():
        group = groups[name]
        parts = grouped((point for point in group if point.object in common), lambda point: point.object).values()
        seconds, drops = ([fmean(getattr(p, of) for p in part) for part in parts] for of in ("seconds", "drop"))
        means.append(Mean(name, fmean(seconds), fmean(drops)))
    return means, common


def _words(one: Point | Mean) -> str:
    return f"{one.configuration}: A_drop {one.drop:.2f} in {one.seconds:.0f} s"


def _look(number: int) -> str:
    return f"series-{number % COLOURS}" + " square" * (number // COLOURS % 2)


def _marks(low: float, high: float) -> list[float]:
    """Round numbers from the last below ``low`` to the first above ``high``."""
    powers = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 2)
    steps = [step * 10.0**power for power in powers for step in STEPS]
    first = max(k for k, step in enumerate(steps) if step < low)
    last = min(k for k, step in enumerate(steps) if step > high)
    return steps[first : last + 1]
