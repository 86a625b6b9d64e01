"""A convolution and the activation after it as one operator of oneDNN on a CPU, with the gradient of its images.

The memory decides how fast a small network runs on a CPU: as one operator the two write their images once.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

Images = Float[Tensor, "n c H W"]
Shape = tuple[Sequence[int], Sequence[int], Sequence[int], int]
"""Stride, padding, dilation, groups."""

aten = torch.ops.aten

ONEDNN: Final[bool] = torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]

ACTIVATIONS: Final[Mapping[str, Any]] = {
    "hardtanh": aten.hardtanh.default,
    "relu": aten.relu.default,
    "hardswish": aten.hardswish.default,
}
"""Activations by their names in oneDNN. Their in-place forms are not in exported networks."""
GRADIENTS: Final[Mapping[str, Any]] = {
    "hardtanh": aten.hardtanh_backward,
    "relu": lambda gradient, result: aten.threshold_backward(gradient, result, 0),
}
"""Gradients, from that of the result and the result, of those for which the result tells enough."""


def convolved(
    images: Images, weight: Tensor, bias: Tensor | None, shape: Shape, activation: str, limits: Sequence[float] = ()
) -> Images:
    """``activation`` (with the ``limits`` of a ``hardtanh``) of a convolution of ``images`` with constant weights."""
    differentiable = torch.is_grad_enabled() and images.requires_grad
    if images.device.type != "cpu" or not ONEDNN or (differentiable and activation not in GRADIENTS):
        result: Tensor = ACTIVATIONS[activation](F.conv2d(images, weight, bias, *shape), *limits)
        return result
    run: Callable[..., Images] = _Convolved.apply if differentiable else _pointwise
    return run(images, weight, bias, shape, activation, limits)


def _pointwise(
    images: Images, weight: Tensor, bias: Tensor | None, shape: Shape, activation: str, limits: Sequence[float]
) -> Images:
    stride, padding, dilation, groups = shape
    run = torch.ops.mkldnn._convolution_pointwise
    result: Tensor = run(images, weight, bias, padding, stride, dilation, groups, activation, limits, "")
    return result


class _Convolved(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, images: Images, weight: Tensor, *others: Any) -> Images:
        result = _pointwise(images, weight, *others)
        ctx.save_for_backward(images, weight, result)
        _, *ctx.others = others
        return result

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        images, weight, result = ctx.saved_tensors
        (stride, padding, dilation, groups), activation, limits = ctx.others
        gradient = GRADIENTS[activation](gradients[0], result, *limits)
        shape = stride, padding, dilation, False, [0, 0], groups
        wanted = [True, False, False]  # of images, weight and bias
        found, *_ = aten.convolution_backward(gradient, images, weight, None, *shape, wanted)
        return found, None, None, None, None, None
