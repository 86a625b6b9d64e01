"""Accelerate an exported network without changing its function.

Batch norm is folded into the preceding convolution. Convolutions run in the ``channels_last`` memory format, except on
a graphics card, which plans that for seconds in full precision. Where no gradient is asked for, a convolution and its
activation are one operator of oneDNN on a CPU, as in ``torch.compile``'s own networks. The results are measured: a
network with different logits stays unchanged.
"""

import copy
import operator
import warnings
from collections.abc import Callable, Mapping
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor, fx, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

TOLERANCE: Final = 1e-4
"""Largest allowed difference of a logit, relative to the largest logit."""
CONVOLUTION: Final = torch.ops.aten.conv2d.default
CONVOLUTION_DEFAULTS: Final[tuple[Any, ...]] = (None, None, None, [1, 1], [0, 0], [1, 1], 1)
"""Image, weight, bias, stride, padding, dilation, groups."""
BATCH_NORM: Final = torch.ops.aten.batch_norm.default
ACTIVATIONS: Final[Mapping[Any, str]] = {
    torch.ops.aten.hardtanh.default: "hardtanh",
    torch.ops.aten.relu.default: "relu",
    torch.ops.aten.hardswish.default: "hardswish",
}
"""Activations by their names in oneDNN. Their in-place forms are not in exported networks."""


class Formatted(nn.Module):
    """A network with weights and images in one memory format, for images in any format. ``scoring``: the same function
    without a gradient."""

    def __init__(
        self, network: fx.GraphModule, memory_format: torch.memory_format, scoring: fx.GraphModule | None = None
    ) -> None:
        super().__init__()
        self.network = network.to(memory_format=memory_format)  # type: ignore[call-overload]
        self.scoring = scoring
        self.memory_format = memory_format

    def forward(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1]."""
        network = self.network if self.scoring is None or torch.is_grad_enabled() else self.scoring
        logits: Tensor = network(images.contiguous(memory_format=self.memory_format))
        return logits


def accelerate(network: fx.GraphModule, sample: Float[Tensor, "n 3 H W"]) -> Formatted:
    """The network folded, in the faster memory format, or unchanged if that moves a logit of ``sample`` too far."""
    original = Formatted(network, torch.contiguous_format)
    memory_format = torch.contiguous_format if sample.is_cuda else torch.channels_last
    folded = _measured(lambda: Formatted(fold_batch_norm(_copy(network)), memory_format), original, sample)
    if sample.device.type != "cpu" or not torch.backends.mkldnn.is_available() or folded is original:  # type: ignore[no-untyped-call]
        return folded
    return _measured(lambda: Formatted(folded.network, torch.channels_last, _fused(folded.network)), folded, sample)


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
    """A copy whose convolutions apply the activations that follow them."""
    fused = _copy(network)
    for node in list(fused.graph.nodes):
        if node.target is not CONVOLUTION or node.kwargs:
            continue
        following = next(iter(node.users))
        named = ACTIVATIONS.get(following.target) if len(node.users) == 1 else None
        given: tuple[Any, ...] = node.args
        image, weight, bias, stride, padding, dilation, groups = given + CONVOLUTION_DEFAULTS[len(given) :]
        scalars = list(following.args[1:]) if named else []
        with fused.graph.inserting_before(node):
            new = fused.graph.call_function(
                torch.ops.mkldnn._convolution_pointwise.default,
                (image, weight, bias, padding, stride, dilation, groups, named or "none", scalars, ""),
            )
        (following if named else node).replace_all_uses_with(new)
    fused.graph.eliminate_dead_code()
    fused.recompile()
    return fused


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
    parameters = [*source.args[1:3], *norm.args[1:5]]
    return not training and all(p is None or (isinstance(p, fx.Node) and p.op == "get_attr") for p in parameters)


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
