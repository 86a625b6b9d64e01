"""Heat maps: saliency painted over a picture, and its legend."""

from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image

from trompe_server.pictures.layout import CAPTION, GAP, PAPER, Images, beside, line, stacked, swatch

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
"""Purple, red, orange, pale yellow in even steps of lightness: equal differences look equal, also if colour-blind."""
DIMMED: Final = 0.6
TICKS: Final = (0.0, 0.05, 0.2, 0.5, 1.0)
BAR: Final = (320, 20)
GREY: Final = 150


def heat_colours(values: Float[np.ndarray, "*shape"]) -> NDArray[np.float32]:
    """Colours (*shape, 3) in [0, 255] of values in [0, 1]; higher values are lighter."""
    position = np.clip(values, 0, 1) * (len(HEAT) - 1)
    return np.stack([np.interp(position, np.arange(len(HEAT)), channel) for channel in HEAT.T], axis=-1).astype(
        np.float32
    )


def heat_over(image: Images, saliency: Float[np.ndarray, "H W"]) -> Images:
    """Saliency in [0, 1] over a dimmed image (H, W, 3); the opacity grows with the saliency.

    The heat is the square root of the saliency: most of a map is far below its maximum and would be invisible.
    """
    heat = np.sqrt(np.clip(saliency, 0, 1))
    opacity = np.minimum(1.5 * heat, 1)[..., None]
    mixed: Images = (image * (1 - opacity) * DIMMED + heat_colours(heat) * opacity).round().astype(np.uint8)
    return mixed


def heat_legend(text: str, *, tau: float | None = None) -> Image.Image:
    """The legend: ``text``, the colour scale from 0 to 1 over grey, and the outline's ``tau``, if any."""
    ramp = np.linspace(0, 1, BAR[0]) ** 2
    bar = heat_over(np.full((BAR[1], BAR[0], 3), GREY, np.uint8), np.broadcast_to(ramp, BAR[::-1]))
    scale = stacked([Image.fromarray(bar), _ticks()], gap=2)
    parts = [line(text), scale]
    if tau is not None:
        parts += [swatch((GREY, GREY, GREY), outline=OUTLINE), line(f"outlined: {tau:g} or more")]
    return beside(parts, gap=2 * GAP)


def _ticks() -> Image.Image:
    """The values of the scale, below their colours."""
    picture = Image.new("RGB", (BAR[0], CAPTION + GAP), PAPER)
    for value in TICKS:
        word = line(f"{value:g}")
        x = round(value**0.5 * BAR[0] - word.width / 2)
        picture.paste(word, (min(max(x, 0), BAR[0] - word.width), 0))
    return picture
