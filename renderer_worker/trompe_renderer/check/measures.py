"""Properties of a picture of one object before a plain background.

They hold for any tone curve, antialiasing, noise and highlight: where the object is, which of its channels are high,
and the medians of regions.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

FAINT: Final = 8.0
"""Smallest difference, in levels, between an object and its background."""

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Blob:
    """An object's pixels ``mask`` (H, W), and moments of its shape in pixels.

    centre: (right, down) from the picture's middle. spread: standard deviations (across, down). shear: their
    correlation.
    """

    mask: Mask
    centre: tuple[float, float]
    spread: tuple[float, float]
    shear: float


def border(picture: Picture) -> NDArray[np.float64]:
    """Median colour (3,) of the picture's outermost pixels."""
    frame = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
    return np.asarray(np.median(frame, axis=0))


def blob(picture: Picture) -> Blob | None:
    """The object, by its contrast with the border; ``None`` if there is none. Edges count by their share."""
    contrast = np.abs(picture - border(picture)).max(axis=-1)
    strongest = float(np.percentile(contrast, 98))
    mask = contrast > strongest / 2
    if strongest < FAINT or not mask.any():
        return None
    share = np.clip(contrast / np.median(contrast[mask]), 0, 1)
    rows, columns = np.nonzero(ndimage.binary_dilation(mask, iterations=2))
    at = np.stack([columns + 0.5 - mask.shape[1] / 2, rows + 0.5 - mask.shape[0] / 2])
    weights = share[rows, columns]
    middle, covariance = np.average(at, axis=1, weights=weights), np.cov(at, aweights=weights)
    across, down = np.sqrt(np.diag(covariance)) + 1e-9
    return Blob(mask, (middle[0], middle[1]), (across, down), float(covariance[0, 1] / (across * down)))


def median(picture: Picture, mask: Mask) -> NDArray[np.float64]:
    """Median colour (3,) of the pixels ``mask`` (H, W)."""
    return np.asarray(np.median(picture[mask], axis=0))


def level(picture: Picture, mask: Mask) -> float:
    """Median brightness of the pixels ``mask`` (H, W), 0 to 255."""
    return float(median(picture, mask).mean())


def patterns(colours: NDArray[np.float64] | Picture) -> NDArray[np.int64]:
    """Which channels of colours (..., 3) are above the middle of their own range: red 4, green 2, blue 1."""
    low, high = colours.min(axis=-1, keepdims=True), colours.max(axis=-1, keepdims=True)
    return np.asarray(((2.0 * colours > low.astype(float) + high) * np.array([4, 2, 1])).sum(axis=-1))


def positions(picture: Picture, mask: Mask) -> dict[int, tuple[float, float]]:
    """Middle (right, down), in pixels from the picture's, of each pattern that fills over 3 % of ``mask``."""
    kinds = np.where(mask, patterns(picture), 0)
    found = {}
    for kind in range(1, 7):
        rows, columns = np.nonzero(kinds == kind)
        if len(rows) > 0.03 * mask.sum():
            found[kind] = (columns.mean() + 0.5 - mask.shape[1] / 2, rows.mean() + 0.5 - mask.shape[0] / 2)
    return found
