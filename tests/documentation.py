"""The pages of docs/, as tests read them."""

import re
from pathlib import Path
from typing import Final

__all__ = ["DOCS", "blocks"]

DOCS: Final = Path(__file__).parents[1] / "docs"


def blocks(page: str, language: str) -> list[tuple[str, str]]:
    """(heading, code) of the blocks of a page that are in ``language``."""
    heading, found = "", []
    for match in re.finditer(r"^#+ ([^\n]+)$|^```(\w+)\n(.*?)^```", (DOCS / page).read_text(), re.M | re.S):
        heading = match[1] or heading
        if match[2] == language:
            found.append((heading, match[3]))
    return found
