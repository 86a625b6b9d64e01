"""All figures and tables of an experiment by name, made from its rows alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from trompe_experiments.baselines import baselines_chart, baselines_markdown
from trompe_experiments.between import between_chart, between_markdown, with_all_pipelines
from trompe_experiments.engines import engines_chart, engines_markdown
from trompe_experiments.histograms import prediction_histograms
from trompe_experiments.judged import JUDGEMENTS, JudgedRow
from trompe_experiments.paper import paper_means_markdown, table_one_chart, table_one_markdown, texels_scatter
from trompe_experiments.pareto import Cost, configurations, pareto_markdown, speed_accuracy_chart
from trompe_experiments.stability.chart import stability_chart, stability_markdown
from trompe_experiments.style import Drawing, stamp_of
from trompe_experiments.surrogates import surrogates_chart, surrogates_markdown, surrogates_of, with_all_surrogates
from trompe_experiments.table import PREDICTIONS, PredictionRow, ResultRow, read_results, read_table
from trompe_shared.comparison import grouped
from trompe_shared.errors import SpecError

MOST_PANELS = 12


@dataclass(frozen=True)
class Data:
    """The tables of an experiment, and their folder."""

    folder: Path
    rows: tuple[ResultRow, ...]
    predictions: tuple[PredictionRow, ...]
    judgements: tuple[JudgedRow, ...] = ()

    @property
    def stamp(self) -> str:
        """Name of these tables."""
        return stamp_of([*self.rows, *self.predictions, *self.judgements])

    def draw(self, name: str) -> list[Path]:
        """Draw the figure ``name`` into ``figures`` as SVG and PNG; returns their paths.

        Raises ``SpecError`` if it does not suit the rows.
        """
        if not FIGURES[name].fits(self):
            others = ", ".join(figures_of(self)) or "none"
            raise SpecError(f"The figure {name!r} does not suit the rows of {str(self.folder)!r}. Suitable: {others}.")
        return FIGURES[name].draw(self).save(self.folder / "figures", name, stamp=self.stamp)

    @property
    def results(self) -> list[ResultRow]:
        """Rows with an ``A_drop``."""
        return _done(self.rows)

    @property
    def grid(self) -> list[ResultRow]:
        """Rows of the first surrogate; rows of others are there for comparison."""
        return [row for row in self.rows if row.surrogate == self.rows[0].surrogate]


def read_data(folder: Path) -> Data:
    """The tables of a folder; predictions may be missing. Raises ``SpecError``."""
    rows = read_results(folder)
    predictions = read_table(folder / PREDICTIONS, PredictionRow, optional=True)
    judgements = read_table(folder / JUDGEMENTS, JudgedRow, optional=True)
    return Data(folder, tuple(rows), tuple(predictions), tuple(judgements))


@dataclass(frozen=True)
class Kind:
    """A figure. ``fits``: whether the rows suit it; ``table``: its table in Markdown, if it has one."""

    title: str
    fits: Callable[[Data], bool]
    draw: Callable[[Data], Drawing]
    table: Callable[[Data], str] | None = None


def _done(rows: Sequence[ResultRow]) -> list[ResultRow]:
    return [row for row in rows if row.target_a_drop is not None]


def histogram_rows(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """The first row of each object, for the histograms."""
    first = [group[0] for group in grouped(rows, lambda row: row.object).values()]
    return first[:MOST_PANELS]


def plain_rows(data: Data) -> list[ResultRow]:
    """Rows that attacked all texels with the budget nearest to the paper's 0.05."""
    rows = [row for row in _done(data.grid) if row.tau is None and row.keep is None]
    nearest = min((row.epsilon for row in rows), key=lambda epsilon: abs(epsilon - 0.05), default=0.0)
    return [row for row in rows if row.epsilon == nearest]


def _accuracy_against(
    cost: Cost, title: str, table: Callable[[Data], str] | None = None, *, varied: str = "series"
) -> Kind:
    """Accuracy of configurations against ``cost``, if the rows have several values in the column ``varied``."""
    return Kind(
        f"{title} against accuracy",
        lambda data: _compares(data, cost) and _values(data, varied) > 1,
        lambda data: speed_accuracy_chart(data.results, cost=cost),
        table,
    )


FIGURES: dict[str, Kind] = {
    "table_one": Kind(
        "A_drop per object, classifier and epsilon (the paper's Table I)",
        lambda data: _one_setting(data) and bool(plain_rows(data)),
        lambda data: table_one_chart(data.grid),
        lambda data: table_one_markdown(data.grid),
    ),
    "scatter": Kind(
        "A_drop against the share of texels altered",
        lambda data: _one_setting(data) and len({(row.tau, row.keep) for row in _done(data.grid)}) > 1,
        lambda data: texels_scatter(_done(data.grid)),
        lambda data: paper_means_markdown(data.grid),
    ),
    "surrogates": Kind(
        "What the surrogate predicts, and what the target keeps",
        lambda data: _one_setting(data) and len(surrogates_of(with_all_surrogates(data.results))) > 1,
        lambda data: surrogates_chart(data.results),
        lambda data: surrogates_markdown(data.results),
    ),
    "engines": Kind(
        "Agreement and drop by renderer",
        lambda data: _values(data, "renderers") > 1,
        lambda data: engines_chart(data.results),
        lambda data: engines_markdown(data.results),
    ),
    "between": Kind(
        "What is kept when images are changed on their way to the network",
        lambda data: (
            _values(data, "image_pipeline") > 1
            and bool(with_all_pipelines(data.results))
            and all(row.drops_through for row in data.results)
        ),
        lambda data: between_chart(data.results),
        lambda data: between_markdown(data.results),
    ),
    "baselines": Kind(
        "Methods of painting, judged on the same unseen views",
        lambda data: bool(data.judgements),
        lambda data: baselines_chart(data.judgements),
        lambda data: baselines_markdown(data.judgements),
    ),
    "histograms": Kind(
        "Predicted classes, before and after",
        lambda data: _one_setting(data) and bool(data.predictions and plain_rows(data)),
        lambda data: prediction_histograms(histogram_rows(plain_rows(data)), data.predictions),
    ),
    "speed_accuracy": _accuracy_against("seconds", "Speed", lambda data: pareto_markdown(data.results)),
    "evaluations_accuracy": _accuracy_against("evaluations", "Images shown to the classifier"),
    "visibility": _accuracy_against("delta_e", "Visibility of the change (colour difference)", varied="perceptual"),
    "visibility_ssim": _accuracy_against("dissimilarity", "Visibility of the change (structure)", varied="perceptual"),
    "stability": Kind(
        "Where methods fail",
        lambda data: _cases(data) and not data.judgements,
        lambda data: stability_chart(data.rows),
        lambda data: stability_markdown(data.rows),
    ),
}


def _one_setting(data: Data) -> bool:
    """Whether rows differ only by object, classifier, epsilon, texels, surrogate and seed."""
    columns = ("object", "classifier", "epsilon", "tau", "keep", "surrogate", "seed")
    places = grouped(data.results, lambda row: tuple(getattr(row, name) for name in columns))
    return not _cases(data) and all(len(rows) == 1 for rows in places.values())


def _values(data: Data, column: str) -> int:
    return len({getattr(row, column) for row in data.results})


def _compares(data: Data, cost: Cost) -> bool:
    """Whether the rows are series of configurations with ``cost`` and an object in common."""
    several = _values(data, "configuration") > 2 and _values(data, "series") > 1
    fits = several and not _cases(data) and not _one_setting(data)
    return fits and bool(configurations(data.results, cost=cost))


def _cases(data: Data) -> bool:
    return any(row.case for row in data.rows)


def figures_of(data: Data) -> dict[str, Kind]:
    """The figures that suit the rows."""
    return {name: kind for name, kind in FIGURES.items() if kind.fits(data)}
