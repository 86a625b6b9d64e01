"""Budget of the change: an L-infinity ball around the original texture, within valid colours.

A perceptual budget has a bound of its own for each texel, never above epsilon, and allows less change of hue than of
lightness: people notice a tint sooner than a shade of the same size. It spends visible change where it pays: texels
with little gradient for what views show of them go back to where they were.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from trompe_server.surrogate import tensor_of
from trompe_server.surrogate.blocks import common_change, repeated, rooms
from trompe_shared.api import levels_within
from trompe_shared.errors import SpecError
from trompe_shared.object3d import Object3D

Bound = Float[Tensor, "*texels 1"]
"""Largest change of each texel's channels, in whole 8-bit levels."""

Change = Float[Tensor, "*texels 3"]

HUE: Final = 1.0
"""Largest difference between the changes of a texel's channels, as a share of its bound."""
MOVING: Final = 0.3
"""Share of what views show of the moving texels that changes, in a perceptual budget."""


@dataclass(frozen=True)
class Budget:
    """Bounds in sRGB units of [0, 1].

    epsilon: largest change of a texel's channel. alpha: size of one step. epsilon_view: largest change of a pixel of
    the surrogate's images (the paper's view constraint), if any. perceptual: bound each texel by ``perceptual_bounds``.
    Raises ``SpecError`` unless 0 < alpha <= epsilon <= 1, epsilon is at least 1/255, and 0 < epsilon_view <= 1.
    """

    epsilon: float
    alpha: float
    epsilon_view: float | None = None
    perceptual: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.alpha <= self.epsilon <= 1:
            raise SpecError(
                "epsilon and alpha must satisfy 0 < alpha <= epsilon <= 1, "
                f"got alpha={self.alpha}, epsilon={self.epsilon}."
            )
        if self.levels < 1:
            raise SpecError(
                f"epsilon must be at least 1/255, one level of an 8-bit texture; got {self.epsilon:g}: "
                "use 0.004 or more."
            )
        if self.epsilon_view is not None and not 0 < self.epsilon_view <= 1:
            raise SpecError(f"epsilon_view must be in (0, 1], got {self.epsilon_view}; omit it for no bound.")

    @property
    def levels(self) -> int:
        """The largest change of an 8-bit channel."""
        return levels_within(self.epsilon)

    def box(self, texture: Float[Tensor, "H W 3"], count: int = 0, *, bound: Bound | None = None) -> "Box":
        """The allowed changes of the texels of ``texture``, or of the means of its blocks of side ``2 ** count``.

        bound: of each block, at most epsilon.
        """
        whole = texture.new_full((texture.shape[0] >> count, texture.shape[1] >> count, 1), self.epsilon)
        down, up = rooms(texture, whole if bound is None else bound, count)
        return Box(self, -down, up, bound)

    def quantise(self, delta: Float[Tensor, "h w 3"], texture: UInt8[Tensor, "H W 3"]) -> UInt8[Tensor, "H W 3"]:
        """The 8-bit texture to save: ``texture`` changed by ``delta``, rounded, by at most epsilon.

        delta: of each texel, or of the mean of each block of texels (``blocks``).
        """
        levels = (common_change(delta, texture) * 255).round().clamp(-self.levels, self.levels).to(torch.int16)
        return repeated(levels, texture.shape).add(texture).clamp_(0, 255).to(torch.uint8)

    def repaint(self, obj: Object3D, deltas: Mapping[str, Float[Tensor, "h w 3"]]) -> Object3D:
        """``obj`` with textures changed by ``deltas``, as for ``quantise``."""
        return obj.with_textures(
            {
                name: self.quantise(delta, tensor_of(obj.textures[name]).to(delta.device)).cpu().numpy()
                for name, delta in deltas.items()
            }
        )


@dataclass(frozen=True)
class Box:
    """The allowed changes of texels or blocks, from ``low`` to ``high``, with zero among them.

    bound: of a perceptual budget: channels are at most ``HUE`` of it apart, and steps shrink as it does. weight: of a
    perceptual budget: of each texel or block in the pixels of all views.
    """

    budget: Budget
    low: Change
    high: Change
    bound: Bound | None = None
    weight: Float[Tensor, "*texels 1"] | None = None

    def project(self, delta: Change) -> Change:
        """The nearest allowed change."""
        delta = torch.clamp(delta, self.low, self.high)
        if self.bound is None:
            return delta
        reach = HUE / 2 * self.bound
        middle = (delta.amax(-1, keepdim=True) + delta.amin(-1, keepdim=True)) / 2
        middle = middle.clamp(self.low.amax(-1, keepdim=True) - reach, self.high.amin(-1, keepdim=True) + reach)
        return torch.clamp(torch.clamp(delta, middle - reach, middle + reach), self.low, self.high)

    def ascend(self, delta: Change, direction: Change, factor: float = 1.0) -> Change:
        """``factor`` times alpha along the sign of ``direction``, projected; texels with zero stay."""
        step = direction.sign().mul_(factor * self.budget.alpha)
        if self.bound is not None:
            step.mul_(self.bound / self.budget.epsilon)
        if self.weight is not None:
            back = torch.minimum(delta.abs(), step.abs()).copysign(-delta)
            step = torch.where(_strongest(direction, self.weight), step, back)
        return self.project(step.add_(delta))


def _strongest(direction: Change, weight: Float[Tensor, "*texels 1"]) -> Bool[Tensor, "*texels 1"]:
    """The texels with the most gradient for their weight, up to ``MOVING`` of the weight of all with a gradient."""
    gradient = direction.abs().sum(-1, keepdim=True)
    worth = gradient / weight.clamp(min=torch.finfo(weight.dtype).tiny)
    order = worth.flatten().argsort(descending=True, stable=True)
    weights = (weight * (gradient > 0)).flatten()[order]
    before = weights.cumsum(0) - weights
    chosen = torch.empty_like(weights, dtype=torch.bool)
    chosen[order] = before < MOVING * weights.sum()
    return chosen.view_as(weight)
