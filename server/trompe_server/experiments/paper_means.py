"""The paper's grid at a glance: mean ``A_drop`` in the target and mean share of texels altered, ours beside theirs."""

from collections.abc import Iterable, Sequence
from typing import Final

from trompe_server.experiments.groups import average, by_tau, figure_words, grouped, tau_words
from trompe_server.experiments.table_one import PaperCell, paper_numbers
from trompe_server.markdown import markdown_table
from trompe_shared.api import FEW_RECOGNISED
from trompe_shared.experiment_table import ResultRow

__all__ = ["paper_means_markdown"]

OTHERS_ONLY: Final = "inception_v3"
"""The network that only the paper has: what stands beside those in its place."""


def paper_means_markdown(rows: Sequence[ResultRow]) -> str:
    """A line for each classifier and tau, budgets across; means over the objects with A_before >= 0.3."""
    counting = [row for row in rows if (row.target_a_before or 0) >= FEW_RECOGNISED and row.target_a_drop is not None]
    epsilons = sorted({row.epsilon for row in counting})
    told = sorted({cell.epsilon for cell in paper_numbers()} & set(epsilons))
    head = ["classifier", "texels", "objects", "surrogate and target differ by"]
    for epsilon in epsilons:
        head += [f"ε {epsilon:g}", *(["paper's"] * (epsilon in told))]
    lines = []
    for classifier, group in grouped(counting, lambda row: row.classifier).items():
        lines += [_line(classifier, tau, some, epsilons, told) for tau, some in by_tau(group).items()]
    if not any(row.classifier == OTHERS_ONLY for row in counting):
        lines += [_line(OTHERS_ONLY, tau, [], epsilons, told) for tau in by_tau(counting)]
    return markdown_table(head, lines, align="ll" + "r" * (len(head) - 2)) + "\n"


def _line(
    classifier: str, tau: float | None, rows: Sequence[ResultRow], epsilons: Sequence[float], told: Sequence[float]
) -> list[str]:
    gap = average(abs(row.transfer_gap) for row in rows if row.transfer_gap is not None)
    objects = str(len({row.object for row in rows})) if rows else ""
    cells = [classifier, tau_words(tau), objects, figure_words(gap, 3) if rows else ""]
    for epsilon in epsilons:
        some = [row for row in rows if row.epsilon == epsilon]
        cells.append(_ours(some) if some else "")
        if epsilon in told:
            theirs = [cell for cell in paper_numbers() if (cell.classifier, cell.tau) == (classifier, tau)]
            cells.append(_theirs(cell for cell in theirs if cell.epsilon == epsilon))
    return cells


def _ours(rows: Sequence[ResultRow]) -> str:
    drop, share = average(row.target_a_drop for row in rows), average(row.texels_altered for row in rows)
    return f"**{figure_words(drop)}** ({_percent(share)})"


def _theirs(cells: Iterable[PaperCell]) -> str:
    """Over the objects that the paper has a number of; empty where it has not this network."""
    some = [cell for cell in cells if cell.target_a_drop is not None]
    if not some:
        return ""
    drop, share = average(cell.target_a_drop for cell in some), average(cell.texels_altered for cell in some)
    return f"{figure_words(drop)} ({_percent(share)})"


def _percent(share: float | None) -> str:
    return "n.a." if share is None else f"{share:.0%}"
