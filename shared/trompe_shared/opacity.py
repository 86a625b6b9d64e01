"""Transparent textures: where an albedo's alpha channel cuts holes into a surface, or blends it over what lies behind.

Materials without an ``opacity`` are alpha-tested, as in Unity's Cutout mode: fragments with an alpha below one half are
not drawn. Blended ones are composited: alpha times their colour, the rest shows what lies behind. Alpha belongs to the
object's shape: an attack changes colours only.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_shared.object3d import Object3D, decode_alpha

CUTOFF: Final = 0.5
"""Fragments with less alpha (in [0, 1]) are not drawn."""

INVISIBLE: Final = 0.5 / 255
"""Alpha below which a blended fragment changes no 8-bit image."""


def opacity_of(data: bytes, *, blended: bool = False) -> NDArray[np.uint8] | None:
    """Alpha (H, W) uint8, row 0 on top, of an albedo image file; ``None`` if all of it is drawn in full.

    blended: alpha below 1 counts, not only below ``CUTOFF``. Raises ``ObjectError`` for an unreadable file.
    """
    alpha = decode_alpha(data, "albedo")
    return alpha if alpha is not None and alpha.min() < (255 if blended else CUTOFF * 255) else None


def strongest(obj: Object3D) -> dict[str, float]:
    """The largest opacity, in [0, 1], on each blended material of ``obj``, by name."""
    found = {}
    for name, material in obj.materials.items():
        if material.opacity is not None:
            alpha = decode_alpha(obj.files[material.albedo], material.albedo)
            found[name] = material.opacity * (1.0 if alpha is None else float(alpha.max()) / 255)
    return found
