"""Paper, ink and tiles: what all report pictures are laid out with. Lengths are in pixels."""

import unicodedata
from collections.abc import Sequence
from functools import cache
from math import ceil
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

__all__ = [
    "CAPTION",
    "GREEN",
    "INK",
    "MARGIN",
    "PAPER",
    "RED",
    "beside",
    "captioned",
    "framed",
    "printable",
    "sheet",
    "shortened",
    "tile",
]

Images = NDArray[np.uint8]
Colour = tuple[int, int, int]

MARGIN: Final = 24
GAP: Final = 8
CAPTION: Final = 14
TITLE: Final = 22
"""Letter sizes."""
LONGEST_TITLE: Final = 960
"""A sheet is made this wide for its title, if it must."""
PAPER: Final = (255, 255, 255)
INK: Final = (38, 38, 38)
GREEN: Final = (0, 158, 115)
RED: Final = (213, 94, 0)
"""Green and red that the colour-blind can tell apart (Okabe and Ito)."""


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size)
    if not isinstance(font, ImageFont.FreeTypeFont):
        raise RuntimeError("This Pillow was built without FreeType, which reports need; install Pillow's wheel.")
    return font


def printable(text: str) -> str:
    """``text`` in the letters that the built-in font has: without accents, ``?`` for what is no Latin letter."""
    letters = (c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))
    return "".join(c if " " <= c <= "~" else "?" for c in letters)


def shortened(text: str, width: int, *, size: int) -> str:
    """``text`` cut at its end, with dots, so that it is at most ``width`` wide in letters of ``size``."""
    font, text = _font(size), printable(text)
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "...") > width:
        text = text[:-1]
    return text.rstrip() + "..."


def tile(image: Images, width: int) -> Image.Image:
    """An (H, W, 3) image scaled to ``width``: smoothly when it shrinks, in visible pixels when it grows."""
    picture = Image.fromarray(np.ascontiguousarray(image))
    height = max(1, round(width * picture.height / picture.width))
    return picture.resize(
        (width, height), Image.Resampling.LANCZOS if width < picture.width else Image.Resampling.NEAREST
    )


def framed(picture: Image.Image, colour: Colour, *, thickness: int) -> Image.Image:
    """The picture with a frame around it, ``thickness`` wide on each side."""
    frame = Image.new("RGB", (picture.width + 2 * thickness, picture.height + 2 * thickness), colour)
    frame.paste(picture, (thickness, thickness))
    return frame


def captioned(picture: Image.Image, text: str, *, colour: Colour = INK) -> Image.Image:
    """The picture with one centred line under it, shortened to the picture's width."""
    card = Image.new("RGB", (picture.width, picture.height + CAPTION + GAP), PAPER)
    card.paste(picture, (0, 0))
    text = shortened(text, picture.width, size=CAPTION)
    x = (picture.width - int(_font(CAPTION).getlength(text))) // 2
    ImageDraw.Draw(card).text((x, picture.height + GAP // 2), text, font=_font(CAPTION), fill=colour)
    return card


def beside(pictures: Sequence[Image.Image], *, gap: int = GAP) -> Image.Image:
    """Pictures side by side, tops aligned."""
    width = sum(picture.width for picture in pictures) + gap * (len(pictures) - 1)
    row = Image.new("RGB", (width, max(picture.height for picture in pictures)), PAPER)
    x = 0
    for picture in pictures:
        row.paste(picture, (x, 0))
        x += picture.width + gap
    return row


def sheet(cards: Sequence[Image.Image], *, columns: int, title: str) -> Image.Image:
    """Cards of one width in rows of ``columns``, under a title. Raises ``ValueError`` when there is no card."""
    if not cards:
        raise ValueError("a sheet needs at least one view or texture")
    rows = [beside(cards[start : start + columns], gap=3 * GAP) for start in range(0, len(cards), columns)]
    font = _font(TITLE)
    title = shortened(title, max(rows[0].width, LONGEST_TITLE), size=TITLE)
    width, top = max(rows[0].width, ceil(font.getlength(title))), MARGIN + TITLE + 2 * GAP
    paper = Image.new(
        "RGB", (width + 2 * MARGIN, top + sum(row.height + 2 * GAP for row in rows) + MARGIN - 2 * GAP), PAPER
    )
    ImageDraw.Draw(paper).text((MARGIN, MARGIN), title, font=font, fill=INK)
    for row in rows:
        paper.paste(row, (MARGIN, top))
        top += row.height + 2 * GAP
    return paper
