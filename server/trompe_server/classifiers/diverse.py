"""A classifier that looks at each image a little differently: what fools it then is less its own quirk.

Random shifts and scales (Xie et al. 2019, input diversity), and mirroring.
"""

import math
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from trompe_server.classifiers.drawing import generator_for
from trompe_server.classifiers.protocol import WhiteBoxClassifier, Wrapper

__all__ = ["DiverseClassifier"]

SCALE: Final = 4 / 3
"""Images are shown larger or smaller by this factor at most."""

SHIFT: Final = 0.075
"""The furthest shift, as a share of the image's side."""


@dataclass(frozen=True)
class DiverseClassifier(Wrapper):
    """``inner`` for images that are scaled, shifted and mirrored at random, each in its own way. ``predict`` shows them
    as they are.

    The draws depend on the seed and on the images shown together alone. Ensembles give all members one seed: they see
    the same.
    """

    inner: WhiteBoxClassifier
    seed: int

    @property
    def image_size(self) -> tuple[int, int]:
        """See ``Classifier``."""
        return self.inner.image_size

    def logits(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1] of the classifier's own size, differentiable in them."""
        grid = F.affine_grid(self._places(images), list(images.shape), align_corners=False)
        return self.inner.logits(F.grid_sample(images, grid, padding_mode="border", align_corners=False))

    def _places(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n 2 3"]:
        """Where each image is looked at, as ``affine_grid`` takes it."""
        drawn = torch.rand(len(images), 4, generator=generator_for(images, self.seed)).to(images)
        scale = torch.exp((2 * drawn[:, 0] - 1) * math.log(SCALE))
        places = images.new_zeros(len(images), 2, 3)
        places[:, 0, 0] = torch.where(drawn[:, 1] < 0.5, -scale, scale)
        places[:, 1, 1] = scale
        places[:, :, 2] = 2 * SHIFT * (2 * drawn[:, 2:] - 1)
        return places
