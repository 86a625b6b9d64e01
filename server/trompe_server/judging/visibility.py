"""Visibility of a repaint: structural similarity, colour difference and roughness; and the limit of transparency.

There is no printability score: it needs the gamut of a printer, and these objects are shown, not printed.
"""

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np
from jaxtyping import Bool, UInt8
from numpy.typing import NDArray
from skimage.color import deltaE_ciede2000, rgb2lab
from skimage.metrics import structural_similarity

from trompe_server.judging.metrics import max_view_change, mean_texel_change, share_beyond, texels_altered
from trompe_server.system.threads import in_threads
from trompe_shared.api import Visibility
from trompe_shared.object3d import Object3D
from trompe_shared.opacity import strongest
from trompe_shared.wavefront import area

FAINT: Final = 0.25
"""Opacity below which the paint on a material is hardly seen: a quarter of its change reaches the image."""

FEW_TEXELS: Final = 32
"""Texels under all triangles below which paint is a handful of colours, as of models that share a palette."""

Textures = Mapping[str, UInt8[np.ndarray, "H W 3"]]
Images = UInt8[np.ndarray, "views H W 3"]
Pixels = Bool[np.ndarray, "views H W"]

LUMA: Final = np.array([0.299, 0.587, 0.114], np.float32)
"""Luminance of encoded RGB (ITU-R BT.601), as in Wang et al. (2004)."""
SIGMA: Final = 1.5
RADIUS: Final = 5
"""Deviation and radius of the Gaussian window of Wang et al., in pixels."""


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


def paint_warnings(obj: Object3D) -> Iterator[str]:
    """Warnings of too few texels to paint, and of materials that are nearly transparent wherever they are strongest."""
    texels = sum(area(part.uvs, part.faces) * obj.textures[obj.albedo_of(part)][..., 0].size for part in obj.parts)
    if texels < FEW_TEXELS:
        yield (
            f"The triangles cover {texels:.1f} texels of the textures, so paint is a few flat colours. Unwrap the "
            "object in a modelling program; one without texture coordinates is unwrapped here."
        )
    for name, opacity in strongest(obj).items():
        if opacity < FAINT:
            yield f"The material {name!r} is nearly transparent (opacity {opacity:.2f}): paint on it changes little."


def perceived_change(before: Images, after: Images, pixels: Pixels) -> dict[str, float]:
    """``ssim``, ``ssim_worst``, ``delta_e`` and ``delta_e_95`` of the same views before and after, as in
    ``Visibility``, over the object's ``pixels``; nothing if there are none.

    A trained eye just notices a ``delta_e`` of about 1, side by side.
    """
    shown = [view for view in zip(before, after, pixels, strict=True) if view[2].any()]
    if not shown:
        return {}
    similarity = in_threads(_similarity, *zip(*shown, strict=True))
    difference = np.concatenate(in_threads(_colour_difference, *zip(*shown, strict=True)))
    return {
        "ssim": float(np.concatenate(similarity).mean(dtype=np.float64)),
        "ssim_worst": min(float(view.mean(dtype=np.float64)) for view in similarity),
        "delta_e": float(difference.mean()),
        "delta_e_95": float(np.percentile(difference, 95)),
    }


def object_pixels(before: Images, after: Images, behind: UInt8[np.ndarray, "..."]) -> Pixels:
    """Mask of the pixels that show the object: different from ``behind`` before or after.

    behind: background, broadcast to (views, H, W, 3): a picture, or a colour (views, 1, 1, 3) for each view.
    """
    shown: Pixels = ((before != behind) | (after != behind)).any(axis=-1)
    return shown


def _similarity(
    before: UInt8[np.ndarray, "H W 3"], after: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]
) -> NDArray[np.float32]:
    """Structural similarity (pixels,) over ``mask``, computed on its bounding box plus one window radius."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    box = tuple(slice(max(0, found[0] - RADIUS), found[-1] + RADIUS + 1) for found in (rows, columns))
    margin = 0 if min(mask[box].shape) > 2 * RADIUS else 2 * RADIUS  # scikit-image refuses less than one window
    old, new = (np.pad(image[box] @ LUMA / np.float32(255), margin, mode="symmetric") for image in (before, after))
    _, similarity = structural_similarity(
        old, new, data_range=1.0, gaussian_weights=True, sigma=SIGMA, use_sample_covariance=False, full=True
    )
    inside: NDArray[np.float32] = similarity[np.pad(mask[box], margin)]
    return inside


def _colour_difference(
    before: UInt8[np.ndarray, "H W 3"], after: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]
) -> NDArray[np.float64]:
    """CIEDE2000 (pixels,) of sRGB colours over ``mask``; equal colours are skipped."""
    old, new = before[mask], after[mask]
    difference = np.zeros(len(old))
    changed = (old != new).any(axis=1)
    difference[changed] = deltaE_ciede2000(rgb2lab(old[changed]), rgb2lab(new[changed]))
    return difference


def total_variation(before: Textures, after: Textures) -> float:
    """Roughness of a texture change: mean absolute difference of the change between neighbouring texels, in [0, 1].

    Averages over channels and over pairs in a row or column with at least one altered texel; 0.0 if none is altered.
    Noise of +-epsilon gives epsilon, a checkerboard 2 epsilon, an even tint almost 0.
    """
    steps = [step for name in sorted(before) for step in _steps(before[name], after[name])]
    count = sum(len(step) for step in steps)
    return float(sum(int(step.sum()) for step in steps) / (3 * 255 * count)) if count else 0.0


def _steps(before: UInt8[np.ndarray, "H W 3"], after: UInt8[np.ndarray, "H W 3"]) -> list[NDArray[np.int16]]:
    """Absolute differences of the change (pairs, 3) along each axis."""
    change = after.astype(np.int16) - before
    altered = change.any(axis=2)
    down, right = altered[1:] | altered[:-1], altered[:, 1:] | altered[:, :-1]
    return [np.abs(np.diff(change, axis=0)[down]), np.abs(np.diff(change, axis=1)[right])]
