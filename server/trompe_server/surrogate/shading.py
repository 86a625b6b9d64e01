"""From the texture value that a pixel reads to the colour it shows: the ladder of colour models.

Each model is a function of one number per pixel and channel, applied elementwise, and gives its derivative along with
its value. sRGB encoding follows IEC 61966-2-1.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

__all__ = ["CurveShading", "DiffuseShading", "Shading", "decode", "decode_slope", "encode", "encode_slope", "lambert"]


class Shading(Protocol):
    """The colour model of one view."""

    def __call__(
        self, values: Float[Tensor, "pixels 3"]
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3"]]:
        """Colours (sRGB in [0, 1]) of pixels that read ``values`` (encoded, in [0, 1]), and d colour / d value."""
        ...


def decode(encoded: Tensor) -> Tensor:
    """sRGB-encoded values in [0, 1] to linear light."""
    return torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055).clamp(min=0) ** 2.4)


def encode(linear: Tensor) -> Tensor:
    """Linear light in [0, 1] to sRGB-encoded values."""
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def decode_slope(encoded: Tensor) -> Tensor:
    """Derivative of ``decode``."""
    return torch.where(encoded <= 0.04045, 1 / 12.92, 2.4 / 1.055 * ((encoded + 0.055) / 1.055).clamp(min=0) ** 1.4)


def encode_slope(encoded: Tensor) -> Tensor:
    """Derivative of ``encode``, at the linear light whose encoding is ``encoded``."""
    return 1 / decode_slope(encoded)


@dataclass(frozen=True)
class DiffuseShading:
    """The paper's surrogate: texture value times (ambient + Lambert), in encoded values, over a known background.

    shade: ambient + diffuse * max(0, n . l) of each pixel. coverage: share of the pixel that the object covers.
    """

    shade: Float[Tensor, "pixels 1"]
    coverage: Float[Tensor, "pixels 1"]
    background: Float[Tensor, " 3"]

    def __call__(
        self, values: Float[Tensor, "pixels 3"]
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3"]]:
        factor = self.shade * self.coverage
        return values * factor + (1 - self.coverage) * self.background, factor.expand_as(values)


AMBIENT, DIFFUSE = 0.5, 0.3
"""The light of the paper's surrogate (PyTorch3D's defaults)."""


def lambert(normals: Float[Tensor, "n 3"], towards_light: Float[Tensor, " 3"]) -> Float[Tensor, "n 1"]:
    """ambient + diffuse * max(0, n . l) with the paper's constants."""
    cosine = torch.nn.functional.normalize(normals, dim=1) @ towards_light
    return (AMBIENT + DIFFUSE * cosine.clamp(min=0))[:, None]


@dataclass(frozen=True)
class CurveShading:
    """Per pixel and channel the curve through the target's own images of the object painted in K greys.

    Piecewise linear in linear light between the probes, which is exact where the image is affine in linear albedo and
    unsaturated; more greys follow saturation and the partly covered pixels, where multi-sampling averages encoded
    colours. K = 2 is the ``calibrated`` model.

    greys: encoded, ascending, from 0 to 255. probes: the images' object pixels, encoded, one row per grey.
    """

    greys: UInt8[Tensor, " k"]
    probes: UInt8[Tensor, "k pixels 3"]

    def __call__(
        self, values: Float[Tensor, "pixels 3"]
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3"]]:
        nodes = decode(self.greys.float() / 255)
        linear = decode(values)
        segment = torch.bucketize(linear, nodes[1:-1].contiguous())
        low, high = self._light(segment), self._light(segment + 1)
        start = nodes[segment]
        slope = (high - low) / (nodes[segment + 1] - start)
        colour = encode(torch.addcmul(low, slope, linear - start).clamp(0, 1))
        return colour, slope * decode_slope(values) * encode_slope(colour)

    def _light(self, node: Int[Tensor, "pixels 3"]) -> Float[Tensor, "pixels 3"]:
        """Linear light of each pixel and channel in the probe number ``node``."""
        table = decode(torch.arange(256, device=self.probes.device) / 255)
        return table[self.probes.gather(0, node[None])[0].int()]
