"""The contact sheet: the target's images before and after with the classifier's predictions, view by view."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image, ImageOps

from trompe_server.pictures.layout import CAPTION, GREEN, RED, Images, beside, captioned, line, sheet, shortened, tile
from trompe_shared.geometry import Camera, spherical

VIEWS: Final = 12
"""Most views on a sheet."""
TILE: Final = 168
"""Width of an image on the sheet, without its frame."""
FRAME: Final = 4
CONFIDENCE: Final = 44
"""Width kept free for the confidence, `` 100%`` at most."""


@dataclass(frozen=True)
class Verdict:
    """Prediction for one image: class name, probability in [0, 1], whether it is the object's class."""

    label: str
    confidence: float
    correct: bool


def representative(n: int, k: int) -> list[int]:
    """At most ``k`` of the indices 0..n-1, evenly spaced from the first to the last."""
    if k >= n:
        return list(range(n))
    return [round(i * (n - 1) / max(k - 1, 1)) for i in range(k)]


def extremes(hardness: Float[np.ndarray, " n"], directions: Float[np.ndarray, "n 3"], k: int) -> list[int]:
    """At most ``k`` indices, the hardest first: half from the hardest third, half from the easiest.

    Each half begins with the most extreme one and is spread over the ``directions`` (unit vectors).
    """
    order = np.argsort(-hardness, kind="stable")
    if len(order) <= k:
        return [int(index) for index in order]
    third = max(-(-k // 2), len(order) // 3)
    hard, easy = _spread(order[:third], directions, k - k // 2), _spread(order[::-1][:third], directions, k // 2)
    return [int(index) for index in order if index in {*hard, *easy}]


def _spread(ranked: NDArray[np.int64], directions: Float[np.ndarray, "n 3"], k: int) -> list[int]:
    """The first of ``ranked``, then each time the one farthest from those chosen."""
    nearness = np.full(len(ranked), -np.inf)
    chosen: list[int] = []
    for _ in range(k):
        best = int(nearness.argmin())
        chosen.append(int(ranked[best]))
        nearness = np.maximum(nearness, directions[ranked] @ directions[ranked[best]])
        nearness[best] = np.inf
    return chosen


def views_sheet(
    images: tuple[Images, Images],
    verdicts: tuple[Sequence[Verdict], Sequence[Verdict]],
    cameras: Sequence[Camera],
    *,
    title: str,
    distinct: Sequence[int] | None = None,
) -> Image.Image:
    """The contact sheet of views recognised before, the hardest to fool and the easiest, else of representative ones.

    images (N, H, W, 3), verdicts: of all views, before and after. distinct: indices of the distinct views, by default
    all.
    """
    (before, after), (old, new) = images, verdicts
    own = range(len(old)) if distinct is None else distinct
    recognised = [k for k in own if old[k].correct]
    confidences = np.array([new[k].confidence * (1 if new[k].correct else -1) for k in recognised])
    directions = np.array([spherical(cameras[k].azimuth, cameras[k].elevation) for k in recognised])
    extreme = [recognised[k] for k in extremes(confidences, directions, VIEWS)]
    shown = extreme or [own[k] for k in representative(len(own), VIEWS)]
    fooled, which = sum(not new[k].correct for k in recognised), "" if len(own) == len(old) else "distinct "
    facts = f"Recognised before in {len(recognised)} of {len(own)} {which}views; {fooled} of these are fooled."
    if recognised:
        some = "all" if len(shown) == len(recognised) else len(shown)
        facts += f" Below: {some} of the recognised ones, from the hardest to fool to the easiest."
    return contact_sheet([(before[k], after[k], old[k], new[k]) for k in shown], title=title, facts=facts)


def contact_sheet(views: Sequence[tuple[Images, Images, Verdict, Verdict]], *, title: str, facts: str) -> Image.Image:
    """Images (H, W, 3) of each view before and after, framed green if classified as the object and red if not.

    views: with the verdicts on both images. facts: a line below the title. Raises ``ValueError`` if there is no view.
    """
    cards = [beside([_judged(old, was), _judged(new, now)], gap=2) for old, new, was, now in views]
    return sheet(cards, columns=3, title=f"{title} - left before, right after", legend=line(facts))


def _judged(image: Images, verdict: Verdict) -> Image.Image:
    """One framed image; below it the first name of the class, shortened, and the confidence."""
    colour = GREEN if verdict.correct else RED
    picture = ImageOps.expand(tile(image, TILE), FRAME, colour)
    name = shortened(verdict.label.split(",")[0], TILE - CONFIDENCE, size=CAPTION)
    return captioned(picture, f"{name} {verdict.confidence:.0%}", colour=colour, width=TILE + 2 * FRAME)
