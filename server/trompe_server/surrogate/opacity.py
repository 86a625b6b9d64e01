"""Alpha of an object's surfaces under a sampling hypothesis: cut-out and blended fragments."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from trompe_server.surrogate.pyramid import MipLayout, mip_chains, mip_layout, read_texels
from trompe_server.surrogate.rasterize import Mesh, Planes, covered
from trompe_server.surrogate.sampling import Fragments, SamplingModel, reads_of, shading_point, texture_coordinates
from trompe_shared.opacity import CUTOFF, INVISIBLE


@dataclass(frozen=True)
class Opacities:
    """The opacities of a mesh as the renderer reads them.

    layout, alpha: the mip levels of ``mesh.opacities``, in order, as one flat array.
    """

    mesh: Mesh
    model: SamplingModel
    layout: MipLayout
    alpha: Float[Tensor, " texels"]

    @classmethod
    def of(cls, mesh: Mesh, model: SamplingModel) -> "Opacities | None":
        """The opacities of a mesh under a hypothesis; ``None`` if all of it is opaque."""
        if not mesh.opacities:
            return None
        layout = mip_layout([(len(each.alpha), each.alpha.shape[1]) for each in mesh.opacities])
        everything = [torch.arange(h * w, device=mesh.texture.device) for sizes in layout.sizes for h, w in sizes]
        planes = [each.alpha[..., None] for each in mesh.opacities]
        alpha = read_texels(planes, mip_chains(layout, everything), rounded=model.mips == "rounded")
        return cls(mesh, model, layout, alpha[:, 0])

    @cached_property
    def blended(self) -> Bool[Tensor, " faces"] | None:
        """Whether each face of the mesh is blended; ``None`` if none is."""
        kinds = torch.tensor([*(each.blended for each in self.mesh.opacities), False], device=self.alpha.device)
        return kinds[self.mesh.opacity] if kinds.any() else None

    @cached_property
    def _tests(self) -> list[tuple[int, float]]:
        """The opacities that hide fragments somewhere, by number, with the least alpha to draw."""
        least = [INVISIBLE if each.blended else CUTOFF for each in self.mesh.opacities]
        return [(k, least[k]) for k, each in enumerate(self.mesh.opacities) if each.alpha.min() < least[k]]

    def drawn(
        self, planes: Planes, row: Int[Tensor, " n"], x: Int[Tensor, " n"], y: Int[Tensor, " n"]
    ) -> Bool[Tensor, " n"]:
        """Whether triangles (rows of ``planes``) are drawn at the pixels (x, y)."""
        opacity = self.mesh.opacity[planes.face[row]]
        passed = torch.ones_like(opacity, dtype=torch.bool)
        for number, least in self._tests:
            mine = (opacity == number).nonzero()[:, 0]
            share = covered(planes, row[mine], x[mine], y[mine], self.model.positions)
            passed[mine] = False
            mine, share = mine[share.any(1)], share[share.any(1)].float()
            point = torch.stack([x[mine], y[mine]], 1) + shading_point(share, self.model.positions, self.model.shade_at)
            uv, duv, _ = texture_coordinates(planes, self.mesh, row[mine], point)
            passed[mine] = self._read(number, uv, duv) >= least
        return passed

    def of_fragments(self, fragments: Fragments) -> Float[Tensor, " n"]:
        """Alpha of fragments: 1 for those that are not blended."""
        opacity = self.mesh.opacity[fragments.face]
        alpha = torch.ones_like(fragments.weight)
        for number, each in enumerate(self.mesh.opacities):
            if each.blended:
                mine = (opacity == number).nonzero()[:, 0]
                read = self._read(number, fragments.uv[mine], fragments.duv[mine])
                alpha[mine] = read.clamp(min=INVISIBLE)  # centroids may differ from those of ``drawn``
        return alpha

    def _read(self, number: int, uv: Float[Tensor, "n 2"], duv: Float[Tensor, "n 2 2"]) -> Float[Tensor, " n"]:
        """An opacity at texture coordinates."""
        read = torch.zeros(len(uv), device=uv.device)
        for used, index, weight, blend in reads_of(uv, duv, self.layout.levels(number, uv.device), self.model):
            read.index_add_(0, used, (self.alpha[index] * weight).sum(1) * blend)
        return read
