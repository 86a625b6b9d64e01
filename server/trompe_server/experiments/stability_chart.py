"""Where methods fail: per case, what is left of the attack, and whether the system said that something is wrong."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from trompe_server.experiments.groups import average, figure_words, grouped, known
from trompe_server.experiments.style import BLUE, GREEN, GREY, INK, RED, Drawing, drawing
from trompe_server.markdown import markdown_table
from trompe_shared.experiment_table import ResultRow

__all__ = ["Behaviour", "behaviours", "stability_chart", "stability_markdown"]

FINE: Final = 0.8
"""A case whose figure is at least this share of the undisturbed one's has not failed."""
TRUSTED_GAP: Final = 0.1
"""A surrogate that promises so much more than the target keeps has failed."""
REFERENCE: Final = "as it should be"
EDGE: Final = 1.03
"""Right end of the axis: past 1, so that marks there are whole."""
SURROGATE: Final[Any] = {"mec": INK, "mfc": "none", "marker": "o", "ms": 9, "ls": ""}
TARGET: Final[Any] = {"color": BLUE, "marker": "o", "ms": 7}
HELD_OUT: Final[Any] = {"color": GREEN, "marker": "D", "ms": 5}
UNFORESEEN: Final = "unforeseen: "
"""How the names of cases begin in which the disturbance comes after the job: nothing could have noticed it."""


@dataclass(frozen=True)
class Behaviour:
    """One case over its objects and seeds: means of ``A_drop``, n.a. as ``None``, with the mean ends of the intervals.

    noticed: share of its jobs that gave a warning or an error. said: what they said, most frequent first.
    """

    case: str
    jobs: int
    failed: int
    a_before: float | None
    surrogate: float | None
    target: float | None
    target_interval: tuple[float, float] | None
    held_out: float | None
    held_out_interval: tuple[float, float] | None
    noticed: float
    said: tuple[str, ...]

    @property
    def unforeseen(self) -> bool:
        """Whether the disturbance came when the job was over."""
        return self.case.startswith(UNFORESEEN)

    def broken(self, reference: "Behaviour | None") -> bool:
        """Whether the result is much worse than without the disturbance, or than the surrogate promised."""
        if self.failed:
            return True
        if self.target is None:
            return False
        promised = self.surrogate is not None and self.surrogate - self.target > TRUSTED_GAP
        return promised or _much_less(self.held_out, reference.held_out if reference else None)

    def unnoticed(self, reference: "Behaviour | None") -> bool:
        """Whether it is broken and most of its jobs said nothing though they could have."""
        return self.broken(reference) and self.noticed < 0.5 and not self.unforeseen


def _much_less(value: float | None, reference: float | None) -> bool:
    return value is not None and reference is not None and value < FINE * reference


def behaviours(rows: Sequence[ResultRow]) -> list[Behaviour]:
    """The cases in their order."""
    return [_behaviour(case, group) for case, group in grouped(rows, lambda row: row.case or row.configuration).items()]


def _behaviour(case: str, rows: Sequence[ResultRow]) -> Behaviour:
    said = [words for row in rows for words in (*row.warnings.split(" | "), row.error) if words]
    often = sorted(dict.fromkeys(said), key=lambda words: -said.count(words))  # ties as they came
    return Behaviour(
        case,
        len(rows),
        sum(row.target_a_before is None for row in rows),
        average(row.target_a_before for row in rows),
        average(row.surrogate_a_drop for row in rows),
        average(row.target_a_drop for row in rows),
        _interval(rows, "target"),
        average(row.held_out_a_drop for row in rows),
        _interval(rows, "held_out"),
        sum(bool(row.warnings or row.error) for row in rows) / len(rows),
        tuple(often),
    )


def _interval(rows: Sequence[ResultRow], views: str) -> tuple[float, float] | None:
    low, high = (known(rows, f"{views}_a_drop_{end}") for end in ("low", "high"))
    return (sum(low) / len(low), sum(high) / len(high)) if low and high else None


def stability_chart(rows: Sequence[ResultRow]) -> Drawing:
    """A line for each case: surrogate, target and held-out ``A_drop``, and at the right whether it was noticed."""
    cases = behaviours(rows)
    reference = _reference(cases)
    least = min([-0.02, *(each.target_interval[0] for each in cases if each.target_interval)])
    with drawing(size=(8.6, 1.5 + 0.3 * len(cases))) as made:
        (axes,) = made.panels
        for y, case in enumerate(cases):
            _draw_case(axes, y, case)
            words, colour = _verdict(case, reference)
            axes.annotate(
                words,
                (EDGE, y),
                (6, 0),
                textcoords="offset points",
                va="center",
                fontsize=8,
                color=colour,
                annotation_clip=False,
            )
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
        return ("n.a., said so" if case.noticed >= 0.5 else "n.a."), GREY
    if case.unnoticed(reference):
        return "breaks, UNNOTICED", RED
    if case.broken(reference):
        return ("breaks, could not know" if case.unforeseen else "breaks, said so"), INK
    return ("holds, warned" if case.noticed >= 0.5 else "holds"), GREY


def stability_markdown(rows: Sequence[ResultRow]) -> str:
    """A table of the cases with what was said."""
    cases = behaviours(rows)
    reference = _reference(cases)
    head = ["case", "jobs", "A_before", "surrogate", "target", "held-out", "noticed", "verdict", "what it said"]
    lines = []
    for case in cases:
        figures = [case.jobs, _cell(case.a_before), _cell(case.surrogate)]
        figures += [_cell(case.target, case.target_interval), _cell(case.held_out, case.held_out_interval)]
        said = case.said[0] if case.said else ""
        lines.append([case.case, *figures, f"{case.noticed:.0%}", _verdict(case, reference)[0], said])
    return markdown_table(head, lines, align="lrrrrrrll") + "\n"


def _cell(value: float | None, interval: tuple[float, float] | None = None) -> str:
    return figure_words(value) + (f" [{interval[0]:.2f}, {interval[1]:.2f}]" if interval else "")
