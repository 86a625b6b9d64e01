"""From the texture value that a pixel reads to the colour it shows: the ladder of colour models.

Each model is a function of one number per pixel and channel, applied elementwise, and gives its derivative along with
its value. sRGB encoding follows IEC 61966-2-1.
"""

from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

Encoding = Literal["srgb", "power"]

POWER = 2.2
"""Exponent of the plain power-law encoding that some renderers use in place of the sRGB curve."""

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


def decode_slope(encoded: Tensor, linear: Tensor) -> Tensor:
    """Derivative of ``decode`` at ``encoded``, whose decoding is ``linear``."""
    return torch.where(encoded <= 0.04045, 1 / 12.92, 2.4 * linear / (encoded + 0.055))


def decode_as(encoded: Tensor, encoding: Encoding) -> Tensor:
    """Encoded image values in [0, 1] to linear light."""
    return decode(encoded) if encoding == "srgb" else encoded**POWER


def encode_as(linear: Tensor, encoding: Encoding) -> Tensor:
    """Linear light in [0, 1] to encoded image values."""
    return encode(linear) if encoding == "srgb" else linear ** (1 / POWER)


def encode_slope(linear: Tensor, encoding: Encoding) -> Tensor:
    """Derivative of ``encode_as`` at ``linear`` > 0."""
    encoded = encode_as(linear, encoding)
    return 1 / decode_slope(encoded, linear) if encoding == "srgb" else encoded / (POWER * linear)


@dataclass(frozen=True)
class DiffuseShading:
    """The paper's surrogate: texture value times (ambient + Lambert), in encoded values, over a known background.

    shade: ambient + diffuse * max(0, n . l) of each pixel. coverage: share of the pixel that the object covers.
    """

    shade: Float[Tensor, "pixels 1"]
    coverage: Float[Tensor, "pixels 1"]
    background: Float[Tensor, "pixels 3"]

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
    """What was measured on the target: per pixel and channel the light it shows for any albedo.

    The covered share of a pixel shows light that is piecewise linear in linear albedo, clipped at white, and encoded;
    the rest shows the background. For one shading point under fixed light that is exact physics whatever the material,
    with two probes; more greys follow what several shading points in one pixel make of saturation.

    nodes: linear albedo at which segments begin, ascending. light, slope: the line of each segment.
    """

    nodes: Float[Tensor, " segments"]
    light: Float[Tensor, "segments pixels 3"]
    slope: Float[Tensor, "segments pixels 3"]
    coverage: Float[Tensor, "pixels 1"]
    background: Float[Tensor, "pixels 3"]
    encoding: Encoding

    def __call__(
        self, values: Float[Tensor, "pixels 3"]
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3"]]:
        linear = decode(values)
        start, light, slope = self._segment(linear)
        exact = torch.addcmul(light, slope, linear - start)
        shown = exact.clamp(0, 1)
        colour = encode_as(shown, self.encoding)
        steepness = slope * decode_slope(values, linear) * encode_slope(shown.clamp(min=DIM), self.encoding)
        steepness = steepness * ((exact >= 0) & (exact < 1))
        return self.coverage * colour + (1 - self.coverage) * self.background, self.coverage * steepness

    def _segment(self, linear: Float[Tensor, "pixels 3"]) -> tuple[Tensor, Tensor, Tensor]:
        """(albedo where it begins, light there, slope) of the segment that each value lies in."""
        if len(self.nodes) == 1:
            return self.nodes[0], self.light[0].float(), self.slope[0].float()
        segment = torch.bucketize(linear, self.nodes[1:].contiguous())
        light, slope = (table.gather(0, segment[None])[0].float() for table in (self.light, self.slope))
        return self.nodes[segment], light, slope


DIM = 1e-4
"""Linear light below which the slope of the encoding grows no further: a chord over the first 8-bit steps, not a
tangent."""

WHITE = 0.996
"""Encoded values from here on may be clipped."""


def fit_curve(
    greys: UInt8[Tensor, " k"],
    probes: UInt8[Tensor, "k pixels 3"],
    coverage: Float[Tensor, "pixels 1"],
    background: Float[Tensor, "pixels 3"],
    encoding: Encoding,
) -> CurveShading:
    """The colour model through the target's own images of the object painted in K greys (encoded, ascending, from 0).

    A segment that ends in white may bend on the way there: it takes the slope of the one before it and is clipped.
    """
    nodes = decode(greys.float() / 255)
    shown = ((probes.float() / 255 - (1 - coverage) * background) / coverage).clamp(0, 1)
    light = decode_as(shown, encoding)
    slope = light.diff(dim=0) / nodes.diff()[:, None, None]
    bends = (shown[1:] >= WHITE) & (shown[:-1] < WHITE)
    for segment in range(1, len(slope)):
        slope[segment] = torch.where(bends[segment], slope[segment - 1], slope[segment])
    return CurveShading(nodes[:-1], light[:-1].half(), slope.half(), coverage, background, encoding)
