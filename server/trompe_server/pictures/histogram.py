"""Histogram of the predicted classes before and after the attack."""

from collections.abc import Mapping, Sequence
from typing import Final

from PIL import Image, ImageDraw

from trompe_server.pictures.layout import (
    CAPTION,
    GAP,
    INK,
    PAPER,
    Colour,
    beside,
    line,
    sheet,
    stacked,
    swatch,
    text_width,
)

BEFORE: Final = (0, 114, 178)
AFTER: Final = (230, 159, 0)
"""Blue and orange of different lightness, safe for colour-blind readers (Okabe and Ito)."""
NAMES: Final = 260
BARS: Final = 520
COUNTS: Final = 90
LETTERS: Final = 12
TOP: Final = 10
"""Most classes with a bar of their own, beside the object's."""


def prediction_histogram(
    before: Mapping[str, int], after: Mapping[str, int], *, labels: Sequence[str], title: str
) -> Image.Image:
    """Bars with the number of views predicted as each class (by name) before and after.

    The object's classes ``labels`` come first, even with no view; then the ``TOP`` most frequent others; then one bar
    for the rest. Raises ``ValueError`` if ``before`` has no view.
    """
    if not sum(before.values()):
        raise ValueError("a histogram of predictions needs at least one view")
    others = sorted({*before, *after} - {*labels}, key=lambda name: (-before.get(name, 0) - after.get(name, 0), name))
    named = {name: f"{name} (the object)" for name in labels} | {name: name for name in others[:TOP]}
    rows = [_row(said, (before.get(name, 0), after.get(name, 0)), before, after) for name, said in named.items()]
    if rest := others[TOP:]:
        counts = sum(before.get(name, 0) for name in rest), sum(after.get(name, 0) for name in rest)
        rows.append(_row(f"{len(rest)} other classes", counts, before, after))
    return sheet([stacked(rows, gap=GAP)], columns=1, title=title, legend=_legend(before, after))


def _row(name: str, counts: tuple[int, int], before: Mapping[str, int], after: Mapping[str, int]) -> Image.Image:
    """A name and one bar for each count; a full bar means all views."""
    totals = sum(before.values()), sum(after.values())
    colours: Sequence[Colour] = (BEFORE, AFTER)
    bars = [_bar(*row) for row in zip(counts, totals, colours, strict=True)]
    both = stacked(bars, gap=0)
    words = Image.new("RGB", (NAMES, both.height), PAPER)
    words.paste(line(name, NAMES, align="right"), (0, (both.height - CAPTION - GAP) // 2))
    return beside([words, both], gap=2 * GAP)


def _bar(count: int, total: int, colour: Colour) -> Image.Image:
    """A bar as long as its share, followed by count and share."""
    words = line(f"{count} ({count / total:.0%})" if count else "0", COUNTS, size=LETTERS)
    picture = Image.new("RGB", (BARS + COUNTS, words.height), PAPER)
    length = max(1, round(count / total * BARS)) if count else 0
    if count:
        ImageDraw.Draw(picture).rectangle((0, 1, length - 1, words.height - 2), fill=colour)
    picture.paste(words, (length + GAP, 0))
    return picture


def _legend(before: Mapping[str, int], after: Mapping[str, int]) -> Image.Image:
    parts = []
    for word, counts, colour in (("before", before, BEFORE), ("after", after, AFTER)):
        text = f"{word} ({sum(counts.values())} views)"
        parts += [swatch(colour), line(text, text_width(text, size=CAPTION) + 2 * GAP, colour=INK)]
    return beside(parts)
