"""Saliency as heat: sensitivity of the classifier's loss to the pixels of images, and to texels over all views."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_erosion

from trompe_server.pictures.layout import (
    CAPTION,
    GAP,
    PAPER,
    Images,
    beside,
    captioned,
    frame,
    framed,
    line,
    sheet,
    stacked,
    swatch,
    tile,
)

TILE: Final = 336
OBJECT_TILE: Final = 224
TOP: Final = 0.005
"""Share of the salient texels drawn in the lightest colour: a few extreme ones would darken all others."""

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

Textures = Mapping[str, Images]
Scores = Mapping[str, Float[np.ndarray, "H W"]]


def heat_colours(values: Float[np.ndarray, "*shape"]) -> NDArray[np.float32]:
    """Colours (*shape, 3) in [0, 255] of values in [0, 1]; higher values are lighter."""
    position = np.clip(values, 0, 1) * (len(HEAT) - 1)
    channels = [np.interp(position, np.arange(len(HEAT)), channel) for channel in HEAT.T]
    return np.stack(channels, axis=-1).astype(np.float32)


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


def saliency_sheet(
    images: Images, saliency: Float[np.ndarray, "n H W"], *, tau: float | None, title: str
) -> Image.Image:
    """Target images (N, H, W, 3) with their saliency in [0, 1] as heat; pixels at or above ``tau`` are outlined."""
    cards = [_card(image, heat, tau) for image, heat in zip(images, saliency, strict=True)]
    legend = heat_legend("saliency, 1 is the largest of all views", tau=tau)
    return sheet(cards, columns=3, title=title, legend=legend)


def _card(image: Images, saliency: Float[np.ndarray, "H W"], tau: float | None) -> Image.Image:
    painted = tile(heat_over(image, saliency), TILE)
    if tau is None:
        return captioned(painted, f"largest {saliency.max():.2f}", width=TILE)
    mask = saliency >= tau
    large = np.array(Image.fromarray(mask).resize(painted.size, Image.Resampling.NEAREST))
    outlined = np.array(painted)
    outlined[large & ~binary_erosion(large)] = OUTLINE  # its pixels with a neighbour outside
    return captioned(Image.fromarray(outlined), f"{mask.mean():.1%} of pixels at or above {tau:g}", width=TILE)


def heat_textures(textures: Textures, scores: Scores) -> dict[str, Images]:
    """Albedo textures (H, W, 3) with the scores of their texels as heat, to be put on the object.

    scores: saliency accumulated per texel, in any unit; all textures share one scale.
    """
    return {name: heat_over(textures[name], heat) for name, heat in _scaled(scores).items()}


def saliency_texture_sheet(textures: Textures, scores: Scores, *, title: str) -> Image.Image:
    """One row for each albedo texture, sorted by name: unchanged, and with the scores of its texels as heat."""
    painted = heat_textures(textures, scores)
    cards = [_row(name, textures[name], painted[name], scores) for name in sorted(textures)]
    legend = heat_legend(f"accumulated saliency of a texel, 1 is that of the top {TOP:.1%}")
    return sheet(cards, columns=1, title=title, legend=legend)


def _row(name: str, texture: Images, painted: Images, scores: Scores) -> Image.Image:
    texels = scores[name].size
    half = _texels_with_half(scores[name])
    facts = f"{name}: half of its saliency is on {half / texels:.1%} of its texels" if half else f"{name}: never seen"
    return captioned(beside([frame(texture, TILE), frame(painted, TILE)]), facts, width=2 * TILE + GAP)


def saliency_object_sheet(
    images: Images, saliency: Float[np.ndarray, "n H W"], rendered: Images, *, title: str
) -> Image.Image:
    """For each view: the target's image (N, H, W, 3), the saliency of the view over it, and the object in its heat.

    rendered: the target's images (N, H, W, 3) of the object painted with ``heat_textures``.
    """
    cards = [_triple(*view) for view in zip(images, saliency, rendered, strict=True)]
    legend = heat_legend(f"saliency, 1 is that of the top {TOP:.1%} of a view's pixels, or of the texels")
    return sheet(cards, columns=2, title=title, legend=legend)


def _triple(image: Images, saliency: Float[np.ndarray, "H W"], rendered: Images) -> Image.Image:
    hot = heat_over(image, _scaled({"view": saliency})["view"])
    pictures = {"as it is": image, "saliency of this view": hot, "accumulated on the object": rendered}
    return framed(pictures, OBJECT_TILE)


def _scaled(scores: Scores) -> dict[str, NDArray[np.float32]]:
    """Scores scaled to [0, 1]: the share ``TOP`` of the nonzero ones reaches 1."""
    everything = np.concatenate([score.ravel() for score in scores.values()])
    some = everything[everything > 0]
    top = float(np.quantile(some, 1 - TOP)) if len(some) else 1.0
    return {name: np.clip(score / top, 0, 1).astype(np.float32) for name, score in scores.items()}


def _texels_with_half(score: Float[np.ndarray, "H W"]) -> int:
    """Smallest number of texels with half of the sum; 0 for an empty map."""
    ranked = np.cumsum(np.sort(score.ravel().astype(np.float64))[::-1])
    return int(np.searchsorted(ranked, ranked[-1] / 2)) + 1 if ranked[-1] > 0 else 0
