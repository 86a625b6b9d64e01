"""Resampling as one matrix per axis of an image.

Placement, a change of size and blur are linear in the image and separable: rows and columns are filtered alone. A chain
of them is one product of matrices for each axis, drawn anew for each image.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

Axis = Float[Tensor, "n n"]
"""Matrix from the pixels along an axis to as many new ones; its rows sum to 1."""
KEPT: Final = 2**26
"""Bytes of the matrices kept for each of two sides: all that a job draws up to 300 pixels, an eighth for 600."""


def resampled(image: Float[Tensor, "*n H W"], rows: Axis, columns: Axis) -> Float[Tensor, "*n H W"]:
    """Images with their rows and columns resampled. Differentiable in the images."""
    return rows.to(image) @ image @ columns.to(image).mT


def placed(side: int, *, zoom: float = 1.0, shift: float = 0.0, mirrored: bool = False) -> Axis:
    """Magnify by ``zoom`` about the middle, move by ``shift`` of the side, mirror; antialiased bilinear.

    Pixels beyond the edge repeat the edge.
    """
    middle = (side - 1) / 2
    at = (torch.arange(side) - middle) / zoom
    at = ((-at if mirrored else at) + middle - shift * side).clamp(0, side - 1)
    weights = (1 - (at[:, None] - torch.arange(side)).abs() / max(1.0, 1 / zoom)).clamp(min=0)
    return weights / weights.sum(1, keepdim=True)


def resized(side: int, size: int) -> Axis:
    """Reduce to ``size`` pixels (antialiased bilinear) and enlarge again (bilinear)."""
    return _kept(side)(size)


@lru_cache(maxsize=2)
def _kept(side: int) -> Callable[[int], Axis]:
    return lru_cache(maxsize=KEPT // (4 * side**2))(partial(_resized, side))


def _resized(side: int, size: int) -> Axis:
    small = F.interpolate(torch.eye(side)[None, None], (size, side), mode="bilinear", antialias=True)
    return F.interpolate(small, (side, side), mode="bilinear")[0, 0]


def blurred(side: int, sigma: float) -> Axis:
    """Gaussian blur of standard deviation ``sigma``, in pixels."""
    offsets = torch.arange(side, dtype=torch.float32)
    weights = torch.exp(-((offsets[:, None] - offsets) ** 2) / (2 * max(sigma, 1e-3) ** 2))
    return weights / weights.sum(1, keepdim=True)
