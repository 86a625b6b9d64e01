"""The paper's Table I: ``A_drop`` per object, classifier and epsilon, in the surrogate and in the target; ours beside
the paper's.

The paper's numbers are those that its authors published with their code: ``analyze_data.ipynb`` of
sailab-code/SAIFooler at commit 65d208e (the tables that it prints; their means, 0.59 and 0.31 at epsilon 0.05, are the
paper's).
Its target is Unity, ours pyrender: the comparison is of the problem, not of the same pixels.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from statistics import fmean

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from trompe_server.experiments.groups import average, figure_words, grouped
from trompe_server.experiments.style import BLUE, GREEN, GREY, INK, Drawing, drawing_in_rows
from trompe_server.markdown import markdown_table
from trompe_shared.api import FEW_RECOGNISED
from trompe_shared.experiment_table import ResultRow

__all__ = ["Cell", "PaperCell", "paper_numbers", "table_one", "table_one_chart", "table_one_markdown"]


@dataclass(frozen=True)
class PaperCell:
    """What the paper reports of one object, classifier, epsilon and tau (``None``: no saliency). ``None``: n.a."""

    object: str
    classifier: str
    epsilon: float
    tau: float | None
    surrogate_a_drop: float | None
    target_a_drop: float | None
    texels_altered: float | None


@dataclass(frozen=True)
class Cell:
    """One object, classifier and epsilon: means over seeds, and the paper's cell where there is one."""

    object: str
    classifier: str
    epsilon: float
    a_before: float | None
    surrogate: float | None
    target: float | None
    held_out: float | None
    paper: PaperCell | None

    @property
    def counts(self) -> bool:
        """Whether enough was recognised for the cell to count in a mean."""
        return self.target is not None and self.a_before is not None and self.a_before >= FEW_RECOGNISED


@cache
def paper_numbers() -> tuple[PaperCell, ...]:
    """The paper's cells."""
    text = resources.files("trompe_server.experiments").joinpath("paper_table.csv").read_text("utf-8")

    def number(word: str) -> float | None:
        return float(word) if word else None

    return tuple(
        PaperCell(
            row["object"],
            row["classifier"],
            float(row["epsilon"]),
            number(row["tau"]),
            number(row["surrogate_a_drop"]),
            number(row["target_a_drop"]),
            number(row["texels_altered"]),
        )
        for row in csv.DictReader(text.splitlines())
    )


def table_one(rows: Sequence[ResultRow]) -> list[Cell]:
    """The cells of the rows without saliency, in their order."""
    paper = {(p.object, p.classifier, p.epsilon): p for p in paper_numbers() if p.tau is None}
    plain = [row for row in rows if row.tau is None]
    cells = []
    for key, group in grouped(plain, lambda row: (row.object, row.classifier, row.epsilon)).items():
        cells.append(
            Cell(
                *key,
                average(row.target_a_before for row in group),
                average(row.surrogate_a_drop for row in group),
                average(row.target_a_drop for row in group),
                average(row.held_out_a_drop for row in group),
                paper.get(key),
            )
        )
    return cells


def table_one_markdown(rows: Sequence[ResultRow]) -> str:
    """A table for each classifier: objects down, budgets across."""
    parts = []
    for classifier, cells in grouped(table_one(rows), lambda cell: cell.classifier).items():
        known = any(cell.paper for cell in cells)
        parts.append(f"**{classifier}**{'' if known else _substitute()}\n\n{_markdown(cells, with_paper=known)}")
    return "\n".join(parts)


def _substitute() -> str:
    """What stands beside a network that the paper did not use: its other one's means."""
    means = [
        f"{fmean(found):.2f} at ε {epsilon:g}"
        for epsilon in (0.05, 0.1, 0.5)
        if (found := [p.target_a_drop for p in _inception(epsilon) if p.target_a_drop is not None])
    ]
    return (
        f" (the paper has no such network; the mean target A_drop of its InceptionV3, by epsilon: {', '.join(means)})"
    )


def _inception(epsilon: float) -> list[PaperCell]:
    every = paper_numbers()
    return [p for p in every if (p.classifier, p.epsilon, p.tau) == ("inception_v3", epsilon, None)]


def _markdown(cells: Sequence[Cell], *, with_paper: bool) -> str:
    epsilons = sorted({cell.epsilon for cell in cells})
    told = {epsilon for epsilon in epsilons if with_paper and any(c.paper for c in cells if c.epsilon == epsilon)}
    head = ["object", "A_before"]
    for epsilon in epsilons:
        head += [f"surrogate, ε {epsilon:g}", "target", *(["paper: surrogate", "paper: target"] * (epsilon in told))]
    lines = []
    for object_, row in grouped(cells, lambda cell: cell.object).items():
        by_epsilon = {cell.epsilon: cell for cell in row}
        figures = [figure_words(row[0].a_before)]
        for epsilon in epsilons:
            figures += _figures(by_epsilon.get(epsilon), with_paper=epsilon in told)
        lines.append([object_, *figures])
    means = [text for epsilon in epsilons for text in _means(cells, epsilon, with_paper=epsilon in told)]
    lines.append([f"**mean** of those with A_before ≥ {FEW_RECOGNISED:g}", "", *means])
    return markdown_table(head, lines, align="l" + "r" * (len(head) - 1)) + "\n"


def _figures(cell: Cell | None, *, with_paper: bool) -> list[str]:
    if cell is None:
        return [""] * (4 if with_paper else 2)
    own = [figure_words(cell.surrogate), f"**{figure_words(cell.target)}**"]
    theirs = (cell.paper.surrogate_a_drop, cell.paper.target_a_drop) if cell.paper else (None, None)
    return own + ([figure_words(value) for value in theirs] if with_paper else [])


def _means(cells: Sequence[Cell], epsilon: float, *, with_paper: bool) -> list[str]:
    """Ours over the objects that count, the paper's over those it has a number of."""
    some = [cell for cell in cells if cell.epsilon == epsilon]
    own, paper = [cell for cell in some if cell.counts], [cell.paper for cell in some if cell.paper]
    means = [average(cell.surrogate for cell in own), average(cell.target for cell in own)]
    if with_paper:
        means += [average(p.surrogate_a_drop for p in paper), average(p.target_a_drop for p in paper)]
    return [f"**{figure_words(value)}**" for value in means]


def table_one_chart(rows: Sequence[ResultRow]) -> Drawing:
    """A row for each classifier, a panel for each epsilon, a line for each object: the paper's target, ours, and
    held-out views."""
    cells = table_one(rows)
    classifiers = list(dict.fromkeys(cell.classifier for cell in cells))
    panels = grouped(cells, lambda cell: (classifiers.index(cell.classifier), cell.epsilon))
    places = sorted(panels)
    objects = list(dict.fromkeys(cell.object for cell in cells))
    counts = [len(row) for row in grouped(places, lambda place: place[0]).values()]
    size = (1.8 + 2.6 * max(counts), 0.8 + (0.9 + 0.26 * len(objects)) * len(counts))
    with drawing_in_rows(size=size, rows=counts, sharex=True, sharey=True) as made:
        for axes, place in zip(made.panels, places, strict=True):
            for cell in panels[place]:
                _draw_line(axes, objects.index(cell.object), cell)
            axes.set_title(f"{classifiers[place[0]]}, ε = {place[1]:g}")
            axes.set_yticks(range(len(objects)), objects)
            axes.axvline(0, color=GREY, lw=0.8)
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("A_drop (share)" if place[0] == places[-1][0] else "")
        made.panels[0].set_ylim(len(objects) - 0.5, -0.5)
        made.panels[0].set_xlim(right=1.06)
        _legend(made, paper=any(cell.paper for cell in cells))
    return made


def _draw_line(axes: Axes, y: int, cell: Cell) -> None:
    theirs = cell.paper.target_a_drop if cell.paper else None
    ends = [value for value in (theirs, cell.target) if value is not None]
    if len(ends) == 2:
        axes.plot(ends, [y, y], color="#CCCCCC", lw=2, zorder=1)
    if cell.held_out is not None:
        axes.plot(cell.held_out, y, marker="D", ms=5, color=GREEN, ls="", zorder=2)
    if theirs is not None:
        axes.plot(theirs, y, marker="o", ms=7, mfc="white", mec=INK, ls="", zorder=3)
    if cell.target is None:
        axes.text(0.02, y, "n.a.", va="center", fontsize=7, color=GREY)
    else:
        axes.plot(cell.target, y, marker="o", ms=7, color=BLUE, alpha=1 if cell.counts else 0.35, ls="", zorder=4)


def _legend(made: Drawing, *, paper: bool) -> None:
    marks = [
        Line2D(
            [], [], marker="o", ms=7, color=BLUE, ls="", label=f"ours, target (faint: A_before < {FEW_RECOGNISED:g})"
        ),
        Line2D([], [], marker="D", ms=5, color=GREEN, ls="", label="ours, held-out views"),
    ]
    if paper:
        marks.append(Line2D([], [], marker="o", ms=7, mfc="white", mec=INK, ls="", label="the paper's target (Unity)"))
    made.figure.legend(handles=marks, loc="outside lower center", ncols=3)
