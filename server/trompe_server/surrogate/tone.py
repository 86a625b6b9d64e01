"""The tone curve of an engine, measured on a colour chart.

Film-like tone curves (ACES, AgX, Khronos Neutral, Reinhard, a colour-graded look-up table) map the light of a pixel to
its colour and couple the channels. A chart of flat, matt patches shows the target's curve at known multiples of one
light: a curve for each channel through greys, and a table of residuals for the coupling.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from trompe_server.surrogate.shading import GAIN, GAMMA, Chord, decode, decode_with_slope, encode, own_colours
from trompe_shared.errors import SpecError
from trompe_shared.geometry import FIELD_OF_VIEW, Camera, Light, View
from trompe_shared.object3d import Object3D, encode_png, object_from_files

Ask = Callable[[Object3D, Sequence[View]], NDArray[np.uint8]]
"""Renders images (views, H, W, 3) uint8 in the target."""

LEVELS: Final = 9
"""Levels of each channel in the table of residuals."""
GREYS: Final = 39
"""Greys in bright light."""
DIM_GREYS: Final = 256
"""Greys in dim light."""
ROWS: Final = 16
"""Most patches along a side of a chart."""
PITCH: Final = 6
"""Least pixels along a side of a patch."""
NODES: Final = 1025
"""Points of the tabulated curves."""
BRIGHTEST: Final = 2.0
"""Light of the chart's white patch; 1 is a white matt surface that faces a light of intensity 1."""
DIM: Final = 1 / 8
"""Factor of the dim light."""
GLOSS: Final = np.linspace(0, 0.25, 251)
"""Light of the chart's black patch, in tried values: no engine's surface is perfectly matt."""
CLIMB: Final = 1e-6
"""Least rise from node to node, so that a curve can be inverted where it is flat."""
SMOOTHING: Final = 1e-7
"""Penalty on the curvature of curves, for images of 8 bits."""
ITERATIONS: Final = 25
"""Fixed-point steps of the inversion."""


@dataclass(frozen=True)
class ToneMap:
    """Light (pixels, 3) to encoded colours: ``curve(u) + residual(v)``, with the sRGB encodings u of light / (black +
    ``BRIGHTEST``) and v of (light - black) / ``BRIGHTEST``.

    curves: (3, NODES), of each channel over u in [0, 1], ascending. residuals: (LEVELS, LEVELS, LEVELS, 3) on a regular
    grid of v in [0, 1]. black: light of the chart's black patch.
    """

    curves: Float[Tensor, "3 nodes"]
    residuals: Float[Tensor, "n n n 3"]
    black: Float[Tensor, ""]

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> "ToneMap":
        """Inverse of ``arrays``. Raises ``KeyError`` if one is missing."""
        return cls(*(torch.from_numpy(arrays[field.name]) for field in fields(cls)))

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """The fields by name."""
        return {field.name: getattr(self, field.name).numpy() for field in fields(self)}

    def to(self, device: torch.device) -> "ToneMap":
        """The same curve on a device."""
        return ToneMap(*(getattr(self, field.name).to(device) for field in fields(self)))

    def with_slope(
        self, light: Float[Tensor, "pixels 3"]
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3 3"]]:
        """(Encoded colours, their derivatives: [..., i, j] of channel i by the light of channel j)."""
        place, rate = encode.with_slope((light / self._top).clamp_(0, 1))
        among, among_rate = encode.with_slope(light.sub(self.black).mul_(1 / BRIGHTEST).clamp_(0, 1))
        curve, rise = self._curve(place.clamp_(0, 1))
        coupled, slopes = self._residual(among.clamp_(0, 1))
        slopes.mul_((among_rate / BRIGHTEST)[:, None, :])
        slopes.diagonal(dim1=1, dim2=2).add_(rise.mul_(rate / self._top))
        return curve.add_(coupled), slopes

    def light_of(self, shown: Float[Tensor, "pixels 3"]) -> Float[Tensor, "pixels 3"]:
        """The light that shows as ``shown``: the inverse, by fixed-point iteration."""
        light = decode(self._inverted(shown)) * self._top
        for _ in range(ITERATIONS):
            among = encode(light.sub(self.black).mul_(1 / BRIGHTEST).clamp_(0, 1)).clamp_(0, 1)
            light = decode(self._inverted(shown - self._residual(among)[0])) * self._top
        return light

    @cached_property
    def _top(self) -> Tensor:
        """Light at the end of the curves."""
        return self.black + BRIGHTEST

    def _curve(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """(Value, slope) of each channel's curve at ``place`` (pixels, 3) in [0, 1]."""
        last = self.curves.shape[1] - 1
        step = place * last
        low = step.floor().clamp_(max=last - 1)
        index = (low.long() + self._starts).flatten()
        flat = self.curves.flatten()
        begin, end = (flat.index_select(0, index + k).view_as(place) for k in (0, 1))
        rise = end - begin
        return torch.addcmul(begin, rise, step - low), rise * last

    @cached_property
    def _starts(self) -> Tensor:
        return torch.arange(3, device=self.curves.device) * self.curves.shape[1]

    def _inverted(self, shown: Tensor) -> Tensor:
        """The place where each channel's curve has the value ``shown``."""
        last = self.curves.shape[1] - 1
        columns = []
        for curve, values in zip(self.curves, shown.T.contiguous(), strict=True):
            index = torch.searchsorted(curve, values).clamp_(1, last)
            low, high = curve[index - 1], curve[index]
            columns.append(((values - low) / (high - low)).clamp_(0, 1).add_(index - 1))
        return torch.stack(columns, 1) / last

    def _residual(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """(Residual (pixels, 3), its derivatives by the place (pixels, 3, 3)): trilinear interpolation."""
        count = len(self.residuals)
        step = place * (count - 1)
        low = step.floor().clamp_(max=count - 2)
        red, green, blue = low.long().unbind(1)  # CUDA multiplies no integer matrices
        first = (red * count + green) * count + blue
        table = self.residuals.view(-1, 3)
        corners = torch.stack(
            [table[first + (r * count + g) * count + b] for r in (0, 1) for g in (0, 1) for b in (0, 1)]
        ).view(2, 2, 2, -1, 3)
        r, g, b = (step - low)[:, :, None].unbind(1)
        along_b = corners[:, :, 1] - corners[:, :, 0]
        at_b = corners[:, :, 0] + along_b * b
        along_g = at_b[:, 1] - at_b[:, 0]
        at_g = at_b[:, 0] + along_g * g
        slope_g = along_g[0] + (along_g[1] - along_g[0]) * r
        edge = along_b[:, 0] + (along_b[:, 1] - along_b[:, 0]) * g
        slopes = torch.stack([at_g[1] - at_g[0], slope_g, edge[0] + (edge[1] - edge[0]) * r], 2)
        return at_g[0] + slopes[..., 0] * r, slopes * (count - 1)


@dataclass(frozen=True)
class ToneShading:
    """The measured colour model behind a tone curve: light of the covered share is affine in linear albedo.

    light, slope: at black, and by linear albedo. coverage: of the pixel. shift: added to the colour: the background's
    share and the anchor.
    """

    tone: ToneMap
    light: Float[Tensor, "pixels 3"]
    slope: Float[Tensor, "pixels 3"]
    coverage: Float[Tensor, "pixels 1"]
    shift: Float[Tensor, "pixels 3"]

    def __call__(
        self, values: Float[Tensor, "pixels 3"]
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3 3"]]:
        albedo, rate = decode_with_slope(values)
        shown, slopes = self.tone.with_slope(torch.addcmul(self.light, self.slope, albedo))
        by_value = rate.mul_(self.slope).mul_(self.coverage * (GAMMA / GAIN))
        colour = torch.addcmul(self.shift, shown, self.coverage)
        inside = (colour >= 0) & (colour <= 1)
        return colour.clamp_(0, 1), slopes.mul_(by_value[:, None, :]).mul_(inside[:, :, None])


def fit_tone(
    grey: int,
    probes: UInt8[Tensor, "2 pixels 3"],
    coverage: Float[Tensor, "pixels 1"],
    background: Float[Tensor, "pixels 3"],
    tone: ToneMap,
    chord: Chord | None = None,
) -> ToneShading:
    """Fit the model to the target's images of the object painted black and in ``grey`` (encoded), as ``fit_curve``."""
    uncovered = (1 - coverage) * background
    black, light = (tone.light_of(own_colours(probe, coverage, uncovered)) for probe in probes)
    albedo = float(decode(torch.tensor(grey / 255)))
    slope = (light - black) / albedo
    if chord is not None:
        clean = own_colours(chord.shown, coverage, uncovered)
        slope = chord.corrected(slope, black, tone.light_of(clean), clean, albedo)
    return ToneShading(tone, black, slope, coverage, uncovered)


def measure_tone_map(ask: Ask, size: tuple[int, int]) -> ToneMap:
    """Measure the target's tone curve with a few images of a colour chart in front of the camera: 4 of 224 x 224.

    size: (H, W) of the images. Raises ``SpecError`` if they are too small for a chart.
    """
    if (rows := min(ROWS, int(FILLED * min(size) / PITCH))) < 2:
        least = math.ceil(2 * PITCH / FILLED)
        raise SpecError(
            f"A tone curve is measured on images of at least {least} x {least} pixels, and the network's are {size[0]} "
            f"x {size[1]}: choose `surrogate: curve`, which needs none, or a network of larger images."
        )
    camera = Camera(DISTANCE * max(1.0, size[0] / size[1]), 0.0, 0.0)
    colours, dim = _colours()
    shown, shown_dim = (
        _seen(ask, each, View(camera, light), rows) for each, light in ((colours, LIGHT), (dim, DIM_LIGHT))
    )
    greys, cube = shown[:GREYS], shown[GREYS:].reshape(LEVELS, LEVELS, LEVELS, 3)
    light, light_dim = (BRIGHTEST * _linear(each[:, 0]) for each in (colours[:GREYS], dim))
    black = min(GLOSS, key=lambda black: _mismatch(light + black, greys, DIM * (light_dim + black), shown_dim))
    seen = np.concatenate([light + black, DIM * (light_dim + black)])
    place = _encoded(seen / (black + BRIGHTEST))
    curves = np.stack([_smoothed(place, np.concatenate([greys, shown_dim])[:, c]) for c in range(3)])
    at = _encoded((BRIGHTEST * _linear(np.round(255 * np.linspace(0, 1, LEVELS))) + black) / (black + BRIGHTEST))
    at_levels = np.stack([np.interp(at, np.linspace(0, 1, NODES), curve) for curve in curves], 1)
    grid = np.stack(np.meshgrid(*[np.arange(LEVELS)] * 3, indexing="ij"), -1)
    residuals = cube - at_levels[grid, np.arange(3)]
    return ToneMap(*(torch.from_numpy(np.asarray(each)).float() for each in (curves, residuals, black)))


def _mismatch(
    light: NDArray[np.float64], shown: NDArray[np.float64], dim: NDArray[np.float64], shown_dim: NDArray[np.float64]
) -> float:
    """Mean square by which greys of equal light differ under both lights."""
    both = (dim >= light.min()) & (dim <= light.max())
    expected = np.stack([np.interp(dim[both], light, column) for column in shown.T], 1)
    return float(np.square(expected - shown_dim[both]).mean())


def _linear(encoded: NDArray[Any]) -> NDArray[np.float64]:
    return np.asarray(decode(torch.from_numpy(encoded / 255.0)).numpy(), np.float64)


def _encoded(light: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(encode(torch.from_numpy(np.clip(light, 0, 1))).numpy(), np.float64)


def _smoothed(place: NDArray[np.float64], shown: NDArray[np.float64]) -> NDArray[np.float64]:
    """An ascending curve (NODES,) through one channel of the greys."""
    from scipy.interpolate import make_smoothing_spline  # a third of a second, and few jobs need it

    levels, which = np.unique(place.round(6), return_inverse=True)
    mean = np.bincount(which, shown) / np.bincount(which)
    curve = make_smoothing_spline(levels, mean, lam=SMOOTHING)(np.linspace(0, 1, NODES))
    return np.asarray(np.maximum.accumulate(curve) + CLIMB * np.arange(NODES))


def _colours() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Encoded patches (n, 3): greys, then all colours; and greys for dim light."""
    levels = np.linspace(0, 1, LEVELS)
    colours = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), -1).reshape(-1, 3)
    greys, dim = (np.linspace(0, 1, count)[:, None].repeat(3, 1) for count in (GREYS, DIM_GREYS))
    return _in_8_bits(np.concatenate([greys, colours])), _in_8_bits(dim)


def _in_8_bits(colours: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.asarray((255 * colours).round(), np.uint8)


def _seen(ask: Ask, colours: NDArray[np.uint8], view: View, rows: int) -> NDArray[np.float64]:
    """The colours (n, 3) that patches show, in [0, 1], on charts of ``rows`` x ``rows`` patches."""
    charts = -(-len(colours) // rows**2)
    patches = np.resize(colours, (charts, rows, rows, 3))
    images = [ask(_chart(each), [view])[0] for each in patches]
    return np.concatenate([_read(image, rows) for image in images])[: len(colours)]


TEXELS: Final = 16
"""Texels along a side of a patch."""
SIDE: Final = 1.0
"""Side of the chart, metres."""
FILLED: Final = 0.8
"""Share of the picture's smaller side that the chart fills."""

DISTANCE: Final = float(SIDE / 2 / FILLED / np.tan(np.radians(FIELD_OF_VIEW / 2)))
"""Of the camera, for pictures as high as wide, or wider."""

LIGHT: Final = Light(
    azimuth=0.0, elevation=45.0, intensity=float((BRIGHTEST - 128 / 255) * np.sqrt(2)), ambient=128 / 255
)
"""Its reflection passes far below the camera. Ambient light is told to renderers in 8 bits."""
DIM_LIGHT: Final = replace(LIGHT, intensity=DIM * LIGHT.intensity, ambient=DIM * LIGHT.ambient)


def _chart(colours: NDArray[np.uint8]) -> Object3D:
    """A square of matt patches that faces +z; ``colours`` (rows, rows, 3), row 0 on top."""
    half = SIDE / 2
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    model = [
        "mtllib chart.mtl",
        *(f"v {x} {y} 0" for x, y in corners),
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\nusemtl chart\nf 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1",
    ]
    files = {
        "chart.obj": "\n".join(model).encode(),
        "chart.mtl": b"newmtl chart\nKd 1 1 1\nKs 0 0 0\nmap_Kd chart.png\n",
        "chart.png": encode_png(colours.repeat(TEXELS, 0).repeat(TEXELS, 1)),
    }
    return object_from_files(files)


def _read(image: NDArray[np.uint8], rows: int) -> NDArray[np.float64]:
    """Mean colours (rows * rows, 3) of the patches' middles, in [0, 1]."""
    height, width = image.shape[:2]
    pitch = FILLED * min(height, width) / rows
    centres = (np.arange(rows) + 0.5 - rows / 2) * pitch
    offsets = np.arange(-round(pitch / 5), round(pitch / 5) + 1)
    down, right = (np.round(side / 2 - 0.5 + centres)[:, None].astype(int) + offsets for side in (height, width))
    patches = image[down[:, None, :, None], right[None, :, None, :]]
    return np.asarray(patches.mean(axis=(2, 3)).reshape(-1, 3) / 255)
