"""Predicted classes of an object: number of views by class, before and after."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.patches import Patch

from trompe_experiments.style import BLUE, ORANGE, Drawing, drawing
from trompe_experiments.table import PredictionRow, ResultRow
from trompe_shared.comparison import grouped
from trompe_shared.errors import SpecError

TOP = 6
COLUMNS = 3


def prediction_histograms(rows: Sequence[ResultRow], predictions: Sequence[PredictionRow]) -> Drawing:
    """A panel for each job of ``rows``: the true class first, then the most frequent ones.

    Raises ``SpecError`` if no row has predictions of the target views.
    """
    by_key = grouped((p for p in predictions if p.views == "target"), lambda p: p.key)
    jobs = [row for row in rows if row.key in by_key]
    if not jobs:
        raise SpecError("No predictions of the target views of these rows; run the experiment again.")
    columns = min(COLUMNS, len(jobs))
    panels = [columns] * -(-len(jobs) // columns)
    with drawing(size=(3.6 * columns, 0.5 + 2.1 * len(panels)), panels=panels) as made:
        for axes, row in zip(made.panels, jobs, strict=False):
            _bars(axes, by_key[row.key])
            axes.set_title(f"{row.object}, ε {row.epsilon:g}" + ("" if row.tau is None else f", τ {row.tau:g}"))
        for axes in made.panels[len(jobs) :]:
            axes.set_axis_off()
        for axes in made.panels[max(0, len(jobs) - columns) : len(jobs)]:
            axes.set_xlabel("views (number)")
        patches = [Patch(color=BLUE, label="before"), Patch(color=ORANGE, label="after")]
        made.figure.legend(handles=patches, loc="outside upper right", ncols=2)
    return made


def _bars(axes: Axes, predictions: Sequence[PredictionRow]) -> None:
    names = {p.class_index: _short(p) for p in predictions}  # two classes may share a name
    by_class = grouped(predictions, lambda p: p.class_index)
    counts = {index: {p.moment: p.count for p in group} for index, group in by_class.items()}
    own = list(dict.fromkeys(p.class_index for p in predictions if p.true_class))
    others = sorted((index for index in counts if index not in own), key=lambda index: -sum(counts[index].values()))
    rest = {moment: sum(counts[index].get(moment, 0) for index in others[TOP:]) for moment in ("before", "after")}
    bars = [(f"{names[index]} (true class)", counts[index]) for index in own]
    bars += [(names[index], counts[index]) for index in others[:TOP]]
    bars += [(f"{len(others) - TOP} others", rest)] if len(others) > TOP else []
    for k, (_, count) in enumerate(bars):
        axes.barh(k - 0.2, count.get("before", 0), height=0.38, color=BLUE)
        axes.barh(k + 0.2, count.get("after", 0), height=0.38, color=ORANGE)
    axes.set_yticks(range(len(bars)), [name for name, _ in bars])
    axes.set_ylim(max(len(bars), 3) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)


def _short(prediction: PredictionRow) -> str:
    return prediction.name.split(",")[0][:26]
