"""What came out of an experiment, for people: a table, and two experiments beside each other."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from trompe_shared.errors import SpecError
from trompe_shared.experiment_table import RESULTS, ResultRow, read_table

__all__ = ["Difference", "compared", "comparison_table", "differences", "failures", "read_results", "results_table"]

FIGURES: Final = ("target_a_drop", "held_out_a_drop", "transfer_gap", "texels_altered", "seconds")
CHANGED: Final = 0.1
"""An ``a_drop`` that differs by as much is named."""
Setting = tuple[str, ...]


def read_results(folder: str | Path) -> list[ResultRow]:
    """The rows of an experiment's folder, or of a CSV file. Raises ``SpecError``."""
    path = Path(folder)
    return read_table(path / RESULTS if path.is_dir() else path, ResultRow)


def results_table(rows: Sequence[ResultRow]) -> RenderableType:
    """A line for each setting (object, classifier, what varies), means over seeds, and the mean of all."""
    table = Table()
    for name in ("object", "classifier", "configuration"):
        table.add_column(name, overflow="fold")
    for name in ("seeds", "surrogate", "target", "A_drop", "held-out A_drop", "N%", "s"):
        table.add_column(name, justify="right", no_wrap=True)
    for group in _by(rows, lambda row: (row.series, *_setting(row))).values():
        first = group[0]
        cells = [_pair(group, "surrogate"), _pair(group, "target"), _spread(group, "target_a_drop")]
        cells += [_spread(group, "held_out_a_drop"), _mean(group, "texels_altered"), _mean(group, "seconds", 0)]
        table.add_row(first.object, first.classifier, first.configuration, str(len(group)), *cells)
    drop, held_out = _mean(rows, "target_a_drop"), _mean(rows, "held_out_a_drop")
    return Group(table, Text(f"mean of {len(rows)} rows: target A_drop {drop}, held-out A_drop {held_out}"))


def failures(rows: Iterable[ResultRow]) -> list[str]:
    """A line for each row that failed."""
    return [f"{row.object}  {row.configuration}  seed {row.seed}: {row.state}: {row.error}" for row in rows]


@dataclass(frozen=True)
class Difference:
    """One setting in two experiments: the mean of each figure over its seeds, ``None`` where it is n.a."""

    object: str
    classifier: str
    configuration: str
    before: Mapping[str, float | None]
    after: Mapping[str, float | None]

    def change(self, figure: str) -> float | None:
        """After less before."""
        old, new = self.before[figure], self.after[figure]
        return None if old is None or new is None else new - old


def compared(first: str | Path, second: str | Path) -> list[Difference]:
    """The settings that two experiments share. Raises ``SpecError`` when they share none."""
    found = differences(read_results(first), read_results(second))
    if not found:
        raise SpecError(
            f"{first} and {second} share no setting (object, classifier, epsilon, tau, configuration), "
            "so there is nothing to compare."
        )
    return found


def differences(first: Sequence[ResultRow], second: Sequence[ResultRow]) -> list[Difference]:
    """The settings that occur in both, in the order of the first."""
    old, new = _by(first, _setting), _by(second, _setting)
    return [
        Difference(
            rows[0].object,
            rows[0].classifier,
            rows[0].configuration,
            {figure: _average(rows, figure) for figure in FIGURES},
            {figure: _average(new[setting], figure) for figure in FIGURES},
        )
        for setting, rows in old.items()
        if setting in new
    ]


def comparison_table(found: Sequence[Difference]) -> RenderableType:
    """A line for each shared setting: each figure before, after; then means, and what changed most."""
    table = Table()
    for name in ("object", "classifier", "configuration"):
        table.add_column(name, overflow="fold")
    for figure in FIGURES:
        table.add_column(figure.replace("_a_drop", " A_drop").replace("_", " "), justify="right", no_wrap=True)
    for each in found:
        cells = [f"{_number(each.before[name])} > {_number(each.after[name])}" for name in FIGURES]
        table.add_row(each.object, each.classifier, each.configuration, *cells)
    changes = [change for each in found if (change := each.change("target_a_drop")) is not None]
    larger, smaller = sum(c >= CHANGED for c in changes), sum(c <= -CHANGED for c in changes)
    summary = f"target A_drop: {larger} of {len(changes)} larger by {CHANGED:g} or more, {smaller} smaller"
    if changes:
        summary += f"; on average {fmean(changes):+.3f}"
    return Group(table, Text(summary))


def _setting(row: ResultRow) -> Setting:
    tau = "" if row.tau is None else f"{row.tau:g}"
    return row.object, row.classifier, f"{row.epsilon:g}", tau, row.configuration


def _by(rows: Iterable[ResultRow], key: Callable[[ResultRow], Setting]) -> dict[Setting, list[ResultRow]]:
    groups: dict[Setting, list[ResultRow]] = defaultdict(list)
    for row in rows:
        groups[key(row)].append(row)
    return dict(groups)


def _average(rows: Sequence[ResultRow], figure: str) -> float | None:
    known = [value for row in rows if (value := getattr(row, figure)) is not None]
    return fmean(known) if known else None


def _number(value: float | None, digits: int = 2) -> str:
    return "n.a." if value is None else f"{value:.{digits}f}"


def _mean(rows: Sequence[ResultRow], figure: str, digits: int = 2) -> str:
    return _number(_average(rows, figure), digits)


def _pair(rows: Sequence[ResultRow], views: str) -> str:
    return f"{_mean(rows, f'{views}_a_before')} > {_mean(rows, f'{views}_a_after')}"


def _spread(rows: Sequence[ResultRow], figure: str) -> str:
    """The mean, with the standard deviation over seeds, or the interval of a single one."""
    known = [value for row in rows if (value := getattr(row, figure)) is not None]
    if len(known) > 1:
        return f"{fmean(known):.2f} ± {stdev(known):.2f}"
    low, high = getattr(rows[0], f"{figure}_low"), getattr(rows[0], f"{figure}_high")
    return _mean(rows, figure) + (f" [{low:.2f}, {high:.2f}]" if low is not None and high is not None else "")
