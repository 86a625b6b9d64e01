"""Colour models: from a pixel's texture value to its colour.

Each model is called with the texture values (pixels, 3) of pixels and returns (colours, d colour / d value), values and
colours encoded and in [0, 1]. The derivatives are of each channel by itself, (pixels, 3), or (pixels, 3, 3) with
[..., i, j] of channel i by channel j. ``shift`` is added to all colours. sRGB encoding follows IEC 61966-2-1.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

Encoding = Literal["srgb", "power"]

POWER = 2.2
"""Exponent of the power-law encoding of some renderers, in place of the sRGB curve."""


GAIN, OFFSET, GAMMA = 1.055, 0.055, 2.4
TOE = 12.92
KNEE = (0.04045 + OFFSET) / GAIN
"""sRGB: linear light is ((encoded + OFFSET) / GAIN) ** GAMMA, and encoded / TOE where that base is below the KNEE."""


def decode(encoded: Tensor) -> Tensor:
    """sRGB-encoded values in [0, 1] to linear light. Differentiable."""
    return _decoded(encoded)[0]


def decode_with_slope(encoded: Tensor) -> tuple[Tensor, Tensor]:
    """Linear light of sRGB-encoded values, and its derivative in units of GAMMA / GAIN.

    The line below the knee is written as an offset to the power at the knee: one power without branches. Its slope is
    taken as that of the power at the knee (2 % off).
    """
    light, power, bright = _decoded(encoded)
    return light, power.div_(bright)


def _decoded(encoded: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(Linear light, its power term, base of the power)."""
    base = encoded.add(OFFSET).mul_(1 / GAIN)
    bright = base.clamp(min=KNEE)
    power = _power(bright, GAMMA)
    return (base - bright).mul_(GAIN / TOE).add_(power), power, bright


def _power(base: Tensor, exponent: float) -> Tensor:
    """``base ** exponent`` of values in about [0.001, 1] to 1e-6, in half the time of ``pow``."""
    return base.sub(1).log1p_().mul_(exponent / math.log(2)).exp2_()


@dataclass(frozen=True)
class Encoder:
    """An encoding of linear light: ``gain * (max(light, dark) ** exponent + toe * min(light, dark)) - offset``.

    steepest: bound of ``bright ** exponent / bright`` and thus of the slope. Light is clipped to [0, 1].
    """

    exponent: float
    gain: float
    offset: float
    toe: float
    dark: float
    steepest: float

    @property
    def steepness(self) -> float:
        """Factor from the product of the slopes of ``decode_with_slope`` and ``partly`` to a derivative."""
        return GAMMA / GAIN * self.exponent * self.gain

    def __call__(self, light: Tensor) -> Tensor:
        """Linear light in [0, 1] to encoded values. Differentiable."""
        return self._encoded(light)[0] * self.gain - self.offset

    def with_slope(self, light: Tensor) -> tuple[Tensor, Tensor]:
        """(Encoded values, their derivative by the light)."""
        part, slope = self.partly(light)
        return part * self.gain - self.offset, slope * (self.exponent * self.gain)

    def partly(self, light: Tensor) -> tuple[Tensor, Tensor]:
        """(Encoded values before gain and offset, their derivative in units of the exponent)."""
        part, power, bright = self._encoded(light)
        return part, power.div_(bright).clamp_(max=self.steepest)

    def _encoded(self, light: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(Encoded values before gain and offset, their power term, base of the power)."""
        bright = light.clamp(self.dark, 1)
        power = _power(bright, self.exponent)
        return light.clamp(0, self.dark).mul_(self.toe).add_(power), power, bright


DIM = 1e-4
"""Linear light below which the power encoding's slope stays constant: a chord over the first 8-bit steps."""

LEAST = 1e-7
"""Linear light below which the power encoding itself is a chord, within a tenth of an 8-bit step of the curve."""

DARK = 0.0031308
"""Linear light above which sRGB is a power."""

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

    factor: (ambient + diffuse * max(0, n . l)) of each pixel, times its coverage. shift: the background's share.
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
    """The measured colour model: light of each pixel and channel for any albedo.

    The covered share of a pixel shows light piecewise linear in linear albedo, clipped at white and encoded; the rest
    shows the background. For one shading point under fixed light two probes are exact physics for any material; more
    greys model the saturation of several shading points in one pixel.

    light, slope: the first segment, from black. nodes: linear albedo at the starts of the next segments, ascending.
    bends: changes of the slope there. steepness: the pixel's coverage times the encoder's. shift: added to the colour:
    the background's share and the anchor.
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
        """(Light at black, slope) of the line at each albedo."""
        light, slope, beyond = self.light, self.slope, torch.empty_like(linear)
        for node, bend in zip(self.nodes, self.bends, strict=True):
            torch.gt(linear, node, out=beyond)  # 0.0 or 1.0: booleans take four times as long
            light = torch.addcmul(light, bend, beyond, value=-node)
            slope = torch.addcmul(slope, bend, beyond)
        return light, slope


def _zero_where_clipped(slopes: Tensor, clipped: Tensor) -> None:
    """Set ``slopes`` to zero at values ``clipped`` to [0, 1] from outside."""
    torch.ops.aten.hardtanh_backward.grad_input(slopes, clipped, -ROUNDING, 1 + ROUNDING, grad_input=slopes)


ROUNDING = 1e-5
"""Tolerance below black and above white that counts as rounding, not clipping."""

WHITE = 0.996
"""Encoded value above which a probe may be clipped."""


def own_colours(
    shown: UInt8[Tensor, "*k pixels 3"], coverage: Float[Tensor, "pixels 1"], uncovered: Float[Tensor, "pixels 3"]
) -> Float[Tensor, "*k pixels 3"]:
    """Colours of the covered share of pixels in an image, encoded; ``uncovered``: the background's share."""
    return ((shown.float() / 255 - uncovered) / coverage).clamp(0, 1)


CHORD_WEIGHT: Final = 30.0
"""Weight of the chord against the slope of greys; dark albedos show little of their own slope."""


@dataclass(frozen=True)
class Chord:
    """The unpainted object as a third probe.

    Light from a grey neighbour is part of the slope between two greys, but not of the effect of paint with zero mean.
    The chord from black to the unpainted object holds the light of unpainted neighbours instead.

    shown: the target's image. albedo: linear albedo in [0, 1].
    """

    shown: UInt8[Tensor, "pixels 3"]
    albedo: Float[Tensor, "pixels 3"]

    def corrected(
        self, slope: Tensor, black: Tensor, light: Tensor, shown: Float[Tensor, "pixels 3"], grey: float
    ) -> Tensor:
        """Least-squares slope of chord and greys; the greys' alone where the unpainted object may be clipped.

        black, light: light of the black and of the unpainted object. shown: its colours. grey: albedo of the grey.
        """
        weight = (CHORD_WEIGHT * self.albedo).mul_(shown < WHITE)
        along = weight * (light - black).clamp(min=0) + grey * grey * slope
        return along / (weight * self.albedo + grey * grey)


def fit_curve(
    greys: UInt8[Tensor, " k"],
    probes: UInt8[Tensor, "k pixels 3"],
    coverage: Float[Tensor, "pixels 1"],
    background: Float[Tensor, "pixels 3"],
    encoding: Encoding,
    chord: Chord | None = None,
) -> CurveShading:
    """Fit the colour model to the target's images of the object painted in K greys (encoded, ascending, from 0).

    A segment that ends in white may bend on the way: it takes the slope of the previous one, if steeper, and is
    clipped. chord: corrects the slope of two greys.
    """
    uncovered = (1 - coverage) * background
    nodes = decode(greys.float() / 255)
    shown = own_colours(probes, coverage, uncovered)
    light = decode_as(shown, encoding)
    slope = light.diff(dim=0) / nodes.diff()[:, None, None]
    if chord is not None:
        clean = own_colours(chord.shown, coverage, uncovered)
        slope = chord.corrected(slope, light[0], decode_as(clean, encoding), clean, float(nodes[1]))
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
