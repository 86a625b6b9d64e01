"""The saliency sheet: where on the object the classifier's loss is most sensitive, painted on the target's images."""

from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from PIL import Image

from trompe_server.reports.layout import Images, captioned, sheet, tile

__all__ = ["heat_colours", "saliency_sheet"]

TILE: Final = 336
OUTLINE: Final = (0, 255, 255)
HEAT: Final = np.array(
    [
        (66, 10, 104),
        (120, 28, 109),
        (173, 48, 95),
        (217, 77, 61),
        (244, 120, 25),
        (251, 178, 29),
        (241, 235, 108),
        (252, 255, 164),
    ],
    np.float32,
)
"""Purple, red, orange, pale yellow: even steps of lightness, so that equal differences look equal."""


def heat_colours(values: Float[np.ndarray, "*shape"]) -> NDArray[np.float32]:
    """Colours (*shape, 3) in [0, 255] of values in [0, 1]; the higher, the lighter."""
    position = np.clip(values, 0, 1) * (len(HEAT) - 1)
    return np.stack([np.interp(position, np.arange(len(HEAT)), channel) for channel in HEAT.T], axis=-1).astype(
        np.float32
    )


def saliency_sheet(
    images: Images, saliency: Float[np.ndarray, "n H W"], *, tau: float | None, title: str, columns: int = 3
) -> Image.Image:
    """Target images (N, H, W, 3) with their saliency in [0, 1] as heat, and an outline of the pixels from ``tau`` up.

    The heat is the square root of the saliency: most of a map is far below its maximum and would not be seen.
    """
    cards = [_card(image, heat, tau) for image, heat in zip(images, saliency, strict=True)]
    return sheet(cards, columns=columns, title=title)


def _card(image: Images, saliency: Float[np.ndarray, "H W"], tau: float | None) -> Image.Image:
    painted = tile(_overlay(image, np.sqrt(np.clip(saliency, 0, 1))), TILE)
    if tau is None:
        return captioned(painted, f"largest {saliency.max():.2f}")
    mask = saliency >= tau
    large = np.array(Image.fromarray(mask).resize(painted.size, Image.Resampling.NEAREST))
    outlined = np.array(painted)
    outlined[_outline(large)] = OUTLINE
    return captioned(Image.fromarray(outlined), f"{mask.mean():.1%} of pixels at or above {tau:g}")


def _overlay(image: Images, heat: Float[np.ndarray, "H W"]) -> Images:
    """Heat over a dimmed print of the image: the hotter, the less of the image is seen."""
    opacity = np.minimum(1.5 * heat, 1)[..., None]
    mixed: Images = (image * (1 - opacity) * 0.6 + heat_colours(heat) * opacity).round().astype(np.uint8)
    return mixed


def _outline(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """The pixels of the mask that have a neighbour outside it."""
    padded = np.pad(mask, 1)
    inside = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    outline: NDArray[np.bool_] = mask & ~inside
    return outline
