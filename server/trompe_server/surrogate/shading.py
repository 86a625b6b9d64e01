"""From the texture value that a pixel reads to the colour it shows: the ladder of colour models.

Each model is a function of one number per pixel and channel, applied elementwise, and gives its derivative along with
its value. sRGB encoding follows IEC 61966-2-1.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal, Protocol

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

Encoding = Literal["srgb", "power"]

POWER = 2.2
"""Exponent of the plain power-law encoding that some renderers use in place of the sRGB curve."""

__all__ = [
    "CurveShading",
    "DiffuseShading",
    "Encoder",
    "Shading",
    "decode",
    "decode_with_slope",
    "encode",
    "fit_curve",
    "lambert",
]


class Shading(Protocol):
    """The colour model of the object's pixels."""

    def __call__(
        self, values: Float[Tensor, "pixels 3"]
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3"]]:
        """Colours (encoded, clipped to [0, 1]) of pixels that read ``values`` (encoded, in [0, 1]), and d colour /
        d value."""
        ...


GAIN, OFFSET, GAMMA = 1.055, 0.055, 2.4
TOE = 12.92
KNEE = (0.04045 + OFFSET) / GAIN
"""sRGB: linear light is ((encoded + OFFSET) / GAIN) ** GAMMA, and encoded / TOE where that base is below the KNEE."""


def decode(encoded: Tensor) -> Tensor:
    """sRGB-encoded values in [0, 1] to linear light. Differentiable."""
    return _decoded(encoded)[0]


def decode_with_slope(encoded: Tensor) -> tuple[Tensor, Tensor]:
    """Linear light of sRGB-encoded values, and its derivative in units of GAMMA / GAIN.

    The line below the knee is written as what it lacks of the power there: one power does for both, without branches.
    Its slope is taken to be that of the power at the knee (they differ by 2 %).
    """
    light, power, bright = _decoded(encoded)
    return light, power.div_(bright)


def _decoded(encoded: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Linear light, and of it what is a power, and of what."""
    base = encoded.add(OFFSET).mul_(1 / GAIN)
    bright = base.clamp(min=KNEE)
    power = _power(bright, GAMMA)
    return (base - bright).mul_(GAIN / TOE).add_(power), power, bright


def _power(base: Tensor, exponent: float) -> Tensor:
    """``base ** exponent`` of values in about [0.001, 1], to 1e-6: half the time of ``pow``, which is exact for all."""
    return base.sub(1).log1p_().mul_(exponent / math.log(2)).exp2_()


@dataclass(frozen=True)
class Encoder:
    """An encoding of linear light: ``gain * (bright ** exponent + toe * dim) - offset``, where ``bright`` is the light,
    ``dark`` at least, and ``dim`` the light, ``dark`` at most. ``steepest`` bounds ``bright ** exponent / bright``, and
    with it the slope. Light is clipped to [0, 1]."""

    exponent: float
    gain: float
    offset: float
    toe: float
    dark: float
    steepest: float

    @property
    def steepness(self) -> float:
        """What turns the slopes of ``decode_with_slope`` times those of ``partly`` into a derivative."""
        return GAMMA / GAIN * self.exponent * self.gain

    def __call__(self, light: Tensor) -> Tensor:
        """Linear light in [0, 1] to encoded values. Differentiable."""
        return self._encoded(light)[0] * self.gain - self.offset

    def with_slope(self, light: Tensor) -> tuple[Tensor, Tensor]:
        """Encoded values, and their derivative by the light."""
        part, slope = self.partly(light)
        return part * self.gain - self.offset, slope * (self.exponent * self.gain)

    def partly(self, light: Tensor) -> tuple[Tensor, Tensor]:
        """Encoded values before gain and offset, and their derivative in units of the exponent."""
        part, power, bright = self._encoded(light)
        return part, power.div_(bright).clamp_(max=self.steepest)

    def _encoded(self, light: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Encoded values before gain and offset, and of them what is a power, and of what."""
        bright = light.clamp(self.dark, 1)
        power = _power(bright, self.exponent)
        return light.clamp(0, self.dark).mul_(self.toe).add_(power), power, bright


DIM = 1e-4
"""Linear light below which the slope of the power encoding grows no further: a chord over the first 8-bit steps, not a
tangent."""

LEAST = 1e-7
"""Linear light below which the power encoding is a chord too, less than a tenth of an 8-bit step from the curve."""

DARK = 0.0031308
"""Linear light from which on sRGB is a power."""

ENCODERS: Final[Mapping[Encoding, Encoder]] = {
    "srgb": Encoder(1 / GAMMA, GAIN, OFFSET + TOE * DARK, TOE / GAIN, DARK, DARK ** (1 / GAMMA - 1)),
    "power": Encoder(1 / POWER, 1.0, LEAST ** (1 / POWER), LEAST ** (1 / POWER - 1), LEAST, DIM ** (1 / POWER - 1)),
}

encode = ENCODERS["srgb"]
"""Linear light in [0, 1] to sRGB-encoded values."""


def decode_as(encoded: Tensor, encoding: Encoding) -> Tensor:
    """Encoded image values in [0, 1] to linear light."""
    return decode(encoded) if encoding == "srgb" else encoded**POWER


@dataclass(frozen=True)
class DiffuseShading:
    """The paper's surrogate: texture value times (ambient + Lambert), in encoded values, over a known background.

    factor: ambient + diffuse * max(0, n . l) of each pixel, times the share of it that the object covers. shift: what
    the background adds.
    """

    factor: Float[Tensor, "pixels 1"]
    shift: Float[Tensor, "pixels 3"]

    def __call__(
        self, values: Float[Tensor, "pixels 3"]
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3"]]:
        return torch.addcmul(self.shift, values, self.factor).clamp_(0, 1), self.factor.expand_as(values)


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

    light, slope: the line that black begins. nodes: linear albedo where the next segments begin, ascending. bends: how
    much the slope changes there. steepness: share of the pixel that the object covers, times that of the encoder.
    shift: added to the colour of that share: what the background adds, and what anchors the prediction.
    """

    light: Float[Tensor, "pixels 3"]
    slope: Float[Tensor, "pixels 3"]
    nodes: tuple[float, ...]
    bends: Float[Tensor, "nodes pixels 3"]
    steepness: Float[Tensor, "pixels 3"]
    shift: Float[Tensor, "pixels 3"]
    encoding: Encoding

    def __call__(
        self, values: Float[Tensor, "pixels 3"]
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3"]]:
        encoder = ENCODERS[self.encoding]
        linear, slopes = decode_with_slope(values)
        light, rising = self._segment(linear)
        light = torch.addcmul(light, rising, linear)
        encoded, encoding = encoder.partly(light)
        colour = torch.addcmul(self.shift, self.steepness, encoded, value=encoder.gain / encoder.steepness)
        slopes.mul_(encoding).mul_(rising).mul_(self.steepness)
        for clipped in (light, colour):
            _zero_where_clipped(slopes, clipped)
        return colour.clamp_(0, 1), slopes

    def _segment(
        self, linear: Float[Tensor, "pixels 3"]
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3"]]:
        """The line that holds at each albedo: its light at black, and its slope."""
        light, slope, beyond = self.light, self.slope, torch.empty_like(linear)
        for node, bend in zip(self.nodes, self.bends, strict=True):
            torch.gt(linear, node, out=beyond)  # 0.0 or 1.0: booleans would take four times as long
            light = torch.addcmul(light, bend, beyond, value=-node)
            slope = torch.addcmul(slope, bend, beyond)
        return light, slope

    def anchored(self, anchor: Float[Tensor, "pixels 3"]) -> "CurveShading":
        """The same with ``anchor`` added to all colours."""
        return replace(self, shift=self.shift + anchor)


def _zero_where_clipped(slopes: Tensor, clipped: Tensor) -> None:
    """Make ``slopes`` zero where values that are ``clipped`` to [0, 1] lie beyond it."""
    torch.ops.aten.hardtanh_backward.grad_input(slopes, clipped, -ROUNDING, 1 + ROUNDING, grad_input=slopes)


ROUNDING = 1e-5
"""A value so little below black or above white is not clipped, just rounded."""

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

    A segment that ends in white may bend on the way there: it takes the slope of the one before it, if that is steeper,
    and is clipped.
    """
    uncovered = (1 - coverage) * background
    nodes = decode(greys.float() / 255)
    shown = ((probes.float() / 255 - uncovered) / coverage).clamp(0, 1)
    light = decode_as(shown, encoding)
    slope = light.diff(dim=0) / nodes.diff()[:, None, None]
    bends = (shown[1:] >= WHITE) & (shown[:-1] < WHITE)
    for segment in range(1, len(slope)):
        steeper = slope[segment].maximum(slope[segment - 1])
        slope[segment] = torch.where(bends[segment], steeper, slope[segment])
    encoder = ENCODERS[encoding]
    return CurveShading(
        light[0],
        slope[0],
        tuple(nodes[1:-1].tolist()),
        slope.diff(dim=0),
        (coverage * encoder.steepness).expand_as(background).contiguous(),
        uncovered - coverage * encoder.offset,
        encoding,
    )
