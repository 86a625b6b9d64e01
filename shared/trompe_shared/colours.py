"""Colours by name."""

import re
from typing import Final

COLOURS: Final = {"white": (255, 255, 255), "black": (0, 0, 0)}


def colour_of(text: str) -> tuple[int, int, int] | None:
    """The sRGB colour, 0 to 255, named white, black or #rrggbb; ``None`` for any other text."""
    if text in COLOURS:
        return COLOURS[text]
    if not re.fullmatch("#[0-9a-fA-F]{6}", text):
        return None
    red, green, blue = bytes.fromhex(text[1:])
    return red, green, blue
