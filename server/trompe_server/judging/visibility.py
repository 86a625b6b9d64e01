"""Visibility of a repaint in the textures and in images of the object."""

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np
from jaxtyping import UInt8

from trompe_server.judging.metrics import max_view_change, mean_texel_change, share_beyond, texels_altered
from trompe_server.judging.perceptual import Images, object_pixels, perceived_change, total_variation
from trompe_shared.api import Visibility

Textures = Mapping[str, UInt8[np.ndarray, "H W 3"]]


def visibility_of(
    textures_before: Textures,
    textures_after: Textures,
    before: Images,
    after: Images,
    behind: UInt8[np.ndarray, "..."],
    *,
    epsilon: float | None = None,
) -> Visibility:
    """Compare textures of the same names and sizes, and images of the same views in front of ``behind``.

    Without textures their figures are null; so are those of the paper's constraint on views without ``epsilon``.
    """
    pixels = object_pixels(before, after, behind)
    pixels_beyond, views_beyond = (
        (None, None) if epsilon is None else share_beyond(before, after, pixels, epsilon=epsilon)
    )
    seen = perceived_change(before, after, pixels)
    return Visibility(
        max_view_change=max_view_change(before, after),
        pixels_beyond_epsilon=pixels_beyond,
        views_beyond_epsilon=views_beyond,
        **({} if seen is None else asdict(seen)),
        **(_texture_change(textures_before, textures_after) if textures_before else {}),
    )


def _texture_change(before: Textures, after: Textures) -> dict[str, float]:
    return {
        "texels_altered": texels_altered(before, after),
        "mean_texel_change": mean_texel_change(before, after),
        "texture_variation": total_variation(before, after),
    }
