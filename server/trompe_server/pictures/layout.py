"""Layout of all report pictures: colours, text, tiles, sheets. Lengths are in pixels."""

import unicodedata
from collections.abc import Mapping, Sequence
from functools import cache
from math import ceil
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, ImageOps

Images = NDArray[np.uint8]
Colour = tuple[int, int, int]
Align = Literal["left", "centre", "right"]

MARGIN: Final = 24
GAP: Final = 8
CAPTION: Final = 14
TITLE: Final = 22
"""Letter sizes."""
LONGEST_TITLE: Final = 960
"""Widest sheet for the sake of its title."""
PAPER: Final = (255, 255, 255)
INK: Final = (38, 38, 38)
GREEN: Final = (0, 158, 115)
RED: Final = (213, 94, 0)
"""Green and red that are safe for colour-blind readers (Okabe and Ito)."""


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size)
    if not isinstance(font, ImageFont.FreeTypeFont):
        raise RuntimeError("This Pillow was built without FreeType, which reports need; install Pillow's wheel.")
    return font


def printable(text: str) -> str:
    """``text`` in the letters of the built-in font: without accents, ``?`` for other scripts."""
    letters = (c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))
    return "".join(c if " " <= c <= "~" else "?" for c in letters)


def shortened(text: str, width: int, *, size: int) -> str:
    """``text``, cut and followed by dots if wider than ``width`` in letters of ``size``."""
    font, text = _font(size), printable(text)
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "...") > width:
        text = text[:-1]
    return text.rstrip() + "..."


def text_width(text: str, *, size: int) -> int:
    """Width of the printable form of ``text`` in letters of ``size``."""
    return ceil(_font(size).getlength(printable(text)))


def line(
    text: str, width: int | None = None, *, size: int = CAPTION, colour: Colour = INK, align: Align = "left"
) -> Image.Image:
    """A picture of ``width`` with one line of text, shortened to fit; by default as wide as the text."""
    width = text_width(text, size=size) if width is None else width
    picture = Image.new("RGB", (width, size + GAP), PAPER)
    text = shortened(text, width, size=size)
    room = width - int(_font(size).getlength(text))
    x = {"left": 0, "centre": room // 2, "right": room}[align]
    ImageDraw.Draw(picture).text((x, GAP // 2), text, font=_font(size), fill=colour)
    return picture


def swatch(ground: Colour, *, outline: Colour | None = None) -> Image.Image:
    """A small coloured square for a legend."""
    picture = Image.new("RGB", (CAPTION, CAPTION + GAP), PAPER)
    square = (0, GAP // 2, CAPTION - 1, GAP // 2 + CAPTION - 1)
    ImageDraw.Draw(picture).rectangle(square, fill=ground, outline=outline or ground, width=2)
    return picture


def tile(image: Images, width: int) -> Image.Image:
    """An (H, W, 3) image scaled to fit a square of ``width``: filtered down, but enlarged in visible pixels."""
    picture = Image.fromarray(np.ascontiguousarray(image))
    longest = max(picture.size)
    columns, rows = (max(1, round(width * side / longest)) for side in picture.size)
    return picture.resize((columns, rows), Image.Resampling.LANCZOS if width < longest else Image.Resampling.NEAREST)


def captioned(picture: Image.Image, text: str, *, colour: Colour = INK, width: int = 0) -> Image.Image:
    """The picture, centred in ``width`` if narrower, with one centred line of text below, shortened to fit."""
    spare = max(0, width - picture.width)
    picture = ImageOps.expand(picture, (spare // 2, 0, spare - spare // 2, 0), PAPER)
    return stacked([picture, line(text, picture.width, colour=colour, align="centre")], gap=0)


def framed(pictures: Mapping[str, Images], width: int) -> Image.Image:
    """(H, W, 3) images side by side, scaled to fit squares of ``width`` and framed, each above its caption."""
    return beside([captioned(frame(image, width), text, width=width + 2) for text, image in pictures.items()])


def frame(image: Images, width: int) -> Image.Image:
    """An (H, W, 3) image scaled to fit a square of ``width``, in a thin frame."""
    return ImageOps.expand(tile(image, width), 1, INK)


def beside(pictures: Sequence[Image.Image], *, gap: int = GAP) -> Image.Image:
    """Pictures side by side, tops aligned."""
    width = sum(picture.width for picture in pictures) + gap * (len(pictures) - 1)
    row = Image.new("RGB", (width, max(picture.height for picture in pictures)), PAPER)
    x = 0
    for picture in pictures:
        row.paste(picture, (x, 0))
        x += picture.width + gap
    return row


def stacked(pictures: Sequence[Image.Image], *, gap: int = GAP) -> Image.Image:
    """Pictures one below the other, left sides aligned."""
    height = sum(picture.height for picture in pictures) + gap * (len(pictures) - 1)
    column = Image.new("RGB", (max(picture.width for picture in pictures), height), PAPER)
    y = 0
    for picture in pictures:
        column.paste(picture, (0, y))
        y += picture.height + gap
    return column


def sheet(cards: Sequence[Image.Image], *, columns: int, title: str, legend: Image.Image | None = None) -> Image.Image:
    """Cards of equal width in rows of ``columns``, below a title and a legend.

    Raises ``ValueError`` if there is no card.
    """
    if not cards:
        raise ValueError("a sheet needs at least one view or texture")
    rows = [beside(cards[start : start + columns], gap=3 * GAP) for start in range(0, len(cards), columns)]
    body = stacked(rows if legend is None else [legend, *rows], gap=2 * GAP)
    title = shortened(title, max(body.width, LONGEST_TITLE), size=TITLE)
    width, top = max(body.width, text_width(title, size=TITLE)), MARGIN + TITLE + 2 * GAP
    paper = Image.new("RGB", (width + 2 * MARGIN, top + body.height + MARGIN), PAPER)
    ImageDraw.Draw(paper).text((MARGIN, MARGIN), title, font=_font(TITLE), fill=INK)
    paper.paste(body, (MARGIN, top))
    return paper
