"""How much of a repaint a person could see: structural similarity, colour difference and roughness.

There is no printability score: it needs the gamut of a printer, and these objects are shown, not printed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray

__all__ = [
    "PerceivedChange",
    "ciede2000",
    "lab",
    "object_pixels",
    "perceived_change",
    "ssim_map",
    "total_variation",
]

Images = UInt8[np.ndarray, "views H W 3"]
Pixels = Bool[np.ndarray, "views H W"]

LUMA: Final = np.array([0.299, 0.587, 0.114], np.float32)
"""Luminance of encoded RGB (ITU-R BT.601), on which Wang et al. measure."""
RADIUS: Final = 5
SIGMA: Final = 1.5
C1: Final = 0.01**2
C2: Final = 0.03**2
"""The constants of Wang et al. (2004) for values in [0, 1]."""

XYZ_OF_RGB: Final = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
"""Linear sRGB to CIE XYZ (IEC 61966-2-1, white D65)."""
WHITE: Final = XYZ_OF_RGB.sum(axis=1)


@dataclass(frozen=True)
class PerceivedChange:
    """What a repaint looks like in images of the object, over its pixels alone.

    ssim: mean structural similarity of luminance, 1 is equal; ``ssim_worst`` is the mean of the worst view.
    delta_e: mean CIEDE2000 colour difference (1 is about what a trained eye just notices, side by side); ``delta_e_95``
    is what 95 % of the pixels stay below.
    """

    ssim: float
    ssim_worst: float
    delta_e: float
    delta_e_95: float


def perceived_change(before: Images, after: Images, pixels: Pixels) -> PerceivedChange | None:
    """Compare the same views before and after over ``pixels``; ``None`` where these are none at all."""
    seen = [views for views in zip(before, after, pixels, strict=True) if views[2].any()]
    if not seen:
        return None
    similar = [_similarity(old, new, mask) for old, new, mask in seen]
    difference = np.concatenate([_colour_difference(old[mask], new[mask]) for old, new, mask in seen])
    return PerceivedChange(
        ssim=float(np.concatenate(similar).mean(dtype=np.float64)),
        ssim_worst=min(float(view.mean(dtype=np.float64)) for view in similar),
        delta_e=float(difference.mean()),
        delta_e_95=float(np.percentile(difference, 95)),
    )


def object_pixels(before: Images, after: Images, behind: UInt8[np.ndarray, "..."]) -> Pixels:
    """The pixels that show the object: those that differ from what is ``behind`` it, before or after.

    ``behind`` is broadcast to (views, H, W, 3): a picture, or a colour (views, 1, 1, 3) for each view.
    """
    shown: Pixels = ((before != behind) | (after != behind)).any(axis=-1)
    return shown


def _similarity(
    before: UInt8[np.ndarray, "H W 3"], after: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]
) -> NDArray[np.float32]:
    """Structural similarity (pixels,) of the pixels of ``mask``, from a cut-out that holds all of their windows."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    cut = tuple(slice(max(0, found[0] - RADIUS), found[-1] + RADIUS + 1) for found in (rows, columns))
    old, new = (image[cut] @ LUMA / np.float32(255) for image in (before, after))
    similarity: NDArray[np.float32] = ssim_map(old, new)[mask[cut]]
    return similarity


def ssim_map(a: Float[np.ndarray, "H W"], b: Float[np.ndarray, "H W"]) -> NDArray[np.float32]:
    """Structural similarity (H, W) of two images of one channel in [0, 1], as Wang et al. (2004) define it.

    Windows are Gaussian, 11 x 11, deviation 1.5 pixels; beyond its border an image goes on as its mirror image.
    """
    maps = np.stack([a, b, a * a, b * b, a * b]).astype(np.float32)
    mean_a, mean_b, square_a, square_b, product = _blurred(_blurred(maps, axis=1), axis=2)
    both, variances = mean_a * mean_b, (square_a - mean_a**2) + (square_b - mean_b**2)
    similarity: NDArray[np.float32] = ((2 * both + C1) * (2 * (product - both) + C2)) / (
        (mean_a**2 + mean_b**2 + C1) * (variances + C2)
    )
    return similarity


def _blurred(maps: Float[np.ndarray, "maps H W"], *, axis: int) -> NDArray[np.float32]:
    """The maps under the window along one axis. Shifted sums: a matrix product would wake all of BLAS's threads."""
    length = maps.shape[axis]
    reads = np.pad(np.arange(length), RADIUS, mode="symmetric")
    padded = np.take(maps, reads, axis=axis)
    window = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
    weights = (window / window.sum()).astype(np.float32)
    rows = [padded[(slice(None),) * axis + (slice(shift, shift + length),)] for shift in range(2 * RADIUS + 1)]
    blurred: NDArray[np.float32] = sum((w * row for w, row in zip(weights, rows, strict=True)), start=0 * maps)
    return blurred


def _colour_difference(before: UInt8[np.ndarray, "n 3"], after: UInt8[np.ndarray, "n 3"]) -> NDArray[np.float64]:
    """CIEDE2000 (n,) of sRGB colours; what did not change costs nothing."""
    difference = np.zeros(len(before))
    changed = (before != after).any(axis=1)
    old, new = (lab(colours[changed]).astype(np.float32) for colours in (before, after))
    difference[changed] = ciede2000(old, new)
    return difference


def lab(colours: UInt8[np.ndarray, "*shape 3"]) -> NDArray[np.float64]:
    """CIE L*a*b* (*shape, 3) of sRGB colours under D65."""
    encoded = np.arange(256) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    ratio = linear[colours] @ XYZ_OF_RGB.T / WHITE
    x, y, z = np.moveaxis(np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio * (29 / 6) ** 2 / 3 + 4 / 29), -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def ciede2000(first: Float[np.ndarray, "*shape 3"], second: Float[np.ndarray, "*shape 3"]) -> NDArray[np.float64]:
    """CIEDE2000 colour difference (*shape) of L*a*b* colours, as Sharma, Wu and Dalal (2005) spell it out."""
    (l1, c1, h1), (l2, c2, h2) = _lightness_chroma_hue(first, second)
    turn = np.where(c1 * c2 == 0, 0.0, (h2 - h1 + 180) % 360 - 180)
    turn = np.where((turn == -180) & (h2 > h1), 180.0, turn)
    mean_hue = np.where(c1 * c2 == 0, h1 + h2, h1 + turn / 2)
    lightness, chroma = (l1 + l2) / 2 - 50, (c1 + c2) / 2
    s_l = 1 + 0.015 * lightness**2 / np.sqrt(20 + lightness**2)
    s_h = 1 + 0.015 * chroma * _hue_weight(mean_hue)
    d_l, d_c = (l2 - l1) / s_l, (c2 - c1) / (1 + 0.045 * chroma)
    d_h = 2 * np.sqrt(c1 * c2) * _sin(turn / 2) / s_h
    blue = 30 * np.exp(-((((mean_hue % 360) - 275) / 25) ** 2))
    rotation = -_sin(2 * blue) * 2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7))
    difference: NDArray[np.float64] = np.sqrt(np.maximum(d_l**2 + d_c**2 + d_h**2 + rotation * d_c * d_h, 0))
    return difference


_Lch = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def _lightness_chroma_hue(
    first: Float[np.ndarray, "*shape 3"], second: Float[np.ndarray, "*shape 3"]
) -> tuple[_Lch, _Lch]:
    """L', C' and h' (degrees, 0..360) of both: a* is stretched where the two are nearly grey."""
    mean = (np.hypot(first[..., 1], first[..., 2]) + np.hypot(second[..., 1], second[..., 2])) / 2
    stretch = 1 + 0.5 * (1 - np.sqrt(mean**7 / (mean**7 + 25.0**7)))

    def polar(colour: Float[np.ndarray, "*shape 3"]) -> _Lch:
        a, b = colour[..., 1] * stretch, colour[..., 2]
        return colour[..., 0], np.hypot(a, b), np.degrees(np.arctan2(b, a)) % 360

    return polar(first), polar(second)


def _hue_weight(hue: NDArray[np.float64]) -> NDArray[np.float64]:
    """The formula's T of a mean hue in degrees."""
    return 1 - 0.17 * _cos(hue - 30) + 0.24 * _cos(2 * hue) + 0.32 * _cos(3 * hue + 6) - 0.20 * _cos(4 * hue - 63)


def _cos(degrees: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.cos(np.radians(degrees)))


def _sin(degrees: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sin(np.radians(degrees)))


def total_variation(
    before: Mapping[str, UInt8[np.ndarray, "H W 3"]], after: Mapping[str, UInt8[np.ndarray, "H W 3"]]
) -> float:
    """Roughness of the change of textures: mean |difference| of it between neighbours in a row or column.

    In [0, 1] units, over all channels and those pairs of which at least one texel was altered; 0.0 when none was. Noise
    of +-epsilon gives epsilon, a checkerboard of it 2 epsilon, an even tint next to nothing.
    """
    steps = [step for name in sorted(before) for step in _steps(before[name], after[name])]
    count = sum(len(step) for step in steps)
    return float(sum(int(step.sum()) for step in steps) / (3 * 255 * count)) if count else 0.0


def _steps(before: UInt8[np.ndarray, "H W 3"], after: UInt8[np.ndarray, "H W 3"]) -> list[NDArray[np.int16]]:
    """|difference of the change| (pairs, 3) along each axis."""
    change = after.astype(np.int16) - before
    altered = change.any(axis=2)
    down, right = altered[1:] | altered[:-1], altered[:, 1:] | altered[:, :-1]
    return [np.abs(np.diff(change, axis=0)[down]), np.abs(np.diff(change, axis=1)[right])]
