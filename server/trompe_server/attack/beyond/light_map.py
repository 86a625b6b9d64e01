"""A picture of how much a light fools, over where it may stand."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from trompe_server.attack.beyond.light import FoundLight, LightPlace
from trompe_server.reports.layout import INK, MARGIN, PAPER, captioned

__all__ = ["light_map"]

LOW: Final = (27, 60, 120)
MIDDLE: Final = (236, 236, 226)
HIGH: Final = (213, 94, 0)
"""Colours of the least, the middle and the most."""


def light_map(found: FoundLight, *, radius: int = 200) -> NDArray[np.uint8]:
    """The object's sky seen from above, (H, W, 3), with two lines that explain it.

    The zenith is in the middle, the horizon at the rim, azimuth 0 (where the grid's light stands) below. Every light
    tried is a dot, the redder the more it fools (``LightTrial.won``); the best one is ringed.
    """
    side = 2 * (radius + MARGIN)
    picture = Image.new("RGB", (side, side), PAPER)
    draw = ImageDraw.Draw(picture)
    for elevation in (0, 30, 60):
        _disc(draw, (side / 2, side / 2), radius * (90 - elevation) / 90, outline=INK)
    won = np.array([trial.won for trial in found.trials])
    shares = (won - won.min()) / max(float(np.ptp(won)), 1e-9)
    for number in np.argsort(shares, kind="stable"):
        _disc(draw, _point(found.trials[number].place, radius, side), 7, fill=_colour(float(shares[number])))
    _disc(draw, _point(found.place, radius, side), 11, outline=INK)
    best = found.trials[int(won.argmax())]
    colours = f"from above, front below; chance of fooling: blue {won.min():.2f}, red {won.max():.2f}"
    words = f"best: azimuth {found.place.azimuth:.0f}, elevation {found.place.elevation:.0f}"
    fooled = f"it fooled {best.fooled:.0%} of {len(found.asked)} views"
    return np.asarray(captioned(captioned(picture, colours), f"{words}; {fooled}"))


def _point(place: LightPlace, radius: int, side: int) -> tuple[float, float]:
    """Where a light's dot lies, pixels."""
    reach, azimuth = radius * (90 - abs(place.elevation)) / 90, math.radians(place.azimuth)
    return side / 2 + reach * math.sin(azimuth), side / 2 + reach * math.cos(azimuth)


def _disc(
    draw: ImageDraw.ImageDraw,
    centre: tuple[float, float],
    radius: float,
    *,
    fill: tuple[int, int, int] | None = None,
    outline: tuple[int, int, int] | None = None,
) -> None:
    (x, y) = centre
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=fill, outline=outline, width=2)


def _colour(share: float) -> tuple[int, int, int]:
    """Between LOW (0), MIDDLE and HIGH (1)."""
    mixed = [np.interp(share, (0, 0.5, 1), ends) for ends in zip(LOW, MIDDLE, HIGH, strict=True)]
    return round(mixed[0]), round(mixed[1]), round(mixed[2])
