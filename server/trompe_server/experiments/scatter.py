"""``A_drop`` against the share of texels altered: how much paint an attack needs."""

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.lines import Line2D

from trompe_server.experiments.groups import grouped, tau_words
from trompe_server.experiments.style import INK, MARKERS, PALETTE, Drawing, drawing
from trompe_server.experiments.table_one import paper_numbers
from trompe_shared.experiment_table import ResultRow

__all__ = ["texels_scatter"]


@dataclass(frozen=True)
class _Dot:
    share: float
    drop: float
    tau: float | None
    epsilon: float


def texels_scatter(rows: Sequence[ResultRow]) -> Drawing:
    """A panel for each classifier, and one for the paper's where it has the same. Colour: tau, marker: epsilon."""
    panels = {name: _dots(group) for name, group in grouped(rows, lambda row: row.classifier).items()}
    for name in list(panels):
        theirs = [
            _Dot(p.texels_altered, p.target_a_drop, p.tau, p.epsilon)
            for p in paper_numbers()
            if p.classifier == name and p.texels_altered is not None and p.target_a_drop is not None
        ]
        if theirs:
            panels[f"{name}, the paper's (Unity)"] = theirs
    dots = [dot for group in panels.values() for dot in group]
    taus = sorted({dot.tau for dot in dots}, key=lambda tau: -1 if tau is None else tau)
    epsilons = sorted({dot.epsilon for dot in dots})
    with drawing(size=(1.6 + 3.4 * len(panels), 4.2), panels=(1, len(panels)), sharey=True) as made:
        for axes, (name, group) in zip(made.panels, panels.items(), strict=True):
            for dot in group:
                colour, marker = PALETTE[taus.index(dot.tau)], MARKERS[epsilons.index(dot.epsilon)]
                axes.plot(100 * dot.share, dot.drop, marker=marker, color=colour, ls="", ms=6, mec="white", mew=0.6)
            axes.set_title(name)
            axes.set_xlabel("texels altered, N (%)")
            axes.set_xlim(left=0)
        made.panels[0].set_ylabel("A_drop in the target (share)")
        handles = [
            *(Line2D([], [], color=PALETTE[k], marker="o", ls="", label=tau_words(tau)) for k, tau in enumerate(taus)),
            *(Line2D([], [], color=INK, marker=MARKERS[k], ls="", label=f"ε {e:g}") for k, e in enumerate(epsilons)),
        ]
        made.figure.legend(handles=handles, loc="outside right upper")
    return made


def _dots(rows: Sequence[ResultRow]) -> list[_Dot]:
    return [
        _Dot(row.texels_altered, row.target_a_drop, row.tau, row.epsilon)
        for row in rows
        if row.texels_altered is not None and row.target_a_drop is not None
    ]
