"""The paper's Table I, means and scatter plot, ours beside the paper's.

The paper's numbers were published with its code: ``analyze_data.ipynb`` of sailab-code/SAIFooler at commit 65d208e
(its printed tables; their means, 0.59 and 0.31 at epsilon 0.05, are the paper's). Its target is Unity, ours pyrender:
we compare the problem, not the pixels.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from pydantic import BaseModel

from trompe_experiments.markdown import figure_words, markdown_table
from trompe_experiments.style import BLUE, GREEN, GREY, INK, Drawing, drawing, look
from trompe_experiments.table import ResultRow, read_table
from trompe_shared.api import FEW_RECOGNISED
from trompe_shared.comparison import average, grouped

SUBSTITUTED: Final = "inception_v3"
"""The paper's network that we do not have."""
MEAN: Final = f"**mean** where A_before ≥ {FEW_RECOGNISED:g}"


class PaperCell(BaseModel, frozen=True):
    """The paper's result for one object, classifier, epsilon and tau (``None``: no saliency). ``None``: n.a."""

    object: str
    classifier: str
    epsilon: float
    tau: float | None
    target_a_drop: float | None
    texels_altered: float | None
    keep: float | None = None


@dataclass(frozen=True)
class Cell:
    """One object, classifier and epsilon: means over seeds, and the paper's result if it has one."""

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
        """Whether means include the cell: enough views were recognised."""
        return self.target is not None and (self.a_before or 0) >= FEW_RECOGNISED


@cache
def paper_numbers() -> tuple[PaperCell, ...]:
    """The paper's results."""
    return tuple(read_table(Path(__file__).with_name("paper_table.csv"), PaperCell))


def recognised(rows: Iterable[ResultRow]) -> list[ResultRow]:
    """Rows with an ``A_drop`` on an object that the classifier recognised in enough views."""
    return [row for row in rows if (row.target_a_before or 0) >= FEW_RECOGNISED and row.target_a_drop is not None]


def texels_words(tau: float | None, keep: float | None = None) -> str:
    """The attacked texels."""
    if keep is not None:
        return f"best {100 * keep:.3g} % of texels"
    return "all texels" if tau is None else f"saliency, τ {tau:g}"


def by_texels(rows: Iterable[ResultRow]) -> dict[str, list[ResultRow]]:
    """Rows by attacked texels: all of them first, then by ascending tau and ``keep``."""
    ordered = sorted(rows, key=lambda row: (row.keep or -1.0, row.tau or -1.0))
    return grouped(ordered, lambda row: texels_words(row.tau, row.keep))


def table_one(rows: Sequence[ResultRow]) -> list[Cell]:
    """Cells of the rows that attacked all texels, in their order."""
    paper = {(p.object, p.classifier, p.epsilon): p for p in paper_numbers() if p.tau is None}
    plain = [row for row in rows if row.tau is None and row.keep is None]
    cells = []
    for key, group in grouped(plain, lambda row: (row.object, row.classifier, row.epsilon)).items():
        columns = ("target_a_before", "surrogate_a_drop", "target_a_drop", "held_out_a_drop")
        before, surrogate, target, held_out = (average(getattr(row, name) for row in group) for name in columns)
        cells.append(Cell(*key, before, surrogate, target, held_out, paper.get(key)))
    return cells


def table_one_markdown(rows: Sequence[ResultRow]) -> str:
    """A table for each classifier: a line for each object and epsilon, and for the means."""
    parts = []
    for classifier, cells in grouped(table_one(rows), lambda cell: cell.classifier).items():
        known = any(cell.paper for cell in cells)
        by_epsilon = grouped(sorted(cells, key=lambda cell: cell.epsilon), lambda cell: cell.epsilon)
        lines = [_line(cell.object, epsilon, [cell]) for epsilon, some in by_epsilon.items() for cell in some]
        lines += [_line(MEAN, epsilon, [cell for cell in some if cell.counts]) for epsilon, some in by_epsilon.items()]
        head = ["object", "ε", "A_before", "surrogate", "target", "paper: target"]
        table = markdown_table(head, lines, align="lrrrrr")
        parts.append(f"**{classifier}**{'' if known else _not_in_the_paper()}\n\n{table}\n")
    return "\n".join(parts)


def _line(title: str, epsilon: float, cells: Sequence[Cell]) -> list[str]:
    columns = ("a_before", "surrogate", "target")
    before, surrogate, target = (average(getattr(cell, name) for cell in cells) for name in columns)
    paper = [cell.paper for cell in cells if cell.paper]
    theirs = figure_words(average(each.target_a_drop for each in paper)) if paper else ""
    return [title, f"{epsilon:g}", figure_words(before), figure_words(surrogate), f"**{figure_words(target)}**", theirs]


def _not_in_the_paper() -> str:
    """The paper's means of the network that another one replaces."""
    cells = [p for p in paper_numbers() if (p.classifier, p.tau) == (SUBSTITUTED, None)]
    means = [
        f"{figure_words(average(p.target_a_drop for p in some))} at ε {epsilon:g}"
        for epsilon, some in grouped(cells, lambda p: p.epsilon).items()
    ]
    return f" (not in the paper; mean target A_drop of its InceptionV3: {', '.join(means)})"


def paper_means_markdown(rows: Sequence[ResultRow]) -> str:
    """Means over recognised objects by classifier, texels and epsilon; texels altered in brackets."""
    counting = recognised(rows)
    epsilons = sorted({row.epsilon for row in counting})
    head = ["classifier", "texels", "ε", "surrogate - target", "target A_drop", "paper's"]
    lines = []
    for classifier, group in grouped(counting, lambda row: row.classifier).items():
        for texels, some in by_texels(group).items():
            for epsilon in epsilons:
                own = [row for row in some if row.epsilon == epsilon]
                if own:
                    gap = average(abs(row.transfer_gap) for row in own if row.transfer_gap is not None)
                    theirs = _papers(classifier, epsilon, own[0]) if own[0].keep is None else ""
                    ours = f"**{_drop_and_share(own)}**"
                    lines.append([classifier, texels, f"{epsilon:g}", figure_words(gap, ".3f"), ours, theirs])
    if SUBSTITUTED not in {row.classifier for row in counting}:
        for texels, some in by_texels(row for row in counting if row.keep is None).items():
            told = [(epsilon, _papers(SUBSTITUTED, epsilon, some[0])) for epsilon in epsilons]
            lines += [[SUBSTITUTED, texels, f"{epsilon:g}", "", "", theirs] for epsilon, theirs in told if theirs]
    return markdown_table(head, lines, align="llrrrr") + "\n"


def _papers(classifier: str, epsilon: float, row: ResultRow) -> str:
    place = (classifier, epsilon, row.tau)
    return _drop_and_share([p for p in paper_numbers() if (p.classifier, p.epsilon, p.tau) == place])


def _drop_and_share(cells: Sequence[ResultRow | PaperCell]) -> str:
    known = [cell for cell in cells if cell.target_a_drop is not None]
    drop, share = (average(getattr(cell, name) for cell in known) for name in ("target_a_drop", "texels_altered"))
    return f"{figure_words(drop)} ({figure_words(share, '.0%')})" if known else ""


def table_one_chart(rows: Sequence[ResultRow]) -> Drawing:
    """A row of panels for each classifier, a panel for each epsilon, a line for each object."""
    cells = table_one(rows)
    classifiers = list(dict.fromkeys(cell.classifier for cell in cells))
    panels = grouped(cells, lambda cell: (classifiers.index(cell.classifier), cell.epsilon))
    places = sorted(panels)
    objects = list(dict.fromkeys(cell.object for cell in cells))
    counts = [len(row) for row in grouped(places, lambda place: place[0]).values()]
    size = (1.8 + 2.6 * max(counts), 0.8 + (0.9 + 0.26 * len(objects)) * len(counts))
    with drawing(size=size, panels=counts, sharex=True, sharey=True) as made:
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
    own = f"ours, target (faint: A_before < {FEW_RECOGNISED:g})"
    marks = [
        Line2D([], [], marker="o", ms=7, color=BLUE, ls="", label=own),
        Line2D([], [], marker="D", ms=5, color=GREEN, ls="", label="ours, held-out views"),
    ]
    if paper:
        marks.append(Line2D([], [], marker="o", ms=7, mfc="white", mec=INK, ls="", label="the paper's target (Unity)"))
    made.figure.legend(handles=marks, loc="outside lower center", ncols=3)


def texels_scatter(rows: Iterable[ResultRow]) -> Drawing:
    """A panel for each classifier, and one for the paper's results with it. Colour: texels, marker: epsilon."""
    own = [row for row in rows if row.texels_altered is not None and row.target_a_drop is not None]
    names = {row.classifier for row in own}
    paper = [p for p in paper_numbers() if p.classifier in names and None not in (p.texels_altered, p.target_a_drop)]
    panels: dict[str, list[Any]] = {
        **grouped(own, lambda row: row.classifier),
        **grouped(paper, lambda p: f"{p.classifier}, the paper's (Unity)"),
    }
    dots = [dot for group in panels.values() for dot in group]
    texels = sorted({(dot.keep, dot.tau) for dot in dots}, key=lambda pair: [value or -1.0 for value in pair])
    colours = {pair: look(k)["color"] for k, pair in enumerate(texels)}
    markers = {epsilon: look(k)["marker"] for k, epsilon in enumerate(sorted({dot.epsilon for dot in dots}))}
    with drawing(size=(1.6 + 3.4 * len(panels), 4.2), panels=[len(panels)], sharey=True) as made:
        for axes, (name, group) in zip(made.panels, panels.items(), strict=True):
            for dot in group:
                style: Any = {"color": colours[dot.keep, dot.tau], "marker": markers[dot.epsilon]}
                axes.plot(100 * dot.texels_altered, dot.target_a_drop, ls="", ms=6, mec="white", mew=0.6, **style)
            axes.set_title(name)
            axes.set_xlabel("texels altered, N (%)")
            axes.set_xlim(left=0)
        made.panels[0].set_ylabel("A_drop in the target (share)")
        handles = [
            *(Line2D([], [], color=c, marker="o", ls="", label=texels_words(t, k)) for (k, t), c in colours.items()),
            *(Line2D([], [], color=INK, marker=marker, ls="", label=f"ε {e:g}") for e, marker in markers.items()),
        ]
        made.figure.legend(handles=handles, loc="outside right upper")
    return made
