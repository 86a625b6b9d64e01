"""Random chains of operations on images, differentiable, and drawn anew for each image; and the named ones.

The expectation over them makes paint that survives them (Athalye et al., 2018, expectation over transformation). All
act on encoded levels, as programs that resize pictures do. What is linear in the image comes first and is one matrix
per axis.
"""

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Final

import numpy as np
import PIL.Image
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from trompe_server.classifiers.drawing import seeded_generator
from trompe_server.classifiers.protocol import fit_images
from trompe_server.image_pipelines.resampling import Axis, blurred, placed, resampled, resized
from trompe_server.system.threads import in_threads

Range = tuple[float, float]
Images = Float[Tensor, "n 3 H W"]
Image8 = NDArray[np.uint8]

SHOWN_AT_ONCE: Final = 20
"""Images of one call of ``apply`` in ``shown``."""

DARKEST: Final = 1e-4
"""Level from which a tone curve has a finite slope."""


@dataclass(frozen=True)
class ImagePipeline:
    """Operations in the order of these fields, each with the range (low, high) of its strength; ``None``: left out.

    spared: probability of an image that stays as it is. often: probability of each operation, for each other image.
    mirrored: probability of a mirrored image. zoom: magnification. shift: of each axis, as a share of the side. resize:
    factor of the sides; the image is reduced and enlarged again. blur: standard deviation in pixels. gamma: exponent of
    the levels. gain: factor of the levels. filmic: share of a film-like tone curve (Narkowicz's fit of ACES). noise:
    largest change of a level, uniform, in [0, 1] units. jpeg: quality, 1..95; its gradient is that of the unchanged
    image.
    """

    spared: float = 0.0
    often: float = 1.0
    mirrored: float = 0.0
    zoom: Range | None = None
    shift: Range | None = None
    resize: Range | None = None
    blur: Range | None = None
    gamma: Range | None = None
    gain: Range | None = None
    filmic: Range | None = None
    noise: Range | None = None
    jpeg: Range | None = None

    def apply(self, images: Images, generators: Sequence[torch.Generator]) -> Images:
        """sRGB images in [0, 1], each through its own draws from its generator. Differentiable in the images."""
        rows, drawn = list(images), [_Draw(self._strengths(each), each) for each in generators]
        for names, change in _STAGES:
            numbers = [number for number, draw in enumerate(drawn) if draw.strengths.keys() & names]
            if numbers:
                changed = change(torch.stack([rows[k] for k in numbers]), [drawn[k] for k in numbers])
                for number, image in zip(numbers, changed, strict=True):
                    rows[number] = image
        return torch.stack(rows) if any(draw.strengths for draw in drawn) else images

    def shown(self, images: Image8, numbers: Sequence[int] | None = None) -> Image8:
        """8-bit images (N, H, W, 3) through the pipeline; an image's draws depend on its number only: 0, 1, ... if
        none are given."""
        parts, numbers = [images[:0]], range(len(images)) if numbers is None else numbers
        for first in range(0, len(images), SHOWN_AT_ONCE):
            some = images[first : first + SHOWN_AT_ONCE]
            generators = [_generator(number) for number in numbers[first : first + SHOWN_AT_ONCE]]
            parts.append(_levels(self.apply(fit_images(some, some.shape[1:3]), generators)))
        return np.concatenate(parts)

    def _strengths(self, generator: torch.Generator) -> Mapping[str, float]:
        """Operations of one image with their strengths. Each takes its numbers whether it is used or not."""
        *drawn, (spared, _) = torch.rand(len(_OPERATIONS) + 1, 2, generator=generator).tolist()
        if spared < self.spared:
            return {}
        found = {}
        for name, (used, share) in zip(_OPERATIONS, drawn, strict=True):
            given = getattr(self, name.split()[0])
            chance, between = (given, (1, 1)) if name == "mirrored" else (self.often, given)
            if between and used < chance:
                low, high = between
                found[name] = low + (high - low) * share
        return found


_OPERATIONS: Final = (
    *("zoom", "shift of rows", "shift of columns", "mirrored"),
    *("resize", "blur", "gamma", "gain", "filmic", "noise", "jpeg"),
)
"""Operations in their order; the first word is the field of ``ImagePipeline``."""


@dataclass(frozen=True)
class Drawn:
    """A pipeline with the draws of one step of an attack."""

    pipeline: ImagePipeline
    seed: int
    step: int

    def apply(self, images: Images, views: Iterable[int]) -> Images:
        """Images of the ``views``; the draws depend on seed, step and view alone, so that a resumed attack is equal."""
        return self.pipeline.apply(images, [_generator(self.seed, self.step, view) for view in views])


def _generator(*numbers: int) -> torch.Generator:
    return seeded_generator(",".join(map(str, numbers)).encode())


@dataclass(frozen=True)
class _Draw:
    """The operations of one image with their strengths, and the generator of its noise."""

    strengths: Mapping[str, float]
    generator: torch.Generator


def _resampled(images: Images, drawn: Sequence[_Draw]) -> Images:
    """Images placed, reduced and enlarged, and blurred."""
    axes = [_axes(draw.strengths, *images.shape[2:]) for draw in drawn]
    rows, columns = (torch.stack(each)[:, None] for each in zip(*axes, strict=True))
    return resampled(images, rows, columns)


def _axes(strengths: Mapping[str, float], height: int, width: int) -> tuple[Axis, Axis]:
    """The matrices of one image's rows and columns."""
    stages: list[tuple[Axis, Axis]] = []
    if strengths.keys() & _PLACED:
        zoom, mirrored = strengths.get("zoom", 1.0), "mirrored" in strengths
        down, right = (strengths.get(f"shift of {axis}", 0.0) for axis in ("rows", "columns"))
        stages.append((placed(height, zoom=zoom, shift=down), placed(width, zoom=zoom, shift=right, mirrored=mirrored)))
    if "resize" in strengths:
        small, narrow = (max(1, round(strengths["resize"] * side)) for side in (height, width))
        stages.append((resized(height, small), resized(width, narrow)))
    if "blur" in strengths:
        stages.append((blurred(height, strengths["blur"]), blurred(width, strengths["blur"])))
    rows, columns = (reduce(lambda done, then: then @ done, axis) for axis in zip(*stages, strict=True))
    return rows, columns


def _strength(drawn: Sequence[_Draw], name: str, images: Images) -> Float[Tensor, "n 1 1 1"]:
    return torch.tensor([draw.strengths[name] for draw in drawn]).to(images)[:, None, None, None]


def _power(levels: Images, exponent: Tensor | float) -> Images:
    """Powers of levels, at least ``DARKEST``; ``torch.pow`` with its gradient takes twice as long."""
    return (levels.clamp(DARKEST, 1).log() * exponent).exp()


def _with_gamma(images: Images, drawn: Sequence[_Draw]) -> Images:
    return _power(images, _strength(drawn, "gamma", images))


def _with_gain(images: Images, drawn: Sequence[_Draw]) -> Images:
    return (images * _strength(drawn, "gain", images)).clamp(0, 1)


def _filmic(images: Images, drawn: Sequence[_Draw]) -> Images:
    light = _power(images, 2.2)
    curve = light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)
    return torch.lerp(images, _power(curve, 1 / 2.2), _strength(drawn, "filmic", images))


def _noisy(images: Images, drawn: Sequence[_Draw]) -> Images:
    noise = in_threads(lambda draw: torch.rand(images.shape[1:], generator=draw.generator), drawn)
    return images + _strength(drawn, "noise", images) * (2 * torch.stack(noise) - 1).to(images)


def _packed(images: Images, drawn: Sequence[_Draw]) -> Images:
    """Images through JPEG; the gradient is that of the unchanged images."""

    def through_jpeg(image: Image8, draw: _Draw) -> Image8:
        packed = io.BytesIO()
        PIL.Image.fromarray(image).save(packed, "JPEG", quality=round(draw.strengths["jpeg"]))
        return np.array(PIL.Image.open(packed))

    plain = images.detach()
    read = torch.from_numpy(np.stack(in_threads(through_jpeg, _levels(plain), drawn))).permute(0, 3, 1, 2)
    return images + (read.to(images.device).to(images) / 255 - plain)


def _levels(images: Images) -> Image8:
    found: Image8 = (255 * images.detach().clamp(0, 1)).round().byte().permute(0, 2, 3, 1).contiguous().cpu().numpy()
    return found


_PLACED: Final = {"zoom", "shift of rows", "shift of columns", "mirrored"}

_STAGES: Final = (
    ({*_PLACED, "resize", "blur"}, _resampled),
    ({"gamma"}, _with_gamma),
    ({"gain"}, _with_gain),
    ({"filmic"}, _filmic),
    ({"noise"}, _noisy),
    ({"jpeg"}, _packed),
)
"""Names of operations and what they do to the images that take any of them, in their order."""


PIPELINES: Final[Mapping[str, ImagePipeline]] = {
    "robust": ImagePipeline(
        spared=0.25, often=0.6, resize=(0.4, 1), gamma=(0.7, 1.45), gain=(0.85, 1.15), noise=(0, 0.04), jpeg=(30, 90)
    ),
    "transfer": ImagePipeline(
        often=0.75,
        mirrored=0.5,
        zoom=(0.75, 1.33),
        shift=(-0.1, 0.1),
        resize=(0.4, 1),
        gamma=(0.7, 1.45),
        gain=(0.85, 1.15),
        noise=(0, 0.1),
        jpeg=(30, 90),
    ),
}
"""Pipelines of an attack by name."""

SUITE: Final[Mapping[str, ImagePipeline]] = {
    "half size": ImagePipeline(resize=(0.5, 0.5)),
    "three quarters": ImagePipeline(resize=(0.75, 0.75)),
    "JPEG 75": ImagePipeline(jpeg=(75, 75)),
    "JPEG 30": ImagePipeline(jpeg=(30, 30)),
    "gamma 0.8": ImagePipeline(gamma=(0.8, 0.8)),
    "gamma 1.25": ImagePipeline(gamma=(1.25, 1.25)),
    "filmic": ImagePipeline(filmic=(1, 1)),
    "blur 1": ImagePipeline(blur=(1, 1)),
    "crop": ImagePipeline(zoom=(1.15, 1.15)),
    "grain": ImagePipeline(noise=(0.05, 0.05)),
}
"""What each result is judged through besides the images themselves."""
