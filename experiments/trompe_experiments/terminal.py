"""Results on the terminal: one experiment, or two compared."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import stdev
from typing import Final

from rich.console import Group, RenderableType
from rich.text import Text

from trompe_client._report import empty_table
from trompe_experiments.markdown import figure_words
from trompe_experiments.table import ResultRow, read_results
from trompe_shared.api import JobState
from trompe_shared.comparison import average, grouped
from trompe_shared.errors import SpecError

SETTING: Final = ("object", "classifier", "configuration")
"""Columns of a setting."""
FIGURES: Final = ("target_a_drop", "held_out_a_drop", "transfer_gap", "texels_altered", "seconds")
CHANGED: Final = 0.1
"""Smallest difference of ``a_drop`` that is counted."""
Pair = tuple[list[ResultRow], list[ResultRow]]
"""Rows of one setting in two experiments."""


def results_table(rows: Sequence[ResultRow]) -> RenderableType:
    """A line for each setting (object, classifier, configuration) with means over seeds; then the mean of all rows."""
    table = empty_table(*SETTING, "seeds", "surrogate", "target", "A_drop", "held-out A_drop", "N%", "s", right=7)
    for group in grouped(rows, lambda row: (row.series, *_setting(row))).values():
        first = group[0]
        cells = [_first_pair(group), _pair(group, "target"), _spread(group, "target_a_drop")]
        cells += [_spread(group, "held_out_a_drop"), _mean(group, "texels_altered"), _mean(group, "seconds", ".0f")]
        table.add_row(first.object, first.classifier, first.configuration, str(len(group)), *cells)
    drop, held_out = _mean(rows, "target_a_drop"), _mean(rows, "held_out_a_drop")
    told = sum(row.target_a_drop is not None for row in rows)
    means = f"mean of the {told} of {len(rows)} rows with figures: target A_drop {drop}, held-out A_drop {held_out}"
    return Group(table, *map(Text, (*failures(rows), means)))


def failures(rows: Iterable[ResultRow]) -> list[str]:
    """A line for each failed row."""
    failed = (row for row in rows if row.failed)
    return [f"{row.object}  {row.configuration}  seed {row.seed}: {row.state}: {row.error}" for row in failed]


def compared(first: str | Path, second: str | Path) -> list[Pair]:
    """The settings that two experiments share. Raises ``SpecError`` if there are none."""
    found = differences(read_results(first), read_results(second))
    if not found:
        raise SpecError(
            f"Nothing to compare: {first} and {second} share no setting (object, classifier, epsilon, tau, "
            "configuration)."
        )
    return found


def differences(first: Sequence[ResultRow], second: Sequence[ResultRow]) -> list[Pair]:
    """The settings in both, in the order of the first."""
    old, new = grouped(first, _setting), grouped(second, _setting)
    return [(rows, new[setting]) for setting, rows in old.items() if setting in new]


def change(pair: Pair, figure: str) -> float | None:
    """Mean of a figure after minus before; ``None`` if either is n.a."""
    before, after = (_average(rows, figure) for rows in pair)
    return None if before is None or after is None else after - before


def comparison_table(found: Sequence[Pair]) -> RenderableType:
    """A line for each shared setting with all figures before and after; then a summary."""
    titles = [figure.replace("_a_drop", " A_drop").replace("_", " ") for figure in FIGURES]
    table = empty_table(*SETTING, *titles, right=len(titles))
    for before, after in found:
        first = before[0]
        cells = [f"{_mean(before, name)} > {_mean(after, name)}" for name in FIGURES]
        table.add_row(first.object, first.classifier, first.configuration, *cells)
    changes = [changed for pair in found if (changed := change(pair, "target_a_drop")) is not None]
    larger, smaller = sum(c >= CHANGED for c in changes), sum(c <= -CHANGED for c in changes)
    summary = f"target A_drop: {larger} of {len(changes)} larger by {CHANGED:g} or more, {smaller} smaller"
    if changes:
        summary += f"; on average {average(changes):+.3f}"
    return Group(table, Text(summary))


def _setting(row: ResultRow) -> tuple[str, ...]:
    tau = "" if row.tau is None else f"{row.tau:g}"
    return row.object, row.classifier, f"{row.epsilon:g}", tau, row.configuration


def _average(rows: Sequence[ResultRow], figure: str) -> float | None:
    return average(getattr(row, figure) for row in rows)


def _mean(rows: Sequence[ResultRow], figure: str, form: str = ".2f") -> str:
    return figure_words(_average(rows, figure), form)


def _pair(rows: Sequence[ResultRow], views: str) -> str:
    return f"{_mean(rows, f'{views}_a_before')} > {_mean(rows, f'{views}_a_after')}"


def _first_pair(rows: Sequence[ResultRow]) -> str:
    """The surrogate's figures, or the states of rows that all have none."""
    ended = any(row.state in {JobState.succeeded, JobState.not_applicable} for row in rows)
    return _pair(rows, "surrogate") if ended else ", ".join(dict.fromkeys(row.state for row in rows))


def _spread(rows: Sequence[ResultRow], figure: str) -> str:
    """The mean with the standard deviation over seeds, or with the interval of a single seed."""
    known = [value for row in rows if (value := getattr(row, figure)) is not None]
    if len(known) > 1:
        return f"{_mean(rows, figure)} ± {stdev(known):.2f}"
    low, high = getattr(rows[0], f"{figure}_low"), getattr(rows[0], f"{figure}_high")
    return _mean(rows, figure) + (f" [{low:.2f}, {high:.2f}]" if low is not None and high is not None else "")
