"""Images and textures before and after the attack, with their amplified difference."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from PIL import Image

from trompe_server.pictures.contact_sheet import representative
from trompe_server.pictures.layout import Images, captioned, framed, sheet

AMPLIFIED: Final = 10
"""Factor by which differences are amplified."""
TILE: Final = 224
VIEWS: Final = 4
"""Most rows of a strip."""


def amplified_difference(before: Images, after: Images) -> Images:
    """|after - before| of uint8 arrays times ``AMPLIFIED``, clipped at 255."""
    change = np.abs(after.astype(np.int16) - before.astype(np.int16)) * AMPLIFIED
    amplified: Images = np.minimum(change, 255).astype(np.uint8)
    return amplified


def difference_strip(before: Images, after: Images, *, title: str) -> Image.Image:
    """One row for each of a few representative views of images (N, H, W, 3): before, after, difference."""
    cards = [_triple(before[k], after[k]) for k in representative(len(before), VIEWS)]
    return sheet(cards, columns=1, title=title)


def texture_sheet(before: Mapping[str, Images], after: Mapping[str, Images], *, title: str) -> Image.Image:
    """One row for each albedo texture (H, W, 3), sorted by name: before, after, difference."""
    cards = [captioned(_triple(before[name], after[name]), name) for name in sorted(before)]
    return sheet(cards, columns=1, title=title)


def _triple(before: Images, after: Images) -> Image.Image:
    change = amplified_difference(before, after)
    return framed({"before": before, "after": after, f"|difference| x{AMPLIFIED}": change}, TILE)
