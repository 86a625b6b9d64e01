"""An experiment's jobs, with what sets them apart and what came of them: lines of its table, points of its chart."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from trompe_server.pages.chart import Point
from trompe_server.pages.present import JobRow, value_text
from trompe_shared.api import Result

__all__ = ["Entry", "Line", "columns_and_lines", "differing_options", "points_of"]

Entry = tuple[JobRow, Mapping[str, Any], Result | None]
"""A job, what was asked, and what came out."""

OUTCOME: Final = ("A_drop", "held-out A_drop", "seconds")


@dataclass(frozen=True)
class Line:
    """A job in the table; a cell for each column."""

    job: str
    object: str
    state: str
    cells: Sequence[str]


def differing_options(entries: Sequence[Entry]) -> list[str]:
    """Epsilon, and the other options in which jobs on the same object differ."""
    first: dict[str, Mapping[str, Any]] = {}
    differ = {"epsilon"}
    for row, asked, _ in entries:
        one = first.setdefault(row.object, asked)
        differ |= {option for option in asked if asked[option] != one[option]}
    return [option for option in entries[0][1] if option in differ]


def columns_and_lines(entries: Sequence[Entry], options: Sequence[str]) -> tuple[list[str], list[Line]]:
    """Columns are ``options``, and what came of the jobs."""
    lines = [
        Line(row.id, row.object, row.state, [*(value_text(asked[name]) for name in options), *_outcome(result)])
        for row, asked, result in entries
    ]
    return [*options, *OUTCOME], lines


def points_of(entries: Sequence[Entry], options: Sequence[str]) -> list[Point]:
    """The jobs that were judged; a configuration is all of ``options`` but the seed."""
    options = [option for option in options if option != "seed"]
    points = []
    for row, asked, result in entries:
        judged = result and (result.held_out or result.target)
        if result and judged and judged.a_drop is not None:
            words = ", ".join(f"{name} {value_text(asked[name])}" for name in options)
            points.append(Point(row.id, row.object, words, max(sum(result.seconds.values()), 0.1), judged.a_drop))
    return points


def _outcome(result: Result | None) -> list[str]:
    nothing = value_text(None)
    if result is None:
        return [nothing] * len(OUTCOME)
    drops = [judged.a_drop if judged else None for judged in (result.target, result.held_out)]
    told = [nothing if drop is None else f"{drop:.2f}" for drop in drops]
    return [*told, f"{sum(result.seconds.values()):.0f}"]
