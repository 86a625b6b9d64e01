"""Chart and table of the stability suite: the drop left in each case, and whether the job warned."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from trompe_experiments.markdown import figure_words, markdown_table
from trompe_experiments.stability import AFTERWARDS, REFERENCE
from trompe_experiments.style import BLUE, GREEN, GREY, INK, RED, Drawing, drawing
from trompe_experiments.table import SEPARATOR, ResultRow
from trompe_shared.comparison import average, grouped

FINE: Final = 0.8
"""Share of the undisturbed held-out drop below which a case breaks."""
TRUSTED_GAP: Final = 0.1
"""Excess of the predicted drop over the kept one above which a case breaks."""
EDGE: Final = 1.03
"""Right end of the axis, past 1: marks at 1 are whole."""
SURROGATE: Final[Any] = {"mec": INK, "mfc": "none", "marker": "o", "ms": 9, "ls": ""}
TARGET: Final[Any] = {"color": BLUE, "marker": "o", "ms": 7}
HELD_OUT: Final[Any] = {"color": GREEN, "marker": "D", "ms": 5}


@dataclass(frozen=True)
class Behaviour:
    """One case: means of ``A_drop`` over objects and seeds, with mean ends of the intervals; n.a. is ``None``.

    noticed: share of its jobs with a warning or an error. said: these, the most frequent first.
    """

    case: str
    failed: int
    surrogate: float | None
    target: float | None
    target_interval: tuple[float, float] | None
    held_out: float | None
    held_out_interval: tuple[float, float] | None
    noticed: float
    said: tuple[str, ...]

    @property
    def unforeseen(self) -> bool:
        """Whether the disturbance started after the job."""
        return self.case.startswith(AFTERWARDS)

    def broken(self, reference: "Behaviour | None") -> bool:
        """Whether the drop is much smaller than without the disturbance, or than predicted."""
        if self.failed:
            return True
        if self.target is None:
            return False
        if self.surrogate is not None and self.surrogate - self.target > TRUSTED_GAP:
            return True
        usual = reference.held_out if reference else None
        return self.held_out is not None and usual is not None and self.held_out < FINE * usual

    def unnoticed(self, reference: "Behaviour | None") -> bool:
        """Whether it is broken and most of its jobs did not warn although they could have."""
        return self.broken(reference) and self.noticed < 0.5 and not self.unforeseen


def behaviours(rows: Sequence[ResultRow]) -> list[Behaviour]:
    """The cases in their order."""
    return [_behaviour(case, group) for case, group in grouped(rows, lambda row: row.case or row.configuration).items()]


def _behaviour(case: str, rows: Sequence[ResultRow]) -> Behaviour:
    said = [words for row in rows for words in (*row.warnings.split(SEPARATOR), row.error) if words]
    often = sorted(dict.fromkeys(said), key=lambda words: -said.count(words))  # ties as they came
    return Behaviour(
        case,
        sum(row.target_a_before is None for row in rows),
        average(row.surrogate_a_drop for row in rows),
        average(row.target_a_drop for row in rows),
        _interval(rows, "target"),
        average(row.held_out_a_drop for row in rows),
        _interval(rows, "held_out"),
        sum(bool(row.warnings or row.error) for row in rows) / len(rows),
        tuple(often),
    )


def _interval(rows: Sequence[ResultRow], views: str) -> tuple[float, float] | None:
    low, high = (average(getattr(row, f"{views}_a_drop_{end}") for row in rows) for end in ("low", "high"))
    return None if low is None or high is None else (low, high)


def stability_chart(rows: Sequence[ResultRow]) -> Drawing:
    """A line for each case: surrogate, target and held-out ``A_drop``, and the verdict at the right."""
    cases = behaviours(rows)
    reference = _reference(cases)
    least = min([-0.02, *(each.target_interval[0] for each in cases if each.target_interval)])
    with drawing(size=(8.6, 1.5 + 0.3 * len(cases))) as made:
        (axes,) = made.panels
        for y, case in enumerate(cases):
            _draw_case(axes, y, case)
            words, colour = _verdict(case, reference)
            place: Any = {"textcoords": "offset points", "va": "center", "annotation_clip": False}
            axes.annotate(words, (EDGE, y), (6, 0), fontsize=8, color=colour, **place)
        axes.set_yticks(range(len(cases)), [case.case for case in cases])
        axes.set_ylim(len(cases) - 0.4, -0.6)
        axes.set_xlim(least, EDGE)
        axes.set_xlabel("A_drop (share; lines: 95 % intervals, means over objects and seeds)")
        marks = [
            Line2D([], [], **SURROGATE, label="surrogate"),
            Line2D([], [], **TARGET, label="target, same views"),
            Line2D([], [], **HELD_OUT, label="target, held-out views"),
        ]
        made.figure.legend(handles=marks, loc="outside upper left", ncols=3)
    return made


def _reference(cases: Sequence[Behaviour]) -> Behaviour | None:
    return next((case for case in cases if case.case == REFERENCE), None)


def _draw_case(axes: Axes, y: int, case: Behaviour) -> None:
    if case.target is None:
        axes.text(0.01, y, "failed" if case.failed else "n.a.: not recognised", va="center", fontsize=8)
        return
    for value, interval, look, shift in (
        (case.held_out, case.held_out_interval, HELD_OUT, 0.17),
        (case.target, case.target_interval, TARGET, -0.1),
        (case.surrogate, None, SURROGATE, -0.1),
    ):
        if value is not None:
            axes.plot(value, y + shift, zorder=3, **look)
        if interval is not None:
            axes.plot(interval, [y + shift] * 2, color=look["color"], lw=1.2, zorder=2)


def _verdict(case: Behaviour, reference: Behaviour | None) -> tuple[str, str]:
    if case.target is None and not case.failed:
        return ("n.a., warned" if case.noticed >= 0.5 else "n.a."), GREY
    if case.unnoticed(reference):
        return "breaks, NO WARNING", RED
    if case.broken(reference):
        return ("breaks, no warning possible" if case.unforeseen else "breaks, warned"), INK
    return ("holds, warned" if case.noticed >= 0.5 else "holds"), GREY


def stability_markdown(rows: Sequence[ResultRow]) -> str:
    """A table of the cases with their most frequent warning."""
    cases = behaviours(rows)
    reference = _reference(cases)
    head = ["case", "surrogate", "target", "held-out", "verdict", "warning"]
    lines = []
    for case in cases:
        own, held_out = _cell(case.target, case.target_interval), _cell(case.held_out, case.held_out_interval)
        said = case.said[0] if case.said else ""
        lines.append([case.case, _cell(case.surrogate), own, held_out, _verdict(case, reference)[0], said])
    return markdown_table(head, lines, align="lrrrll") + "\n"


def _cell(value: float | None, interval: tuple[float, float] | None = None) -> str:
    return figure_words(value) + (f" [{interval[0]:.2f}, {interval[1]:.2f}]" if interval else "")
