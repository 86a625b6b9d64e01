"""Visibility of a repaint in the textures and in images of the object, and the limit that transparency sets to it."""

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np
from jaxtyping import UInt8

from trompe_server.judging.metrics import max_view_change, mean_texel_change, share_beyond, texels_altered
from trompe_server.judging.perceptual import Images, object_pixels, perceived_change, total_variation
from trompe_shared.api import Visibility
from trompe_shared.object3d import Object3D
from trompe_shared.opacity import strongest

FAINT: Final = 0.25
"""Opacity below which the paint on a material is hardly seen: a quarter of its change reaches the image."""

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
    textures = textures_before, textures_after
    pixels = object_pixels(before, after, behind)
    pixels_beyond, views_beyond = (
        (None, None) if epsilon is None else share_beyond(before, after, pixels, epsilon=epsilon)
    )
    return Visibility(
        max_view_change=max_view_change(before, after),
        pixels_beyond_epsilon=pixels_beyond,
        views_beyond_epsilon=views_beyond,
        **perceived_change(before, after, pixels),
        texels_altered=texels_altered(*textures) if textures_before else None,
        mean_texel_change=mean_texel_change(*textures) if textures_before else None,
        texture_variation=total_variation(*textures) if textures_before else None,
    )


def faint_warnings(obj: Object3D) -> Iterator[str]:
    """A warning for each material that is nearly transparent wherever it is strongest."""
    for name, opacity in strongest(obj).items():
        if opacity < FAINT:
            yield f"The material {name!r} is nearly transparent (opacity {opacity:.2f}): paint on it changes little."
