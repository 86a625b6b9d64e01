"""What each surrogate promises and what the target keeps of it, and how many texels that took, where all were asked."""

from collections.abc import Sequence

from trompe_server.experiments.groups import average, by_tau, figure_words, grouped, tau_words
from trompe_server.experiments.style import GREY, MARKERS, PALETTE, Drawing, drawing
from trompe_server.markdown import markdown_table
from trompe_shared.api import FEW_RECOGNISED
from trompe_shared.experiment_table import ResultRow

__all__ = ["surrogates_chart", "surrogates_markdown", "surrogates_of"]


def surrogates_of(rows: Sequence[ResultRow]) -> list[str]:
    """The surrogates that were asked for."""
    return list(dict.fromkeys(row.surrogate for row in rows))


def surrogates_chart(rows: Sequence[ResultRow]) -> Drawing:
    """A panel for each tau: a dot for each object and surrogate, promised against kept. On the line nothing is lost."""
    panels, names = by_tau(_asked_of_all(rows)), surrogates_of(rows)
    with drawing(size=(1.2 + 3.2 * len(panels), 3.9), panels=(1, len(panels)), sharex=True, sharey=True) as made:
        for axes, (tau, group) in zip(made.panels, panels.items(), strict=True):
            axes.plot([0, 1], [0, 1], color=GREY, lw=0.8, zorder=1)
            for number, name in enumerate(names):
                dots = [
                    (row.surrogate_a_drop, row.target_a_drop)
                    for row in group
                    if row.surrogate == name and row.surrogate_a_drop is not None and row.target_a_drop is not None
                ]
                axes.plot(
                    [promised for promised, _ in dots],
                    [kept for _, kept in dots],
                    marker=MARKERS[number],
                    color=PALETTE[number],
                    ls="",
                    ms=7,
                    mec="white",
                    mew=0.6,
                    clip_on=False,
                    label=name if axes is made.panels[0] else None,
                )
            axes.set_title(tau_words(tau))
            axes.set_xlabel("A_drop promised by the surrogate (share)")
            axes.set_xlim(0, 1)
            axes.set_ylim(0, 1)
        made.panels[0].set_ylabel("A_drop kept in the target (share)")
        made.figure.legend(loc="outside lower center", ncols=len(names))
    return made


def surrogates_markdown(rows: Sequence[ResultRow]) -> str:
    """For each tau a table: objects down, surrogates across."""
    names = surrogates_of(rows)
    head = ["object", "A_before", *(word for name in names for word in (f"{name}: promised", "kept", "texels altered"))]
    parts = []
    for tau, group in by_tau(_asked_of_all(rows)).items():
        lines = []
        counting = [row for row in group if (row.target_a_before or 0) >= FEW_RECOGNISED]
        for object_, some in grouped(group, lambda row: row.object).items():
            before = average(row.target_a_before for row in some)
            lines.append(_line(object_, figure_words(before), some, names))
        lines.append(_line(f"**mean** of those with A_before ≥ {FEW_RECOGNISED:g}", "", counting, names))
        parts.append(f"**{tau_words(tau)}**\n\n{markdown_table(head, lines, align='l' + 'r' * (len(head) - 1))}")
    return "\n\n".join(parts) + "\n"


def _line(title: str, before: str, rows: Sequence[ResultRow], names: Sequence[str]) -> list[str]:
    cells = [title, before]
    for name in names:
        mine = [row for row in rows if row.surrogate == name]
        promised, kept = average(row.surrogate_a_drop for row in mine), average(row.target_a_drop for row in mine)
        altered = average(row.texels_altered for row in mine)
        cells += [figure_words(promised), f"**{figure_words(kept)}**", "n.a." if altered is None else f"{altered:.1%}"]
    return cells


def _asked_of_all(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """The rows of those jobs that every surrogate has."""
    jobs = grouped(rows, lambda row: (row.object, row.classifier, row.epsilon, row.tau, row.seed))
    return [row for some in jobs.values() if len(surrogates_of(some)) == len(surrogates_of(rows)) for row in some]
