"""The saliency sheet: sensitivity of the classifier's loss, painted on the target's images."""

from typing import Final

import numpy as np
from jaxtyping import Float
from PIL import Image
from scipy.ndimage import binary_erosion

from trompe_server.pictures.heat import OUTLINE, heat_legend, heat_over
from trompe_server.pictures.layout import Images, captioned, sheet, tile

TILE: Final = 336


def saliency_sheet(
    images: Images, saliency: Float[np.ndarray, "n H W"], *, tau: float | None, title: str, columns: int = 3
) -> Image.Image:
    """Target images (N, H, W, 3) with their saliency in [0, 1] as heat; pixels at or above ``tau`` are outlined."""
    cards = [_card(image, heat, tau) for image, heat in zip(images, saliency, strict=True)]
    legend = heat_legend("saliency, 1 is the largest of all views", tau=tau)
    return sheet(cards, columns=columns, title=title, legend=legend)


def _card(image: Images, saliency: Float[np.ndarray, "H W"], tau: float | None) -> Image.Image:
    painted = tile(heat_over(image, saliency), TILE)
    if tau is None:
        return captioned(painted, f"largest {saliency.max():.2f}")
    mask = saliency >= tau
    large = np.array(Image.fromarray(mask).resize(painted.size, Image.Resampling.NEAREST))
    outlined = np.array(painted)
    outlined[large & ~binary_erosion(large)] = OUTLINE  # its pixels with a neighbour outside
    return captioned(Image.fromarray(outlined), f"{mask.mean():.1%} of pixels at or above {tau:g}")
