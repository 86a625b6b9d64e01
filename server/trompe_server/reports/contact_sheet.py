"""The contact sheet: what the classifier said of the target's images before and after, view by view."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from PIL import Image

from trompe_server.reports.layout import CAPTION, GREEN, RED, Images, beside, captioned, framed, sheet, shortened, tile

__all__ = ["FRAME", "TILE", "Verdict", "contact_sheet", "representative"]

TILE: Final = 168
"""Width of an image on the sheet, without its frame."""
FRAME: Final = 4
CONFIDENCE: Final = 44
"""Room for `` 100%``."""


@dataclass(frozen=True)
class Verdict:
    """What the classifier said of one image: class name, probability in [0, 1], whether it is the object's class."""

    label: str
    confidence: float
    correct: bool


def representative(n: int, k: int) -> list[int]:
    """At most ``k`` of the indices 0..n-1, spread evenly from the first to the last."""
    if k >= n:
        return list(range(n))
    return [round(i * (n - 1) / max(k - 1, 1)) for i in range(k)]


def contact_sheet(
    before: Images,
    after: Images,
    verdicts_before: Sequence[Verdict],
    verdicts_after: Sequence[Verdict],
    *,
    title: str,
    columns: int = 3,
) -> Image.Image:
    """Images (N, H, W, 3) of the same views in pairs, framed green where the class is the object's and red where not.

    Raises ``ValueError`` when the four do not have the same length.
    """
    pairs = zip(before, after, verdicts_before, verdicts_after, strict=True)
    cards = [beside([_judged(old, was), _judged(new, now)], gap=2) for old, new, was, now in pairs]
    return sheet(cards, columns=columns, title=f"{title} - left before, right after")


def _judged(image: Images, verdict: Verdict) -> Image.Image:
    """One image with its frame, under it the confidence and the first of the class's names, cut where it is long."""
    colour = GREEN if verdict.correct else RED
    picture = framed(tile(image, TILE), colour, thickness=FRAME)
    name = shortened(verdict.label.split(",")[0], TILE - CONFIDENCE, size=CAPTION)
    return captioned(picture, f"{name} {verdict.confidence:.0%}", colour=colour)
