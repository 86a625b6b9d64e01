"""Reconstruction filters: how a path tracer averages the samples around a pixel."""

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import conv2d, conv_transpose2d

KernelName = Literal["box", "tent", "gaussian", "blackman-harris"]

_BLACKMAN_HARRIS: Final = (0.35875, -0.48829, 0.14128, -0.01168)


def kernel_of(name: KernelName, width: float, parts: int) -> Float[Tensor, " taps"]:
    """Weights of sub-pixels along one axis, symmetric about the pixel, with the sum 1.

    width: pixels in which the kernel is not zero; a Gaussian's is four times its deviation on each side. parts:
    sub-pixels of a pixel.
    """
    reach = math.ceil((width - 1) / 2 * parts + parts / 2 - 1e-6)  # sub-pixels on each side of the pixel's centre
    at = (torch.arange(-reach, reach, dtype=torch.float64) + 0.5) / parts / width  # in [-1/2, 1/2] within the kernel
    if name == "box":
        weights = ((0.5 + 0.5 / parts / width - at.abs()) * parts * width).clamp(0, 1)
    elif name == "tent":
        weights = (1 - 2 * at.abs()).clamp(min=0)
    elif name == "gaussian":
        weights = ((-32 * at.square()).exp() - math.exp(-8)).clamp(min=0)
    else:
        weights = sum(a * (2 * math.pi * k * (at + 0.5)).cos() for k, a in enumerate(_BLACKMAN_HARRIS))  # type: ignore[assignment]
        weights = weights.clamp(min=0) * (at.abs() < 0.5)
    return (weights / weights.sum()).float()


@dataclass(frozen=True)
class PixelFilter:
    """Weighted sums of sub-pixels, for a batch of views, and the transpose.

    sub_pixel: (view * parts H + row) * parts W + column of each sub-pixel that shows the object. pixel: likewise of
    each pixel. shape: views, H, W. kernel: along each axis; parts: sub-pixels along a pixel's side.
    """

    sub_pixel: Int[Tensor, " sub_pixels"]
    pixel: Int[Tensor, " pixels"]
    shape: tuple[int, int, int]
    kernel: Float[Tensor, " taps"]
    parts: int

    @classmethod
    def of(
        cls,
        sub_pixel: Int[Tensor, " sub_pixels"],
        coverage: Float[Tensor, "sub_pixels 1"],
        shape: tuple[int, int, int],
        kernel: Float[Tensor, " taps"],
        parts: int,
    ) -> tuple["PixelFilter", Float[Tensor, "pixels 1"]]:
        """The filter onto all pixels that show at least ``LEAST`` of the object, and their coverage."""
        everywhere = torch.arange(math.prod(shape), device=sub_pixel.device)
        whole = cls(sub_pixel, everywhere, shape, kernel.to(sub_pixel.device), parts)
        covered = whole.forward(coverage)
        pixel = (covered[:, 0] >= LEAST).nonzero()[:, 0]
        return replace(whole, pixel=pixel), covered[pixel]

    def forward(self, values: Float[Tensor, "sub_pixels c"]) -> Float[Tensor, "pixels c"]:
        """Weighted sums of the sub-pixels around each pixel."""
        views, height, width = self.shape
        channels = values.shape[1]
        dense = values.new_zeros(views * height * width * self.parts**2, channels)
        dense = dense.index_copy_(0, self.sub_pixel, values).view(
            views, height * self.parts, width * self.parts, channels
        )
        planes = dense.permute(0, 3, 1, 2).reshape(views * channels, 1, *dense.shape[1:3])
        (tall, wide), pad = self._kernels, self._pad
        planes = conv2d(planes, wide, stride=(1, self.parts), padding=(0, pad))
        planes = conv2d(planes, tall, stride=(self.parts, 1), padding=(pad, 0))
        return planes.view(views, channels, -1).transpose(1, 2).reshape(-1, channels).index_select(0, self.pixel)

    def transpose(self, values: Float[Tensor, "pixels c"]) -> Float[Tensor, "sub_pixels c"]:
        """The transpose of ``forward``."""
        views, height, width = self.shape
        channels = values.shape[1]
        dense = values.new_zeros(views * height * width, channels).index_copy_(0, self.pixel, values)
        planes = dense.view(views, -1, channels).transpose(1, 2).reshape(views * channels, 1, height, width)
        (tall, wide), pad = self._kernels, self._pad
        planes = conv_transpose2d(planes, tall, stride=(self.parts, 1), padding=(pad, 0))
        planes = conv_transpose2d(planes, wide, stride=(1, self.parts), padding=(0, pad))
        return planes.view(views, channels, -1).transpose(1, 2).reshape(-1, channels).index_select(0, self.sub_pixel)

    @property
    def _kernels(self) -> tuple[Tensor, Tensor]:
        return self.kernel[None, None, :, None], self.kernel[None, None, None, :]

    @property
    def _pad(self) -> int:
        return (len(self.kernel) - self.parts) // 2

    @property
    def nbytes(self) -> int:
        """Memory in bytes."""
        return self.sub_pixel.nbytes + self.pixel.nbytes


LEAST: Final = 0.02
"""Smallest share of a pixel that counts as showing the object; images of 8 bits tell no less."""
