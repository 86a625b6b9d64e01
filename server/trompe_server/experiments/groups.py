"""Rows of an experiment, grouped and averaged."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from statistics import fmean, stdev
from typing import TypeVar

from trompe_shared.experiment_table import ResultRow

__all__ = ["average", "by_tau", "deviation", "figure_words", "grouped", "known", "tau_words"]

K = TypeVar("K", bound=Hashable)
R = TypeVar("R")


def grouped(rows: Iterable[R], key: Callable[[R], K]) -> dict[K, list[R]]:
    """Rows by ``key``, in the order in which the keys come first."""
    groups: dict[K, list[R]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


def by_tau(rows: Iterable[ResultRow]) -> dict[float | None, list[ResultRow]]:
    """Rows by threshold, ascending, those without saliency first."""
    return grouped(sorted(rows, key=lambda row: row.tau or -1.0), lambda row: row.tau)


def known(rows: Iterable[ResultRow], figure: str) -> list[float]:
    """The values of a column, without those that are n.a."""
    return [value for row in rows if (value := getattr(row, figure)) is not None]


def average(values: Iterable[float | None]) -> float | None:
    """The mean of the values that are not n.a.; ``None`` where all are."""
    found = [value for value in values if value is not None]
    return fmean(found) if found else None


def deviation(values: Sequence[float]) -> float:
    """Their standard deviation; 0 for one."""
    return stdev(values) if len(values) > 1 else 0.0


def figure_words(value: float | None, digits: int = 2) -> str:
    """A figure as tables have it."""
    return "n.a." if value is None else f"{value:.{digits}f}"


def tau_words(tau: float | None) -> str:
    """What a threshold is called in figures and tables."""
    return "all texels" if tau is None else f"saliency, τ {tau:g}"
