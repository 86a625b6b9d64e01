"""Random chains of operations on images, differentiable, and drawn anew for each image.

The expectation over them makes paint that survives them (Athalye et al., 2018, expectation over transformation). What
is linear in the image is applied first: rendering and resampling are linear in light, an encoder and a tone curve see
what is left.
"""

import io
from collections.abc import Iterable
from dataclasses import dataclass
from hashlib import blake2b
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from trompe_server.image_pipelines.resampling import blurred, placed, resampled, resized

__all__ = ["Drawn", "ImagePipeline"]

Range = tuple[float, float]
Images = Float[Tensor, "n 3 H W"]
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

    def apply(self, images: Images, luck: "list[torch.Generator]") -> Images:
        """sRGB images in [0, 1], each through its own draws from its generator of ``luck``. Differentiable in them."""
        drawn = [_Draws(self, each) for each in luck]
        if any((self.zoom, self.shift, self.resize, self.blur)):
            axes = [draws.axes(*images.shape[2:]) for draws in drawn]
            images = resampled(images, *(list(each) for each in zip(*axes, strict=True)))
        if any((self.gamma, self.gain, self.filmic)):
            images = torch.stack([draws.toned(image) for draws, image in zip(drawn, images, strict=True)])
        if self.noise:
            images = images + torch.stack([draws.grain(images[0]) for draws in drawn]).to(images)
        if self.jpeg:
            images = images + torch.stack(
                [draws.compressed(image) for draws, image in zip(drawn, images.detach(), strict=True)]
            )
        return images

    def shown(self, images: Image8) -> Image8:
        """8-bit images (N, H, W, 3) through the pipeline; an image's draws depend on its number only."""
        batch = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255
        out = np.empty_like(images)
        for number, image in enumerate(batch):
            (changed,) = self.apply(image[None], [luck_of(number)])
            out[number] = _levels(changed)
        return out


@dataclass(frozen=True)
class Drawn:
    """A pipeline with the draws of one step of an attack."""

    pipeline: ImagePipeline
    seed: int
    step: int

    def apply(self, images: Images, views: Iterable[int]) -> Images:
        """Images of the ``views``; the draws depend on seed, step and view alone, so that a resumed attack is equal."""
        return self.pipeline.apply(images, [luck_of(self.seed, self.step, view) for view in views])


def luck_of(*numbers: int) -> torch.Generator:
    """A generator determined by ``numbers``."""
    digest = blake2b(",".join(map(str, numbers)).encode(), digest_size=8).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little") >> 1)


class _Draws:
    """The draws of one image. Each operation takes its numbers whether it is used or not."""

    def __init__(self, pipeline: ImagePipeline, luck: torch.Generator) -> None:
        self._luck, self._pipeline = luck, pipeline
        self._drawn: list[list[float]] = torch.rand(12, 2, generator=luck).tolist()
        self._spared = self._drawn[11][0] < pipeline.spared

    def _strength(self, number: int, between: Range | None) -> float | None:
        used, share = self._drawn[number]
        if between is None or self._spared or used >= self._pipeline.often:
            return None
        low, high = between
        return low + (high - low) * share

    def axes(self, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Matrices of rows and columns."""
        of = self._pipeline
        zoom = self._strength(0, of.zoom) or 1.0
        shifts = [self._strength(number, of.shift) or 0.0 for number in (1, 2)]
        mirrored = self._drawn[3][0] < of.mirrored and not self._spared
        size, sigma = self._strength(4, of.resize), self._strength(5, of.blur)
        rows, columns = (
            placed(height, zoom=zoom, shift=shifts[0]),
            placed(width, zoom=zoom, shift=shifts[1], mirrored=mirrored),
        )
        if size is not None and size < 1:
            rows = resized(height, max(1, round(size * height))) @ rows
            columns = resized(width, max(1, round(size * width))) @ columns
        if sigma is not None:
            rows, columns = blurred(height, sigma) @ rows, blurred(width, sigma) @ columns
        return rows, columns

    def toned(self, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
        """The image through its tone curve."""
        of = self._pipeline
        gamma, gain = self._strength(6, of.gamma), self._strength(7, of.gain)
        filmic = self._strength(8, of.filmic)
        if gamma is not None:
            image = image.clamp(DARKEST, 1) ** gamma
        if gain is not None:
            image = (image * gain).clamp(0, 1)
        if filmic is not None:
            image = torch.lerp(image, _filmic(image), filmic)
        return image

    def grain(self, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
        """Noise."""
        most = self._strength(9, self._pipeline.noise) or 0.0
        return most * (2 * torch.rand(image.shape, generator=self._luck) - 1)

    def compressed(self, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
        """The change by JPEG."""
        quality = self._strength(10, self._pipeline.jpeg)
        if quality is None:
            return torch.zeros_like(image)
        packed = io.BytesIO()
        Image.fromarray(_levels(image)).save(packed, "JPEG", quality=round(quality))
        read = torch.from_numpy(np.array(Image.open(packed)))
        return read.permute(2, 0, 1).to(image) / 255 - image


def _filmic(image: Tensor) -> Tensor:
    light = image.clamp(DARKEST, 1) ** 2.2
    curve = light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)
    return curve.clamp(DARKEST, 1) ** (1 / 2.2)


def _levels(image: Float[Tensor, "3 H W"]) -> Image8:
    found: Image8 = (255 * image.detach().cpu().clamp(0, 1)).round().byte().permute(1, 2, 0).contiguous().numpy()
    return found
