"""``A_drop`` against the share of texels altered."""

from collections.abc import Iterable
from typing import Any, NamedTuple

from matplotlib.lines import Line2D

from trompe_experiments.paper import paper_numbers, texels_words
from trompe_experiments.style import INK, MARKERS, PALETTE, Drawing, drawing
from trompe_experiments.table import ResultRow
from trompe_shared.comparison import grouped


class _Dot(NamedTuple):
    panel: str
    keep: float | None
    tau: float | None
    epsilon: float
    share: float
    drop: float


def texels_scatter(rows: Iterable[ResultRow]) -> Drawing:
    """A panel for each classifier, and one for the paper's results with it. Colour: texels, marker: epsilon."""
    own = [
        _Dot(r.classifier, r.keep, r.tau, r.epsilon, r.texels_altered, r.target_a_drop)
        for r in rows
        if r.texels_altered is not None and r.target_a_drop is not None
    ]
    names = {dot.panel for dot in own}
    paper = [
        _Dot(f"{p.classifier}, the paper's (Unity)", None, p.tau, p.epsilon, p.texels_altered, p.target_a_drop)
        for p in paper_numbers()
        if p.classifier in names and p.texels_altered is not None and p.target_a_drop is not None
    ]
    dots = [*own, *paper]
    panels = grouped(dots, lambda dot: dot.panel)
    texels = sorted({(dot.keep, dot.tau) for dot in dots}, key=lambda pair: [value or -1.0 for value in pair])
    colours = dict(zip(texels, PALETTE, strict=False))
    markers = dict(zip(sorted({dot.epsilon for dot in dots}), MARKERS, strict=False))
    with drawing(size=(1.6 + 3.4 * len(panels), 4.2), panels=(1, len(panels)), sharey=True) as made:
        for axes, (name, group) in zip(made.panels, panels.items(), strict=True):
            for dot in group:
                look: Any = {"color": colours[dot.keep, dot.tau], "marker": markers[dot.epsilon]}
                axes.plot(100 * dot.share, dot.drop, ls="", ms=6, mec="white", mew=0.6, **look)
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
