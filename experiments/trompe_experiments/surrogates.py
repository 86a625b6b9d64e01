"""Surrogates side by side: predicted drop, drop kept in the target, texels altered."""

from collections.abc import Sequence

from trompe_experiments.markdown import figure_words, markdown_table
from trompe_experiments.paper import MEAN, by_texels, recognised
from trompe_experiments.style import GREY, Drawing, drawing, look
from trompe_experiments.table import ResultRow
from trompe_shared.comparison import average, grouped


def surrogates_of(rows: Sequence[ResultRow]) -> list[str]:
    """The surrogates of the rows, in their order."""
    return list(dict.fromkeys(row.surrogate for row in rows))


def surrogates_chart(rows: Sequence[ResultRow]) -> Drawing:
    """A panel for each choice of texels, a dot for each object and surrogate: predicted against kept."""
    panels, names = by_texels(with_all_surrogates(rows)), surrogates_of(rows)
    with drawing(size=(1.2 + 3.2 * len(panels), 3.9), panels=[len(panels)], sharex=True, sharey=True) as made:
        for axes, (texels, group) in zip(made.panels, panels.items(), strict=True):
            axes.plot([0, 1], [0, 1], color=GREY, lw=0.8, zorder=1)
            for number, name in enumerate(names):
                own = [row for row in group if row.surrogate == name]
                drops = [(row.surrogate_a_drop, row.target_a_drop) for row in own]
                style = look(number) | {"mec": "white", "ms": 7, "mew": 0.6}
                label = name if axes is made.panels[0] else None
                axes.plot(*zip(*drops, strict=True), ls="", clip_on=False, label=label, **style)
            axes.set_title(texels)
            axes.set_xlabel("A_drop predicted by the surrogate (share)")
            axes.set_xlim(0, 1)
            axes.set_ylim(0, 1)
        made.panels[0].set_ylabel("A_drop kept in the target (share)")
        made.figure.legend(loc="outside lower center", ncols=len(names))
    return made


def surrogates_markdown(rows: Sequence[ResultRow]) -> str:
    """A table for each choice of texels: a line for each object and surrogate, and for the means."""
    head = ["object", "surrogate", "A_before", "predicted", "kept", "texels altered"]
    parts = []
    for texels, group in by_texels(with_all_surrogates(rows)).items():
        objects = grouped(group, lambda row: row.object) | {MEAN: recognised(group)}
        lines = [_line(title, name, some) for title, some in objects.items() for name in surrogates_of(rows)]
        parts.append(f"**{texels}**\n\n{markdown_table(head, lines, align='llrrrr')}")
    return "\n\n".join(parts) + "\n"


def _line(title: str, name: str, rows: Sequence[ResultRow]) -> list[str]:
    own = [row for row in rows if row.surrogate == name]
    columns = ("target_a_before", "surrogate_a_drop", "target_a_drop", "texels_altered")
    before, predicted, kept, altered = (average(getattr(row, column) for row in own) for column in columns)
    cells = [figure_words(before), figure_words(predicted), f"**{figure_words(kept)}**", figure_words(altered, ".1%")]
    return [title, name, *cells]


def with_all_surrogates(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Rows of the jobs that ran with every surrogate."""
    jobs = grouped(rows, lambda row: (row.object, row.classifier, row.epsilon, row.tau, row.keep, row.seed))
    return [row for some in jobs.values() if len(surrogates_of(some)) == len(surrogates_of(rows)) for row in some]
