"""Texture images: resizing, tinting, conversion of maps.

Colours are sRGB-encoded uint8 in images and linear in [0, 1] as factors.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trompe_shared.object3d import resized

Pixels = NDArray[np.uint8]

_LEVELS: Final = np.arange(256) / 255
_LINEAR: Final = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4)


def linear_rgb(encoded: Pixels) -> NDArray[np.float64]:
    """Decode sRGB uint8 to linear float64 in [0, 1]; any shape."""
    return _LINEAR[encoded]


def encode_srgb(linear: ArrayLike) -> Pixels:
    """Encode linear values, clipped to [0, 1], as sRGB uint8; any shape."""
    values = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    encoded = np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * encoded), np.uint8)


def shrink(pixels: Pixels, side: int) -> Pixels:
    """The image with its longer side at most ``side``."""
    height, width = pixels.shape[:2]
    if max(height, width) <= side:
        return pixels
    size = max(1, round(width * side / max(height, width))), max(1, round(height * side / max(height, width)))
    return resized(pixels, size)


def tinted(rgb: Pixels, factor: Sequence[float]) -> Pixels:
    """``rgb`` multiplied by a linear ``factor``."""
    if all(value == 1.0 for value in factor):
        return rgb
    return np.stack([encode_srgb(_LINEAR * factor[k])[rgb[..., k]] for k in range(3)], axis=-1)


def cutout_alpha(alpha: Pixels, *, factor: float, cutoff: float) -> Pixels:
    """Scale alpha so that ``cutoff`` becomes one half, the threshold of SAILenv's renderers.

    Scaling, not thresholding, keeps the filtering of the edge.
    """
    if cutoff == 0:
        return np.full_like(alpha, 255)
    scale = factor * 0.5 / max(cutoff, 1e-3)
    table = np.asarray(np.rint(np.minimum(np.arange(256) * scale, 255)), np.uint8)
    return table[alpha]


def metallic_smoothness(pixels: Pixels, *, metallic: float, roughness: float) -> Pixels:
    """Unity's map (H, W, 4), red metallic and alpha smoothness, from glTF's: green roughness, blue metallic."""
    metal = np.rint(pixels[..., 2] * metallic).astype(np.uint8)
    smooth = 255 - np.rint(pixels[..., 1] * roughness).astype(np.uint8)
    return np.stack([metal, metal, metal, smooth], axis=-1)


def scaled_normals(pixels: Pixels, scale: float) -> Pixels:
    """A normal map whose slopes are ``scale`` times those of ``pixels``."""
    if scale == 1.0:
        return pixels
    vectors = pixels.astype(np.float32) / 127.5 - 1
    vectors[..., :2] *= scale
    lengths = np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-6)
    return np.asarray(np.rint((vectors / lengths + 1) * 127.5), np.uint8)
