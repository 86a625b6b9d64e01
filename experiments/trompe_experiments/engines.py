"""Renderers side by side: how well the surrogate agrees with each, and what the paint keeps in it."""

from collections.abc import Sequence
from typing import Final

from trompe_experiments.markdown import figure_words, markdown_table
from trompe_experiments.style import Drawing, drawing, look
from trompe_experiments.table import ResultRow
from trompe_shared.comparison import average, grouped

OWN: Final = "the service's own"
"""Renderers of jobs that named none."""


def engines_chart(rows: Sequence[ResultRow]) -> Drawing:
    """A dot for each job: its attacked renderers by colour; held-out drop, and margin error, for each object."""
    objects, engines = (
        list(dict.fromkeys(values)) for values in zip(*((_what(r), r.renderers) for r in rows), strict=True)
    )
    size = (8.0, 1.4 + 0.45 * len(objects))
    with drawing(size=size, panels=[2], sharey=True) as made:
        for number, engine in enumerate(engines):
            own = [row for row in rows if row.renderers == engine]
            style = look(number) | {"ls": "", "mec": "white", "mew": 0.6}
            places = [objects.index(_what(row)) + 0.12 * (number - (len(engines) - 1) / 2) for row in own]
            labels = (engine or OWN, None)
            for axes, column, label in zip(made.panels, ("judged_drop", "margin_error"), labels, strict=True):
                axes.plot([getattr(row, column) for row in own], places, ms=7, clip_on=False, label=label, **style)
        drops, errors = made.panels
        drops.set_yticks(range(len(objects)), objects)
        drops.invert_yaxis()
        drops.set_xlim(0, 1)
        drops.set_xlabel("A_drop on held-out views (share)")
        errors.set_xlim(left=0)
        errors.locator_params(axis="x", nbins=5)
        errors.set_xlabel("margin error over margin moved (share)")
        made.figure.legend(loc="outside lower center", ncols=4)
    return made


def engines_markdown(rows: Sequence[ResultRow]) -> str:
    """A line for each attacked renderer and budget: means over its jobs."""
    head = ["renderer", "epsilon", "jobs", "surrogate and target disagree", "margin error, worst", "held-out A_drop"]
    lines = [
        [
            engine or OWN,
            f"{epsilon:g}",
            str(len(some)),
            figure_words(average(row.disagreement for row in some), ".1%"),
            figure_words(max((row.margin_error for row in some if row.margin_error is not None), default=None), ".3f"),
            f"**{figure_words(average(row.judged_drop for row in some))}**",
        ]
        for (engine, epsilon), some in grouped(rows, lambda row: (row.renderers, row.epsilon)).items()
    ]
    return markdown_table(head, lines, align="lrrrrr")


def _what(row: ResultRow) -> str:
    return f"{row.object}, ε {row.epsilon:g}"
