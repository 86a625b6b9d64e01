"""The surrogates of several renderers as one: an attack through it paints for all of them.

Its views are those of the first renderer, then those of the next one, and so on. All renderers show the same object, so
its texels move together; each renderer has its own sampling and colour model.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from trompe_server.surrogate.canvas import Canvas
from trompe_server.surrogate.surrogate import Surrogate


def joined(parts: Sequence[Surrogate]) -> "AnySurrogate":
    """One or several surrogates of the same object and image size as one."""
    return parts[0] if len(parts) == 1 else JointSurrogate(tuple(parts))


@dataclass(frozen=True)
class JointCanvas:
    """Canvases with the same moving texels, for different reads; the interface of ``Canvas``."""

    canvases: tuple[Canvas, ...]

    @property
    def source(self) -> Float[Tensor, "texels 3"]:
        return self.canvases[0].source

    def join(self, tables: Sequence[Tensor]) -> Tensor:
        return self.canvases[0].join(tables)

    def split(self, values: Tensor) -> list[Tensor]:
        return self.canvases[0].split(values)

    def read(self, values: Float[Tensor, "texels 3"]) -> Float[Tensor, "reads 3"]:
        """The texels read by all views, as ``JointSurrogate.texels``. Differentiable."""
        return torch.cat([canvas.read(values) for canvas in self.canvases])


@dataclass(frozen=True)
class JointSurrogate:
    """Several surrogates with the interface of one that an attack needs; see the module's docstring.

    Parts with the same geometry share their texels.
    """

    parts: tuple[Surrogate, ...]

    @property
    def n_views(self) -> int:
        return sum(part.n_views for part in self.parts)

    @property
    def size(self) -> tuple[int, int]:
        return self.parts[0].size

    @property
    def textures(self) -> tuple[str, ...]:
        return self.parts[0].textures

    @property
    def device(self) -> torch.device:
        return self.parts[0].device

    @cached_property
    def batches(self) -> tuple[range, ...]:
        return tuple(
            range(first + views.start, first + views.stop)
            for part, first in zip(self.parts, self._first_views, strict=True)
            for views in part.batches
        )

    def texels(self, textures: Mapping[str, Float[Tensor, "H W 3"]]) -> Float[Tensor, "texels 3"]:
        """The texels read by all parts. Differentiable."""
        return torch.cat([part.texels(textures) for part in self._readers])

    def canvas(
        self, textures: Mapping[str, Float[Tensor, "H W 3"]], moving: Mapping[str, Bool[Tensor, "h w"]]
    ) -> JointCanvas:
        return JointCanvas(tuple(part.canvas(textures, moving) for part in self._readers))

    def render(
        self, texels: Float[Tensor, "texels 3"], batch: int, *, masks: Bool[Tensor, "views H W"] | None = None
    ) -> Float[Tensor, "batch 3 H W"]:
        """``masks`` are for the views of all renderers."""
        number, own = self._places[batch]
        return self.parts[number].render(texels[self._reads[number]], own, masks=self._masks(number, masks))

    def colours(
        self, texels: Float[Tensor, "texels 3"], batch: int
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3"]]:
        number, own = self._places[batch]
        return self.parts[number].colours(texels[self._reads[number]], own)

    def spread(self, pixels: Float[Tensor, "pixels 3"], batch: int) -> Float[Tensor, "texels 3"]:
        number, own = self._places[batch]
        total = pixels.new_zeros(max(reads.stop for reads in self._reads), 3)
        total[self._reads[number]] = self.parts[number].spread(pixels, own)
        return total

    def influence(self, masks: Bool[Tensor, "views H W"] | None = None) -> dict[str, Float[Tensor, "H W"]]:
        found = [part.influence(self._masks(number, masks)) for number, part in enumerate(self.parts)]
        return {name: torch.stack([each[name] for each in found]).sum(0) for name in self.textures}

    @cached_property
    def footprint(self) -> Mapping[str, float]:
        """Texels that a pixel reads of each texture: the geometric mean over the views of all parts."""
        found = {}
        for name in self.textures:
            weights = [float(part.level_weights[name].sum()) for part in self.parts]
            logs = [weight * math.log(part.footprint[name]) for weight, part in zip(weights, self.parts, strict=True)]
            found[name] = math.exp(sum(logs) / (sum(weights) or 1))
        return found

    @cached_property
    def spare_levels(self) -> Mapping[str, int]:
        return {name: min(part.spare_levels[name] for part in self.parts) for name in self.textures}

    @cached_property
    def _readers(self) -> list[Surrogate]:
        """One part of each geometry."""
        return list({id(part.geometry): part for part in reversed(self.parts)}.values())[::-1]

    @cached_property
    def _reads(self) -> list[slice]:
        """Each part's texels among those of all."""
        ends = torch.tensor([part.n_texels for part in self._readers]).cumsum(0).tolist()
        mine = {
            id(part.geometry): slice(end - part.n_texels, end) for part, end in zip(self._readers, ends, strict=True)
        }
        return [mine[id(part.geometry)] for part in self.parts]

    @cached_property
    def _first_views(self) -> list[int]:
        return [sum(part.n_views for part in self.parts[:number]) for number in range(len(self.parts))]

    @cached_property
    def _places(self) -> list[tuple[int, int]]:
        """(Part, batch of the part) of each batch."""
        return [(number, own) for number, part in enumerate(self.parts) for own in range(len(part.batches))]

    def _masks(self, number: int, masks: Bool[Tensor, "views H W"] | None) -> Bool[Tensor, "views H W"] | None:
        first = self._first_views[number]
        return None if masks is None else masks[first : first + self.parts[number].n_views]


AnySurrogate = Surrogate | JointSurrogate
AnyCanvas = Canvas | JointCanvas
