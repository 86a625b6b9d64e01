"""Budget of the change: an L-infinity ball around the original texture, within valid colours.

A perceptual budget has a bound of its own for each texel, never above epsilon, and allows less change of hue than of
lightness: people notice a tint sooner than a shade of the same size.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from trompe_shared.api import levels_within
from trompe_shared.errors import SpecError
from trompe_shared.object3d import Object3D

Bound = Float[Tensor, "*texels 1"]
"""Largest change of each texel's channels, in whole 8-bit levels."""

HUE: Final = 1.0
"""Largest difference between the changes of a texel's channels, as a share of its bound."""


@dataclass(frozen=True)
class Budget:
    """Bounds in sRGB units of [0, 1].

    epsilon: largest change of a texel's channel. alpha: size of one step. epsilon_view: largest change of a pixel of
    the surrogate's images (the paper's view constraint), if any. perceptual: bound each texel by ``perceptual_bounds``.
    Raises ``SpecError`` unless 0 < alpha <= epsilon <= 1 and 0 < epsilon_view <= 1.
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
        if self.epsilon_view is not None and not 0 < self.epsilon_view <= 1:
            raise SpecError(f"epsilon_view must be in (0, 1], got {self.epsilon_view}; omit it for no bound.")

    @property
    def levels(self) -> int:
        """The largest change of an 8-bit channel."""
        return levels_within(self.epsilon)

    def project(
        self, delta: Float[Tensor, "*texels 3"], texture: Float[Tensor, "*texels 3"], bound: Bound | None = None
    ) -> Tensor:
        """The nearest change with ``|delta| <= epsilon`` and ``0 <= texture + delta <= 1``.

        With a ``bound`` of each texel: ``|delta| <= bound``, and channels of a texel at most ``HUE * bound`` apart.
        """
        return self._project_(delta.clone(), texture, bound)

    def _project_(self, delta: Tensor, texture: Tensor, bound: Bound | None) -> Tensor:
        if bound is None:
            return delta.clamp_(-self.epsilon, self.epsilon).add_(texture).clamp_(0, 1).sub_(texture)
        low, high = torch.maximum(-bound, -texture), torch.minimum(bound, 1 - texture)
        delta = torch.clamp(delta, low, high)
        reach = HUE / 2 * bound
        middle = (delta.amax(-1, keepdim=True) + delta.amin(-1, keepdim=True)) / 2
        middle = middle.clamp(low.amax(-1, keepdim=True) - reach, high.amin(-1, keepdim=True) + reach)
        return torch.clamp(torch.clamp(delta, middle - reach, middle + reach), low, high)

    def ascend(
        self,
        delta: Float[Tensor, "*texels 3"],
        direction: Float[Tensor, "*texels 3"],
        texture: Float[Tensor, "*texels 3"],
        *,
        scale: float = 1.0,
        bound: Bound | None = None,
    ) -> Tensor:
        """One projected step of ``scale * alpha`` along the sign of ``direction``; texels with zero stay.

        With a ``bound`` the step shrinks as the bound does.
        """
        step = scale * self.alpha if bound is None else bound * (scale * self.alpha / self.epsilon)
        return self._project_(direction.sign().mul_(step).add_(delta), texture, bound)

    def quantise(self, delta: Float[Tensor, "H W 3"], texture: UInt8[Tensor, "H W 3"]) -> UInt8[Tensor, "H W 3"]:
        """The 8-bit texture to save: ``texture + delta`` rounded, at most epsilon from ``texture``."""
        change = (delta * 255).round().clamp(-self.levels, self.levels).to(torch.int16)
        return (texture.to(torch.int16) + change).clamp(0, 255).to(torch.uint8)

    def repaint(self, obj: Object3D, deltas: Mapping[str, Float[Tensor, "H W 3"]]) -> Object3D:
        """``obj`` with textures changed by ``deltas``, in 8 bits."""
        return obj.with_textures(
            {
                name: self.quantise(delta.cpu(), torch.from_numpy(obj.textures[name])).numpy()
                for name, delta in deltas.items()
            }
        )
