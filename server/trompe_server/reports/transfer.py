"""The transfer matrix: what a repaint made through one classifier does to the others."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Final, Literal

import numpy as np
from PIL import Image

from trompe_server.markdown import markdown_table
from trompe_server.reports.heat import heat_colours
from trompe_server.reports.layout import CAPTION, GAP, INK, PAPER, beside, line, sheet, stacked
from trompe_shared.api import FEW_RECOGNISED, Accuracy, Result

__all__ = ["TransferMatrix", "transfer_matrix", "transfer_picture"]

CELL: Final = (180, 64)
NAMES: Final = 220
GREY: Final = (225, 225, 225)
DARK: Final = 400
"""Grounds whose three channels sum to less take light letters."""


@dataclass(frozen=True)
class TransferMatrix:
    """Mean ``a_drop`` by the classifier that was attacked (rows) and the one that judges (columns).

    ``None`` where no result says anything; ``counts`` are the results that each mean is over.
    """

    attacked: tuple[str, ...]
    judging: tuple[str, ...]
    drops: tuple[tuple[float | None, ...], ...]
    counts: tuple[tuple[int, ...], ...]

    def markdown(self) -> str:
        """A table for people: drops to two places, with the number of results they are means of."""
        head = ["attacked \\ judged by", *self.judging]
        rows = [
            [name, *(_words(*cell) for cell in zip(drops, counts, strict=True))]
            for name, drops, counts in zip(self.attacked, self.drops, self.counts, strict=True)
        ]
        return markdown_table(head, rows, align="l" + "r" * len(self.judging)) + "\n"

    def csv(self) -> str:
        """A table for programs: a line for each cell, ``a_drop`` empty where it is n.a."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["attacked", "judge", "a_drop", "results"])
        for name, drops, counts in zip(self.attacked, self.drops, self.counts, strict=True):
            for judge, drop, count in zip(self.judging, drops, counts, strict=True):
                writer.writerow([name, judge, "" if drop is None else f"{drop:.6g}", count])
        return text.getvalue()


def transfer_matrix(
    results: Sequence[Result], *, views: Literal["target", "held_out"], least_before: float = FEW_RECOGNISED
) -> TransferMatrix:
    """The matrix of some results, of several objects or seeds, judged on the attack's own or on the held-out views.

    An ensemble is a row of its own, named after its members. Each cell is the mean of those results whose judge
    recognised the object in the share ``least_before`` of the views, or more, before the attack. Rows and columns are
    in the order of the results.
    """
    found: dict[tuple[str, str], list[float]] = {}
    for result in results:
        judged = [(result.classifier, getattr(result, views))]
        judged += [(judge.classifier, getattr(judge, views)) for judge in result.judges]
        attacked_together = " + ".join([result.classifier, *result.ensemble])
        for name, accuracy in judged:
            found.setdefault((attacked_together, name), []).extend(_drop(accuracy, least_before))
    attacked = tuple(dict.fromkeys(row for row, _ in found))
    judging = tuple(dict.fromkeys(column for _, column in found))
    cells = [[found.get((row, column), []) for column in judging] for row in attacked]
    return TransferMatrix(
        attacked,
        judging,
        tuple(tuple(fmean(drops) if drops else None for drops in row) for row in cells),
        tuple(tuple(len(drops) for drops in row) for row in cells),
    )


def _drop(accuracy: Accuracy | None, least_before: float) -> list[float]:
    if accuracy is None or accuracy.a_drop is None or accuracy.a_before < least_before:
        return []
    return [accuracy.a_drop]


def _words(drop: float | None, count: int) -> str:
    return "n.a." if drop is None else f"{drop:.2f} ({count})"


def transfer_picture(matrix: TransferMatrix, *, title: str) -> Image.Image:
    """The matrix in colours, the lighter the larger the drop; cells that are n.a. are grey."""
    head = beside(
        [line("attacked, judged by:", NAMES)] + [line(name, CELL[0], align="centre") for name in matrix.judging]
    )
    rows = [
        beside([_name(name), *(_cell(*cell) for cell in zip(drops, counts, strict=True))])
        for name, drops, counts in zip(matrix.attacked, matrix.drops, matrix.counts, strict=True)
    ]
    return sheet([stacked([head, *rows])], columns=1, title=title)


def _name(name: str) -> Image.Image:
    picture = Image.new("RGB", (NAMES, CELL[1]), PAPER)
    picture.paste(line(name, NAMES, align="right"), (0, (CELL[1] - CAPTION - GAP) // 2))
    return picture


def _cell(drop: float | None, count: int) -> Image.Image:
    """A drop on its colour, under it over how many results it is a mean."""
    red, green, blue = (round(float(c)) for c in heat_colours(np.array(drop))) if drop is not None else GREY
    ground = (red, green, blue)
    ink = PAPER if sum(ground) < DARK else INK
    words = [
        line("n.a." if drop is None else f"{drop:.2f}", CELL[0], size=22, colour=ink, ground=ground, align="centre")
    ]
    if count:
        words.append(line(f"of {count}", CELL[0], colour=ink, ground=ground, align="centre"))
    text = stacked(words, gap=0)
    picture = Image.new("RGB", CELL, ground)
    picture.paste(text, (0, (CELL[1] - text.height) // 2))
    return picture
