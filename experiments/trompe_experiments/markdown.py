"""Tables in Markdown, and numbers as they are printed in tables."""

import re
from collections.abc import Iterable, Sequence
from typing import Final

DELIMITERS: Final = {"l": "---", "r": "---:"}

NOT_APPLICABLE: Final = "n.a."


def markdown_table(header: Sequence[object], rows: Iterable[Iterable[object]], *, align: str | None = None) -> str:
    """A table without a final line break. ``align``: l or r for each column (numbers: r); default: all l.

    Raises ``ValueError`` unless ``align`` has one letter for each column.
    """
    columns = zip(header, align or "l" * len(header), strict=True)
    ruler = "|" + "|".join(DELIMITERS[letter] for _, letter in columns) + "|"
    return "\n".join([markdown_row(header), ruler, *map(markdown_row, rows)])


def markdown_row(cells: Iterable[object]) -> str:
    """A line of a table; ``|`` in cells is escaped."""
    return "| " + " | ".join(str(cell).replace("|", r"\|") for cell in cells) + " |"


def cells_of(line: str) -> list[str]:
    """The cells of a line from ``markdown_row``, without spaces around them."""
    cells = re.split(r"(?<!\\)\|", line)[1:-1]
    return [cell.strip().replace(r"\|", "|") for cell in cells]


def figure_words(value: float | None, form: str = ".2f") -> str:
    """A number for tables."""
    return NOT_APPLICABLE if value is None else format(value, form)
