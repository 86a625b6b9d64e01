"""How much each texel may change before people notice it, from the unpainted texture alone.

Two effects, at the scale that views show: texture hides a change and plain areas show it (contrast masking; Legge and
Foley, 1980), and middle greys show more of it than black and white (the lightness weighting S_L of CIEDE2000).
"""

import math
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from trompe_server.surrogate.shading import decode

LUMA: Final = (0.299, 0.587, 0.114)
"""Luminance of encoded RGB (ITU-R BT.601)."""
WINDOW: Final = 5
"""Side of the window of the local contrast, in pixels of a view."""
PLAIN: Final = 1.2
TEXTURED: Final = 2.0
"""Change that a plain area and a strong texture hide in black, as shares of epsilon, which limits both."""
STRONG: Final = 0.06
"""Standard deviation of luminance, in [0, 1], from which a texture counts as strong."""


def perceptual_bounds(
    texture: Float[Tensor, "H W 3"], size: tuple[int, ...], *, footprint: float, epsilon: float
) -> Float[Tensor, "h w 1"]:
    """Largest change of each texel's channels: at most ``epsilon``, at least one 8-bit level, in whole levels.

    texture: sRGB in [0, 1]. size: (h, w) of the table: that of the texture, or of its blocks of texels. footprint:
    number of texels that a pixel reads.
    """
    halvings = round(math.log(footprint, 4))
    seen = [max(1, side >> halvings) for side in texture.shape[:2]]
    luma = texture @ texture.new_tensor(LUMA)
    shown = F.interpolate(luma[None, None], seen, mode="area")
    share = (_masking(shown) * _tolerance(shown, epsilon)).clamp(max=1)
    share = F.interpolate(share, list(size), mode="bilinear")[0, 0, ..., None]
    return (share * epsilon * 255 + 1e-4).floor().clamp(min=1) / 255


def _masking(luma: Float[Tensor, "1 1 h w"]) -> Float[Tensor, "1 1 h w"]:
    """What the local contrast hides, from ``PLAIN`` to ``TEXTURED``."""
    margin = WINDOW // 2
    padded = F.pad(luma, [margin] * 4, mode="replicate")
    mean, square = (F.avg_pool2d(each, WINDOW, 1) for each in (padded, padded.square()))
    contrast = (square - mean.square()).clamp(min=0).sqrt()
    return PLAIN + (TEXTURED - PLAIN) * (contrast / STRONG).clamp(max=1)


def _tolerance(luma: Float[Tensor, "1 1 h w"], step: float) -> Float[Tensor, "1 1 h w"]:
    """Factor by the lightness: 1 for black, less where CIEDE2000 is more sensitive."""
    black = _sensitivity(luma.new_zeros(1), step)
    return (black / _sensitivity(luma, step)).clamp(max=1)


def _sensitivity(luma: Tensor, step: float) -> Tensor:
    """CIEDE2000 of a change of encoded greys by ``step``, per unit of the change."""
    low, high = (luma - step / 2).clamp(min=0), (luma + step / 2).clamp(max=1)
    dark, bright = _lightness(decode(low)), _lightness(decode(high))
    from_grey = ((dark + bright) / 2 - 50).square()
    weight = 1 + 0.015 * from_grey / (20 + from_grey).sqrt()
    return (bright - dark) / (high - low) / weight


def _lightness(light: Tensor) -> Tensor:
    """CIE L* of linear light."""
    return torch.where(light > 0.008856, 116 * light.clamp(min=1e-9) ** (1 / 3) - 16, 903.3 * light)
