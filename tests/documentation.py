"""Code blocks of the pages in docs/, and their reader."""

import os
import re
import sysconfig
from pathlib import Path
from typing import Final

DOCS: Final = Path(__file__).parents[1] / "docs"


def blocks(page: str, language: str) -> list[tuple[str, str]]:
    """(heading, code) of a page's blocks in ``language``."""
    heading, found = "", []
    for match in re.finditer(r"^#+ ([^\n]+)$|^```(\w+)\n(.*?)^```", (DOCS / page).read_text(), re.M | re.S):
        heading = match[1] or heading
        if match[2] == language:
            found.append((heading, match[3]))
    return found


def readers_environment(**variables: str) -> dict[str, str]:
    """The environment of a reader who has the commands of this installation."""
    return os.environ | variables | {"PATH": f"{sysconfig.get_path('scripts')}:{os.environ['PATH']}"}
