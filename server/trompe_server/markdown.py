"""Tables in Markdown."""

import re
from collections.abc import Iterable, Sequence
from typing import Final

__all__ = ["cells_of", "markdown_row", "markdown_table"]

DELIMITERS: Final = {"l": "---", "r": "---:"}


def markdown_table(header: Sequence[object], rows: Iterable[Iterable[object]], *, align: str | None = None) -> str:
    """A table, without a line break at its end. ``align``: l or r for each column (figures: r); by default all are l.

    Raises ``ValueError`` unless ``align`` has as many letters as there are columns.
    """
    columns = zip(header, align or "l" * len(header), strict=True)
    ruler = "|" + "|".join(DELIMITERS[letter] for _, letter in columns) + "|"
    return "\n".join([markdown_row(header), ruler, *map(markdown_row, rows)])


def markdown_row(cells: Iterable[object]) -> str:
    """A line of a table; ``|`` in cells is escaped."""
    return "| " + " | ".join(str(cell).replace("|", r"\|") for cell in cells) + " |"


def cells_of(line: str) -> list[str]:
    """The cells of what ``markdown_row`` made, without spaces around them."""
    cells = re.split(r"(?<!\\)\|", line)[1:-1]
    return [cell.strip().replace(r"\|", "|") for cell in cells]
