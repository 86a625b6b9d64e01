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

Range = tuple[float, float]
Images = Float[Tensor, "n 3 H W"]
Image = Float[Tensor, "3 H W"]
Image8 = NDArray[np.uint8]

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
        drawn = [self._strengths(each) for each in generators]
        if not any(drawn):
            return images
        return torch.stack([_through(*each) for each in zip(images, drawn, generators, strict=True)])

    def shown(self, images: Image8) -> Image8:
        """8-bit images (N, H, W, 3) through the pipeline; an image's draws depend on its number only."""
        batch = fit_images(images, images.shape[1:3])
        changed = (self.apply(image[None], [_generator(number)]) for number, image in enumerate(batch))
        return np.stack([_levels(image) for (image,) in changed]) if len(images) else images

    def _strengths(self, generator: torch.Generator) -> Mapping[str, float]:
        """Operations of one image with their strengths. Each takes its numbers whether it is used or not."""
        *drawn, (spared, _) = torch.rand(len(_OPERATIONS) + 1, 2, generator=generator).tolist()
        if spared < self.spared:
            return {}
        found = {}
        for (name, field), (used, share) in zip(_OPERATIONS.items(), drawn, strict=True):
            chance, between = (self.mirrored, (1, 1)) if name == "mirrored" else (self.often, getattr(self, field))
            if between and used < chance:
                low, high = between
                found[name] = low + (high - low) * share
        return found


_OPERATIONS: Final = {
    "zoom": "zoom",
    "shift of rows": "shift",
    "shift of columns": "shift",
    "mirrored": "mirrored",
    "resize": "resize",
    "blur": "blur",
    "gamma": "gamma",
    "gain": "gain",
    "filmic": "filmic",
    "noise": "noise",
    "jpeg": "jpeg",
}
"""Operations in their order, each with its field of ``ImagePipeline``."""


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


def _through(image: Image, strengths: Mapping[str, float], generator: torch.Generator) -> Image:
    image = _toned(_resampled(image, strengths), strengths)
    if "noise" in strengths:
        image = image + strengths["noise"] * (2 * torch.rand(image.shape, generator=generator) - 1).to(image)
    return image + _change_by_jpeg(image.detach(), strengths["jpeg"]) if "jpeg" in strengths else image


def _resampled(image: Image, strengths: Mapping[str, float]) -> Image:
    """The image placed, reduced and enlarged, and blurred."""
    height, width = sides = image.shape[1:]
    stages: list[tuple[Axis, ...]] = []
    if strengths.keys() & {"zoom", "shift of rows", "shift of columns", "mirrored"}:
        zoom, mirrored = strengths.get("zoom", 1.0), "mirrored" in strengths
        down, right = (strengths.get(f"shift of {axis}", 0.0) for axis in ("rows", "columns"))
        stages.append((placed(height, zoom=zoom, shift=down), placed(width, zoom=zoom, shift=right, mirrored=mirrored)))
    if strengths.get("resize", 1) < 1:
        factor = strengths["resize"]
        stages.append(tuple(resized(side, max(1, round(factor * side))) for side in sides))
    if "blur" in strengths:
        stages.append(tuple(blurred(side, strengths["blur"]) for side in sides))
    if not stages:
        return image
    rows, columns = (reduce(lambda done, then: then @ done, axis) for axis in zip(*stages, strict=True))
    return resampled(image, rows, columns)


def _toned(image: Image, strengths: Mapping[str, float]) -> Image:
    if "gamma" in strengths:
        image = image.clamp(DARKEST, 1) ** strengths["gamma"]
    if "gain" in strengths:
        image = (image * strengths["gain"]).clamp(0, 1)
    if "filmic" in strengths:
        image = torch.lerp(image, _filmic(image), strengths["filmic"])
    return image


def _change_by_jpeg(image: Image, quality: float) -> Image:
    packed = io.BytesIO()
    PIL.Image.fromarray(_levels(image)).save(packed, "JPEG", quality=round(quality))
    read = torch.from_numpy(np.array(PIL.Image.open(packed)))
    return read.permute(2, 0, 1).to(image) / 255 - image


def _filmic(image: Tensor) -> Tensor:
    light = image.clamp(DARKEST, 1) ** 2.2
    curve = light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)
    return curve.clamp(DARKEST, 1) ** (1 / 2.2)


def _levels(image: Image) -> Image8:
    found: Image8 = (255 * image.detach().cpu().clamp(0, 1)).round().byte().permute(1, 2, 0).contiguous().numpy()
    return found


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
