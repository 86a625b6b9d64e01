"""Accelerate an exported network without changing its function.

Batch norm is folded into the preceding convolution. Convolutions run in the ``channels_last`` memory format, except on
a graphics card, which plans that for seconds in full precision. On a CPU a convolution pads its images itself and
applies the activation after it (``convolution``). The results are measured: a network with different logits stays
unchanged.
"""

import copy
import operator
import warnings
from collections.abc import Callable, Mapping
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor, fx, nn
from torch.nn import functional as F
from torch.nn.utils.fusion import fuse_conv_bn_weights

from trompe_server.classifiers.convolution import ACTIVATIONS, convolved

TOLERANCE: Final = 1e-4
"""Largest allowed difference of a logit, relative to the largest logit."""
CONVOLUTION: Final = torch.ops.aten.conv2d.default
CONVOLUTION_DEFAULTS: Final[tuple[Any, ...]] = (None, None, None, [1, 1], [0, 0], [1, 1], 1)
"""Image, weight, bias, stride, padding, dilation, groups."""
BATCH_NORM: Final = torch.ops.aten.batch_norm.default
NAMES: Final[Mapping[Any, str]] = {activation: name for name, activation in ACTIVATIONS.items()}
PAD: Final = torch.ops.aten.pad.default
FEW: Final = 4
"""Channels that each result of a convolution reads, up to which a larger kernel is cheaper than padded images."""


class Formatted(nn.Module):
    """A network with weights and images in one memory format, for images in any format."""

    def __init__(self, network: nn.Module, memory_format: torch.memory_format) -> None:
        super().__init__()
        self.network = network.to(memory_format=memory_format)  # type: ignore[call-overload]
        self.memory_format = memory_format

    def forward(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1]."""
        logits: Tensor = self.network(images.contiguous(memory_format=self.memory_format))
        return logits


def accelerate(network: fx.GraphModule, sample: Float[Tensor, "n 3 H W"]) -> Formatted:
    """The network folded, in the faster memory format, or unchanged if that moves a logit of ``sample`` too far."""
    original = Formatted(network, torch.contiguous_format)
    faster = fastest_format(sample.device)
    folded = _measured(lambda: Formatted(fold_batch_norm(_copy(network)), faster), original, sample)
    if sample.device.type != "cpu" or folded is original:
        return folded
    return _measured(lambda: Formatted(_fused(_copy(folded.network)), faster), folded, sample)


def fastest_format(device: torch.device) -> torch.memory_format:
    """Memory format of the images and weights of convolutional networks on ``device``."""
    return torch.channels_last if device.type == "cpu" else torch.contiguous_format


def _measured(make: Callable[[], Formatted], known: Formatted, sample: Float[Tensor, "n 3 H W"]) -> Formatted:
    """The new network, or the ``known`` one if the new one moves a logit of ``sample`` too far."""
    with torch.no_grad():
        before = known(sample)
        try:
            new = make()
            difference = (new(sample) - before).abs().max()
        except RuntimeError:  # e.g. a view that requires the exported memory format
            return known
    return new if difference <= TOLERANCE * before.abs().max() else known


def _fused(network: fx.GraphModule) -> fx.GraphModule:
    """Let convolutions pad their images and apply the activations that follow, in place; return ``network``."""
    for node in list(network.graph.nodes):
        if node.target is not CONVOLUTION or node.kwargs:
            continue
        _fuse_padding(network, node)
        following = next(iter(node.users))
        if len(node.users) > 1 or following.target not in NAMES:
            continue
        images, weight, bias, *shape = _arguments(node)
        if not (_is_constant(weight) and _is_constant(bias)):
            continue
        named = NAMES[following.target], following.args[1:]
        with network.graph.inserting_before(node):
            fused = network.graph.call_function(convolved, (images, weight, bias, tuple(shape), *named))
        following.replace_all_uses_with(fused)
    network.graph.eliminate_dead_code()
    network.recompile()
    return network


def _arguments(convolution: fx.Node) -> tuple[Any, ...]:
    """Image, weight, bias, stride, padding, dilation, groups."""
    given: tuple[Any, ...] = convolution.args
    return given + CONVOLUTION_DEFAULTS[len(given) :]


def _fuse_padding(network: fx.GraphModule, convolution: fx.Node) -> None:
    """Pad by zeros within a convolution of few weights: equally on both sides, with a kernel enlarged by zeros.

    Networks of TensorFlow pad one side more. An operator of its own copies the images twice.
    """
    padded, kernel, bias, stride, padding, dilation, groups = _arguments(convolution)
    by_zeros = padded.target is PAD and len(padded.args) == 2 and not padded.kwargs
    if not by_zeros or kernel.op != "get_attr" or [*padding, *dilation] != [0, 0, 1, 1]:
        return
    (images, sides), weight = padded.args, _value(network, kernel)
    if weight is None or weight.shape[1] > FEW or len(sides) != 4 or min(sides) < 0:
        return
    left, right, top, bottom = sides
    wide, high = max(left, right), max(top, bottom)
    enlarged = F.pad(weight, (wide - left, wide - right, high - top, high - bottom))
    name = f"{convolution.name}_enlarged_weight"
    network.register_parameter(name, nn.Parameter(enlarged, requires_grad=False))
    with network.graph.inserting_before(convolution):
        node = network.graph.get_attr(name)
    convolution.args = (images, node, bias, stride, [high, wide], dilation, groups)


def _copy(network: fx.GraphModule) -> fx.GraphModule:
    with warnings.catch_warnings():  # copying a graph warns about torch's own deprecated class
        warnings.simplefilter("ignore", FutureWarning)
        return copy.deepcopy(network)


def fold_batch_norm(network: fx.GraphModule) -> fx.GraphModule:
    """Fold every batch norm directly after a convolution into it, in place; return ``network``."""
    for node in list(network.graph.nodes):
        if node.target is BATCH_NORM and _foldable(node):
            _fold(network, node)
    network.graph.eliminate_dead_code()
    network.recompile()
    return network


def _foldable(norm: fx.Node) -> bool:
    """Whether the batch norm uses running statistics and is the only reader of a convolution with constant weights."""
    source = norm.args[0]
    if not isinstance(source, fx.Node) or source.target is not CONVOLUTION or len(source.users) != 1:
        return False
    training = norm.args[5]
    return not training and all(map(_is_constant, [*source.args[1:3], *norm.args[1:5]]))


def _is_constant(arg: Any) -> bool:
    """Whether an argument is a parameter of the network, or none at all."""
    return arg is None or (isinstance(arg, fx.Node) and arg.op == "get_attr")


def _fold(network: fx.GraphModule, norm: fx.Node) -> None:
    convolution = norm.all_input_nodes[0]
    weight, bias = (_value(network, arg) for arg in (*convolution.args[1:3], None)[:2])
    scale, shift, mean, variance = (_value(network, arg) for arg in norm.args[1:5])
    folded = fuse_conv_bn_weights(weight, bias, mean, variance, norm.args[7], scale, shift)  # type: ignore[arg-type]
    nodes = []
    for kind, value in zip(("weight", "bias"), folded, strict=True):
        name = f"{convolution.name}_folded_{kind}"
        network.register_parameter(name, value)
        with network.graph.inserting_before(convolution):
            nodes.append(network.graph.get_attr(name))
    convolution.args = (convolution.args[0], *nodes, *convolution.args[3:])
    norm.replace_all_uses_with(convolution)


def _value(network: fx.GraphModule, arg: Any) -> Tensor | None:
    """The tensor of a ``get_attr`` node."""
    value: Tensor | None = None if arg is None else operator.attrgetter(arg.target)(network)
    return value
