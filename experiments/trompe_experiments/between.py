"""What the paint keeps of its effect when images are changed on their way to the network."""

from collections.abc import Sequence
from math import nan
from statistics import fmean
from typing import Final

from trompe_experiments.markdown import figure_words, markdown_table
from trompe_experiments.style import Drawing, drawing, look
from trompe_experiments.table import ResultRow
from trompe_shared.api import OPTIONS
from trompe_shared.comparison import average, grouped

NOTHING: Final = "nothing"
"""Images as they were rendered."""


def between_chart(rows: Sequence[ResultRow]) -> Drawing:
    """A line for each change of the images: a small dot for each job, a large one for the mean of each attack's own
    image pipeline."""
    rows = with_all_pipelines(rows)
    places, attacks = _changes(rows), grouped(rows, lambda row: row.image_pipeline)
    with drawing(size=(7.0, 1.2 + 0.36 * len(places))) as made:
        (axes,) = made.panels
        for number, (attack, own) in enumerate(attacks.items()):
            style = look(number) | {"ls": "", "clip_on": False}
            shift = 0.16 * (number - (len(attacks) - 1) / 2)
            for place, change in enumerate(places):
                drops = [drop for row in own if (drop := _drop(row, change)) is not None]
                axes.plot(drops, [place + shift] * len(drops), ms=3, alpha=0.45, mew=0, **style)
                label = f"attacked through {attack}" if not place else None
                axes.plot(fmean(drops or [nan]), place + shift, ms=8, mec="white", mew=0.6, label=label, **style)
        axes.set_yticks(range(len(places)), places)
        axes.invert_yaxis()
        axes.set_xlim(min(0, axes.dataLim.x0), 1)
        axes.set_xlabel("A_drop on held-out views (share)")
        axes.set_ylabel("in between")
        made.figure.legend(loc="outside lower center", ncols=len(attacks))
    return made


def between_markdown(rows: Sequence[ResultRow]) -> str:
    """A line for each change of the images: mean drop, and the mean share of the undisturbed drop that is kept, at
    most 1, where there is one."""
    rows = with_all_pipelines(rows)
    attacks = grouped(rows, lambda row: row.image_pipeline)
    head = ["in between", *(f"{attack}: {what}" for attack in attacks for what in ("A_drop", "kept"))]
    lines = [
        [change, *(words for own in attacks.values() for words in _line(own, change))] for change in _changes(rows)
    ]
    return markdown_table(head, lines, align="l" + "r" * (len(head) - 1)) + "\n"


def with_all_pipelines(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """A row for each job that ran through every image pipeline of the rows: others would compare other options too."""
    jobs = {job: some[0] for job, some in grouped(rows, lambda row: (row.image_pipeline, *_others(row))).items()}
    pipelines = {row.image_pipeline for row in rows}
    alike = grouped(jobs.values(), _others).values()
    return [row for some in alike if len(some) == len(pipelines) for row in some]


def _others(row: ResultRow) -> tuple[object, ...]:
    """What compared jobs share."""
    return row.object, *(getattr(row, name) for name in OPTIONS if name != "image_pipeline")


def _line(rows: Sequence[ResultRow], change: str) -> list[str]:
    drops = [(_drop(row, change), row.held_out_a_drop) for row in rows]
    kept = [min(1.0, through / plain) for through, plain in drops if through is not None and plain and plain > 0]
    return [figure_words(average(through for through, _ in drops)), f"**{figure_words(average(kept))}**"]


def _changes(rows: Sequence[ResultRow]) -> list[str]:
    return [NOTHING, *dict.fromkeys(change for row in rows for change in row.drops_through)]


def _drop(row: ResultRow, change: str) -> float | None:
    return row.held_out_a_drop if change == NOTHING else row.drops_through.get(change)
