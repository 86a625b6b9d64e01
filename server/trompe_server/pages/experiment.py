"""The page of an experiment: rows of its table and jobs of its chart."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from trompe_server.pages.chart import Point
from trompe_server.pages.present import JobRow, value_text
from trompe_shared import comparison
from trompe_shared.api import Result

Entry = tuple[JobRow, Mapping[str, Any], Result | None]
"""A job, its options by keyword, and its result."""

OUTCOME: Final = ("A_drop", "held-out A_drop", "seconds")


def differing_options(entries: Sequence[Entry]) -> list[str]:
    """Options in which jobs on the same object differ; epsilon in any case."""
    return comparison.differing_options([(row.object, options) for row, options, _ in entries])


def cells_of(entry: Entry, options: Sequence[str]) -> list[str]:
    """A job in the table: its ``options`` and its ``OUTCOME``."""
    _, asked, result = entry
    cells = [value_text(asked[name]) for name in options]
    if result is None:
        return cells + [value_text(None)] * len(OUTCOME)
    drops = [judged.a_drop if judged else None for judged in (result.target, result.held_out)]
    told = [value_text(None) if drop is None else f"{drop:.2f}" for drop in drops]
    return [*cells, *told, f"{sum(result.seconds.values()):.0f}"]


def points_of(entries: Sequence[Entry], options: Sequence[str]) -> list[Point]:
    """Finished jobs with an ``A_drop``; a configuration is all of ``options`` but the seed."""
    shown = [option for option in options if option != "seed"]
    points = []
    for row, asked, result in entries:
        judged = result and (result.held_out or result.target)
        if not result or not judged or judged.a_drop is None:
            continue
        probed = [str(value) for name, value in asked.items() if name in comparison.PROBED]
        job = comparison.Job(
            row.object,
            ", ".join(f"{name} {value_text(asked[name])}" for name in shown),
            asked["seed"],
            max(sum(result.seconds.values()), 0.1),
            judged.a_drop,
            (result.probe_renders, result.seconds.get("calibrate", 0.0)),
            (row.object, result.image_size, result.target.views, asked["seed"], *probed),
        )
        points.append(Point(row.id, job))
    return points
