"""All figures and tables of an experiment, by name, from its rows alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from trompe_server.experiments.groups import grouped
from trompe_server.experiments.histograms import prediction_histograms
from trompe_server.experiments.paper_means import paper_means_markdown
from trompe_server.experiments.pareto import pareto_markdown, speed_accuracy_chart
from trompe_server.experiments.scatter import texels_scatter
from trompe_server.experiments.stability_chart import stability_chart, stability_markdown
from trompe_server.experiments.style import Drawing, stamp_of
from trompe_server.experiments.surrogates import surrogates_chart, surrogates_markdown, surrogates_of
from trompe_server.experiments.table_one import table_one_chart, table_one_markdown
from trompe_shared.errors import SpecError
from trompe_shared.experiment_table import PREDICTIONS, RESULTS, PredictionRow, ResultRow, read_table

__all__ = ["FIGURES", "Data", "Kind", "figures_of", "histogram_rows", "plain_rows", "read_data"]

MOST_PANELS = 12


@dataclass(frozen=True)
class Data:
    """The two tables of an experiment, and their folder."""

    folder: Path
    rows: tuple[ResultRow, ...]
    predictions: tuple[PredictionRow, ...]

    @property
    def stamp(self) -> str:
        """What names these tables."""
        return stamp_of([*self.rows, *self.predictions])

    def draw(self, name: str) -> list[Path]:
        """Draw the figure ``name`` into ``figures``, as SVG and PNG; gives their paths."""
        return FIGURES[name].draw(self).save(self.folder / "figures", name, stamp=self.stamp)

    @property
    def results(self) -> list[ResultRow]:
        """The rows that came to an ``A_drop``."""
        return _done(self.rows)

    @property
    def grid(self) -> list[ResultRow]:
        """The rows of the surrogate that the experiment asks for first; others are there to be set beside it."""
        return [row for row in self.rows if row.surrogate == self.rows[0].surrogate]


def read_data(folder: Path) -> Data:
    """The tables of a folder; predictions may be missing. Raises ``SpecError``."""
    rows = read_table(folder / RESULTS, ResultRow)
    if not rows:
        raise SpecError(f"{str(folder / RESULTS)!r} has no row yet. `trompe experiment run` writes them as jobs end.")
    path = folder / PREDICTIONS
    return Data(folder, tuple(rows), tuple(read_table(path, PredictionRow)) if path.exists() else ())


@dataclass(frozen=True)
class Kind:
    """One figure: when it says something, how it is drawn, and its table, if it has one."""

    title: str
    fits: Callable[[Data], bool]
    draw: Callable[[Data], Drawing]
    table: Callable[[Data], str] | None = None


def _done(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Those that came to an ``A_drop``."""
    return [row for row in rows if row.target_a_drop is not None]


def _values(data: Data, column: str) -> int:
    return len({getattr(row, column) for row in data.results})


def histogram_rows(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """One row for each object, of the first classifier and the first setting: what the histograms show."""
    first = [group[0] for group in grouped(rows, lambda row: row.object).values()]
    return first[:MOST_PANELS]


def plain_rows(data: Data) -> list[ResultRow]:
    """The rows without saliency at the budget that comes nearest to the paper's 0.05."""
    rows = [row for row in _done(data.grid) if row.tau is None]
    nearest = min((row.epsilon for row in rows), key=lambda epsilon: abs(epsilon - 0.05), default=0.0)
    return [row for row in rows if row.epsilon == nearest]


FIGURES: dict[str, Kind] = {
    "table_one": Kind(
        "A_drop per object, classifier and epsilon (the paper's Table I)",
        lambda data: _one_setting(data) and any(row.tau is None for row in _done(data.grid)),
        lambda data: table_one_chart(data.grid),
        lambda data: table_one_markdown(data.grid),
    ),
    "scatter": Kind(
        "A_drop against the share of texels altered",
        lambda data: _one_setting(data) and _values(data, "tau") > 1,
        lambda data: texels_scatter(_done(data.grid)),
        lambda data: paper_means_markdown(data.grid),
    ),
    "surrogates": Kind(
        "What the surrogate promises, and what the target keeps",
        lambda data: _one_setting(data) and len(surrogates_of(data.results)) > 1,
        lambda data: surrogates_chart(data.results),
        lambda data: surrogates_markdown(data.results),
    ),
    "histograms": Kind(
        "What the objects were taken for, before and after",
        lambda data: _one_setting(data) and bool(data.predictions and plain_rows(data)),
        lambda data: prediction_histograms(histogram_rows(plain_rows(data)), data.predictions),
    ),
    "speed_accuracy": Kind(
        "Speed against accuracy",
        lambda data: _compares(data),
        lambda data: speed_accuracy_chart(data.results),
        lambda data: pareto_markdown(data.results),
    ),
    "evaluations_accuracy": Kind(
        "Images shown to the classifier against accuracy",
        lambda data: _compares(data),
        lambda data: speed_accuracy_chart(data.results, cost="evaluations"),
    ),
    "stability": Kind(
        "Where methods fail",
        lambda data: _cases(data),
        lambda data: stability_chart(data.rows),
        lambda data: stability_markdown(data.rows),
    ),
}


def _one_setting(data: Data) -> bool:
    """Whether the rows differ by what the paper's table tells apart, by surrogates and by seeds alone."""
    places = grouped(
        data.results, lambda row: (row.object, row.classifier, row.epsilon, row.tau, row.surrogate, row.seed)
    )
    return not _cases(data) and all(len(rows) == 1 for rows in places.values())


def _compares(data: Data) -> bool:
    """Whether the rows are series of settings to compare."""
    several = _values(data, "configuration") > 2 and _values(data, "series") > 1
    return several and not _cases(data) and not _one_setting(data)


def _cases(data: Data) -> bool:
    return any(row.case for row in data.rows)


def figures_of(data: Data) -> dict[str, Kind]:
    """The figures that say something of these rows."""
    return {name: kind for name, kind in FIGURES.items() if kind.fits(data)}
