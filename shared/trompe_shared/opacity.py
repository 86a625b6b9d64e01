"""Alpha-tested textures: what an albedo's alpha channel cuts out of the surfaces painted with it.

As in Unity's Cutout mode a fragment is not drawn where the alpha that it reads is below one half. The mask belongs to
the object's shape: an attack repaints colours and leaves it alone.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_shared.object3d import open_image

__all__ = ["CUTOFF", "opacity_of"]

CUTOFF: Final = 0.5
"""Fragments with less alpha (in [0, 1]) are not drawn."""


def opacity_of(data: bytes) -> NDArray[np.uint8] | None:
    """Alpha (H, W) uint8, row 0 on top, of an albedo image file; ``None`` where it cuts nothing out.

    Raises ``ObjectError`` for a file that cannot be read.
    """
    with open_image(data, "albedo") as image:
        if not image.has_transparency_data:
            return None
        alpha = np.array(image.convert("RGBA").getchannel("A"))
    return alpha if alpha.min() < CUTOFF * 255 else None
