"""Chart of an experiment: seconds against drop, with the Pareto front of its configurations.

Jobs on different objects are not comparable, so the front joins means (``trompe_shared.comparison``).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from trompe_shared.comparison import Job, Mean, charged, means_of, pareto_front

LEFT, RIGHT, TOP, BOTTOM = 60.0, 700.0, 20.0, 310.0
STEPS: Final = (1, 2, 5)
COLOURS: Final = 8
"""Number of colours of objects; further objects are squares instead of discs."""


@dataclass(frozen=True)
class Point:
    """A job and its id. Costs are seconds; configurations are words."""

    id: str
    job: Job[str]


@dataclass(frozen=True)
class Chart:
    """Input of the template, in SVG units. ``looks``: CSS classes of each object's points.

    ``means`` are empty if all jobs are on one object and have different configurations. ``best``: words of the
    configurations on the ``front``; ``common``: objects of the means.
    """

    points: Sequence[dict[str, Any]]
    means: Sequence[dict[str, Any]]
    common: Sequence[str]
    best: Sequence[str]
    front: str
    x_ticks: Sequence[dict[str, Any]]
    y_ticks: Sequence[dict[str, Any]]
    looks: Mapping[str, str]


def chart(points: Sequence[Point]) -> Chart:
    """The chart of finished jobs."""
    if not points:
        return Chart((), (), (), (), "", (), (), {})
    jobs = charged(point.job for point in points)
    marks = _marks(min(job.cost for job in jobs), max(job.cost for job in jobs))
    low, high = marks[0], marks[-1]
    bottom = min(0.0, *(job.drop for job in jobs))

    def x(seconds: float) -> float:
        return round(LEFT + (RIGHT - LEFT) * math.log(seconds / low) / math.log(high / low), 1)

    def y(drop: float) -> float:
        return round(BOTTOM - (BOTTOM - TOP) * (drop - bottom) / (1 - bottom), 1)

    def drawn(one: Job[str] | Mean[str], title: str) -> dict[str, Any]:
        return {"x": x(one.cost), "y": y(one.drop), "title": title}

    looks = {name: _look(number) for number, name in enumerate(sorted({job.object for job in jobs}))}
    means, common = means_of(jobs)
    front = pareto_front(means)
    alone = len(looks) == 1 and len(means) == len(jobs)
    return Chart(
        points=[
            drawn(job, f"{job.object}, {_words(job)}") | {"job": point.id, "look": looks[job.object]}
            for point, job in zip(points, jobs, strict=True)
        ],
        means=[] if alone else [drawn(mean, _words(mean)) for mean in means],
        common=[] if alone else sorted(common),
        best=[] if alone else [_words(mean) for mean in front],
        front=" ".join(f"{x(mean.cost)},{y(mean.drop)}" for mean in front),
        x_ticks=[{"at": x(value), "text": f"{value:g}"} for value in marks],
        y_ticks=[{"at": y(value / 5), "text": f"{value / 5:.1f}"} for value in range(math.ceil(5 * bottom), 6)],
        looks=looks,
    )


def _words(one: Job[str] | Mean[str]) -> str:
    return f"{one.configuration}: A_drop {one.drop:.2f} in {one.cost:.0f} s"


def _look(number: int) -> str:
    return f"series-{number % COLOURS}" + " square" * (number // COLOURS % 2)


def _marks(low: float, high: float) -> list[float]:
    """Round numbers from the last one below ``low`` to the first one above ``high``."""
    powers = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 2)
    steps = [step * 10.0**power for power in powers for step in STEPS]
    first = max(k for k, step in enumerate(steps) if step < low)
    last = min(k for k, step in enumerate(steps) if step > high)
    return steps[first : last + 1]
