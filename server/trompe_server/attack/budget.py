"""How far a texture may move: an L-infinity ball around the original, inside the colours that exist."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from trompe_shared.api import levels_within
from trompe_shared.errors import SpecError
from trompe_shared.object3d import Object3D

__all__ = ["Budget"]


@dataclass(frozen=True)
class Budget:
    """``epsilon`` is the largest change of a texel's channel, ``alpha`` the size of one step; sRGB in [0, 1] units.

    ``epsilon_view``, where given, bounds the change of every pixel of the surrogate's images likewise (the paper's view
    constraint). Raises ``SpecError`` unless 0 < alpha <= epsilon <= 1 and 0 < epsilon_view <= 1.
    """

    epsilon: float
    alpha: float
    epsilon_view: float | None = None

    def __post_init__(self) -> None:
        if not 0 < self.alpha <= self.epsilon <= 1:
            raise SpecError(
                "epsilon and alpha must satisfy 0 < alpha <= epsilon <= 1, "
                f"got alpha={self.alpha}, epsilon={self.epsilon}."
            )
        if self.epsilon_view is not None and not 0 < self.epsilon_view <= 1:
            raise SpecError(f"epsilon_view must be in (0, 1], or left out for no bound, got {self.epsilon_view}.")

    @property
    def levels(self) -> int:
        """The largest change of an 8-bit channel."""
        return levels_within(self.epsilon)

    def project(self, delta: Float[Tensor, "*texels 3"], texture: Float[Tensor, "*texels 3"]) -> Tensor:
        """The nearest change that keeps ``|delta| <= epsilon`` and ``0 <= texture + delta <= 1``."""
        return self._project_(delta.clone(), texture)

    def _project_(self, delta: Float[Tensor, "*texels 3"], texture: Float[Tensor, "*texels 3"]) -> Tensor:
        """``project``, in place."""
        return delta.clamp_(-self.epsilon, self.epsilon).add_(texture).clamp_(0, 1).sub_(texture)

    def ascend(
        self,
        delta: Float[Tensor, "*texels 3"],
        direction: Float[Tensor, "*texels 3"],
        texture: Float[Tensor, "*texels 3"],
        *,
        scale: float = 1.0,
    ) -> Tensor:
        """One projected step of ``scale * alpha`` along the sign of ``direction``; texels where it is zero stay."""
        return self._project_(direction.sign().mul_(scale * self.alpha).add_(delta), texture)

    def quantise(self, delta: Float[Tensor, "H W 3"], texture: UInt8[Tensor, "H W 3"]) -> UInt8[Tensor, "H W 3"]:
        """The 8-bit texture that is saved: ``texture + delta`` rounded, never further than epsilon off."""
        change = (delta * 255).round().clamp(-self.levels, self.levels).to(torch.int16)
        return (texture.to(torch.int16) + change).clamp(0, 255).to(torch.uint8)

    def repaint(self, obj: Object3D, deltas: Mapping[str, Float[Tensor, "H W 3"]]) -> Object3D:
        """``obj`` with its textures changed by ``deltas`` and saved in 8 bits."""
        return obj.with_textures(
            {
                name: self.quantise(delta.cpu(), torch.from_numpy(obj.textures[name])).numpy()
                for name, delta in deltas.items()
            }
        )
