"""What a renderer reads from a texture for a pixel, as one sparse linear operator.

All mip levels of all textures lie in one flat array of texels. For every pixel the operator holds which texels it reads
and with which weights (trilinear, per fragment, fragments weighted by the samples they cover), so that some views of a
repainted object are a single gather, and the gradient its transpose.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import embedding_bag

from trompe_server.surrogate.pyramid import MipLayout, mip_chains, mip_layout, read_texels
from trompe_server.surrogate.rasterize import (
    CENTRE,
    MSAA4,
    MSAA4_MIRRORED,
    Mesh,
    Planes,
    Visibility,
    chunks,
    covered,
)
from trompe_shared.opacity import CUTOFF

__all__ = [
    "AlphaTest",
    "Fragments",
    "Gather",
    "SamplingModel",
    "Taps",
    "fragments_of",
    "taps_of",
]


@dataclass(frozen=True)
class SamplingModel:
    """A hypothesis on how a renderer samples textures and encodes images. All members are common practice of engines.

    samples: where a pixel looks: at the positions of 4x MSAA (rows counted from the top or from the bottom), or at its
        centre alone.
    shade_at: where the texture coordinates of a fragment are taken: at the pixel's centre (even if the fragment does
        not cover it: the default of OpenGL and Direct3D) or at the mean of the samples it covers (centroid sampling).
    lod: the level of detail is log2 of the footprint's longer axis, or of the root of its area.
    filtered: mip levels and texels are averaged on encoded (sRGB) values or in linear light.
    mips: encoded mip levels are exact averages, or rounded to 8 bits after averaging columns and again after rows.
    encoding: linear light becomes an image by the sRGB curve or by the power 1 / 2.2.
    bias: added to the level of detail.
    cull: triangles seen from behind are invisible.
    anisotropy: how many times longer than wide a footprint may be that is averaged over; 1 is no more than wide, and
        then ``lod`` says how wide.
    elongated: how that is done: by as many trilinear probes along the longer axis as it is times the shorter one, at
        the level of a probe's share of it (graphics cards), or by a Gaussian over an ellipse of texels (Heckbert, 1989;
        Mesa's software renderers).
    shift: where the samples and the centre of a pixel lie, added to where they should: x right and y down, in pixels,
        within [-1, 1].
    """

    samples: Literal["msaa4", "msaa4-mirrored", "centre"] = "msaa4"
    shade_at: Literal["centre", "centroid"] = "centre"
    lod: Literal["longer", "area"] = "longer"
    filtered: Literal["encoded", "linear"] = "encoded"
    mips: Literal["exact", "rounded"] = "exact"
    encoding: Literal["srgb", "power"] = "srgb"
    bias: float = 0.0
    cull: bool = True
    anisotropy: int = 1
    elongated: Literal["probes", "ellipse"] = "probes"
    shift: tuple[float, float] = (0.0, 0.0)

    @property
    def positions(self) -> tuple[tuple[float, float], ...]:
        """Sample positions in a pixel, x right and y down. Their mean is where the pixel is shaded."""
        right, down = self.shift
        table = {"msaa4": MSAA4, "msaa4-mirrored": MSAA4_MIRRORED, "centre": CENTRE}
        return tuple((x + right, y + down) for x, y in table[self.samples])

    def but(self, **changes: object) -> "SamplingModel":
        """This hypothesis with some members changed."""
        return replace(self, **changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Fragments:
    """The (pixel, triangle) pairs of one view.

    entry: which pixel of the visibility each belongs to, ascending. weight: share of the pixel's samples, so that the
    weights of a pixel sum to its coverage. uv: texture coordinates. duv: their derivatives, [..., 0] per pixel to the
    right, [..., 1] per pixel down.
    barycentric: weights of the triangle's corners (outside [0, 1] where the triangle does not cover the shading point).
    """

    face: Int[Tensor, " n"]
    entry: Int[Tensor, " n"]
    weight: Float[Tensor, " n"]
    uv: Float[Tensor, "n 2"]
    duv: Float[Tensor, "n 2 2"]
    barycentric: Float[Tensor, "n 3"]


def fragments_of(
    visibility: Visibility, mesh: Mesh, width: int, *, samples: tuple[tuple[float, float], ...], shade_at: str
) -> Fragments:
    """The distinct triangles that the samples of each pixel see, with their exact texture coordinates."""
    rows, n_samples = visibility.row, visibility.row.shape[1]
    same = rows[:, :, None] == rows[:, None, :]
    earlier = torch.ones(n_samples, n_samples, device=rows.device).tril(-1).bool()
    first = (rows >= 0) & ~(same & earlier).any(2)
    entry, sample = first.nonzero(as_tuple=True)
    share = same[entry, sample].float()
    row = rows[entry, sample]
    offset = _shading_point(share, samples, shade_at)
    pixel = visibility.pixel[entry]
    point = torch.stack([pixel % width, pixel // width], 1) + offset
    uv, duv, barycentric = _texture_coordinates(visibility.planes, mesh, row, point)
    return Fragments(visibility.planes.face[row], entry, share.sum(1) / n_samples, uv, duv, barycentric)


def _shading_point(
    share: Float[Tensor, "n samples"], samples: tuple[tuple[float, float], ...], shade_at: str
) -> Float[Tensor, "_ 2"]:
    """Where in the pixel a fragment that covers the samples with a ``share`` of 1 (not 0) reads its texture."""
    positions = torch.tensor(samples, device=share.device)
    if shade_at == "centre":
        return positions.mean(0, keepdim=True)
    return (share @ positions) / share.sum(1, keepdim=True)


def _texture_coordinates(
    planes: Planes, mesh: Mesh, row: Int[Tensor, " n"], point: Float[Tensor, "n 2"]
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 2"], Float[Tensor, "n 3"]]:
    """UV, its derivatives by the pixel position, and the barycentrics, at ``point`` of triangle ``row``."""
    edges = planes.edges[row]  # (n, abc, corner)
    over_depth = edges[:, 0] * point[:, :1] + edges[:, 1] * point[:, 1:] + edges[:, 2]
    inverse_depth = over_depth.sum(1, keepdim=True)
    barycentric = over_depth / inverse_depth
    uvs = mesh.uvs[planes.face[row]]
    uv = (barycentric[..., None] * uvs).sum(1)
    slope = torch.einsum("nic,ncu->nui", edges[:, :2], uvs) - uv[..., None] * edges[:, :2].sum(2)[:, None, :]
    return uv, slope / inverse_depth[..., None], barycentric


@dataclass(frozen=True)
class Taps:
    """Which pixel (``entry``, ascending) reads which texel with which weight, int32 and float32; no pair twice."""

    entry: Int[Tensor, " taps"]
    index: Int[Tensor, " taps"]
    weight: Float[Tensor, " taps"]


@dataclass(frozen=True)
class Gather:
    """A sparse matrix (pixels x texels) in both directions: ``pixels = forward(texels)`` and its transpose."""

    index: Int[Tensor, " taps"]
    weight: Float[Tensor, " taps"]
    offsets: Int[Tensor, " pixels"]
    pixel: Int[Tensor, " taps"]
    transposed_weight: Float[Tensor, " taps"]
    transposed_offsets: Int[Tensor, " texels"]

    @classmethod
    def of(cls, taps: Taps, n_pixels: int, n_texels: int) -> "Gather":
        """Order the taps by texel too."""
        by_texel = taps.index.argsort(stable=True)
        return cls(
            taps.index,
            taps.weight,
            _starts(taps.entry, n_pixels),
            taps.entry[by_texel],
            taps.weight[by_texel],
            _starts(taps.index, n_texels),
        )

    def forward(self, texels: Float[Tensor, "texels 3"]) -> Float[Tensor, "pixels 3"]:
        """Weighted sums of the texels that each pixel reads."""
        return embedding_bag(self.index, texels, self.offsets, mode="sum", per_sample_weights=self.weight)

    def transpose(self, pixels: Float[Tensor, "pixels 3"]) -> Float[Tensor, "texels 3"]:
        """What each texel gets from the ``pixels`` that read it: the transpose of ``forward``."""
        offsets, weight = self.transposed_offsets, self.transposed_weight
        return embedding_bag(self.pixel, pixels, offsets, mode="sum", per_sample_weights=weight)

    @property
    def nbytes(self) -> int:
        """Memory it takes."""
        return sum(t.nbytes for t in vars(self).values())


def _starts(keys: Int[Tensor, " taps"], n_keys: int) -> Int[Tensor, " keys"]:
    """Where each key's run would begin if the taps were sorted by key."""
    counts = torch.bincount(keys, minlength=n_keys)
    return (counts.cumsum(0) - counts).int()


def taps_of(fragments: Fragments, n_pixels: int, mesh: Mesh, layout: MipLayout, model: SamplingModel) -> Taps:
    """What the pixels of one view read under the hypothesis ``model``.

    Weights of a pixel sum to one: the share of it that the object covers belongs to the colour model.
    """
    entries, indices, weights = [], [], []
    share = (
        fragments.weight
        / torch.zeros(n_pixels, device=fragments.weight.device).index_add_(0, fragments.entry, fragments.weight)[
            fragments.entry
        ]
    )
    for texture, (sizes, starts) in enumerate(zip(layout.sizes, layout.starts, strict=True)):
        mine = (mesh.texture[fragments.face] == texture).nonzero()[:, 0]
        uv, duv, entry, part = fragments.uv[mine], fragments.duv[mine], fragments.entry[mine], share[mine]
        for used, index, weight, blend in _reads(uv, duv, sizes, starts, model):
            entries.append(entry[used, None].expand_as(index).reshape(-1))
            indices.append(index.reshape(-1))
            weights.append((weight * (blend * part[used])[:, None]).reshape(-1))
    return _merged(torch.cat(entries), torch.cat(indices), torch.cat(weights), layout.total)


Sizes = tuple[tuple[int, int], ...]
Reads = Iterator[tuple[Int[Tensor, " m"], Int[Tensor, "m k"], Float[Tensor, "m k"], Float[Tensor, " m"]]]
"""Portions of what is read: who reads, flat indices and weights there, and the portion's own weight for each who reads.
"""


def _reads(
    uv: Float[Tensor, "n 2"], duv: Float[Tensor, "n 2 2"], sizes: Sizes, starts: tuple[int, ...], model: SamplingModel
) -> Reads:
    """What fragments read of a texture whose mip levels have ``sizes`` and begin at ``starts``."""
    if model.anisotropy == 1:
        return _trilinear(uv, level_of_detail(duv, sizes[0], model), sizes, starts)
    texels = (duv * torch.tensor([sizes[0][1], sizes[0][0]], device=duv.device)[:, None]).nan_to_num(0.0)
    if model.elongated == "probes":
        return _probes(uv, duv, texels, sizes, starts, model)
    return _ellipses(uv, texels, sizes, starts, model)


def _axes(texels: Float[Tensor, "n 2 2"]) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Length of the longer and of the shorter axis of footprints."""
    extent = texels.norm(dim=1).clamp(min=1e-8)
    return extent.amax(1), extent.amin(1)


ROUND = 1e-3
"""A footprint this little longer than wide is as long as wide."""


def _probes(
    uv: Float[Tensor, "n 2"],
    duv: Float[Tensor, "n 2 2"],
    texels: Float[Tensor, "n 2 2"],
    sizes: Sizes,
    starts: tuple[int, ...],
    model: SamplingModel,
) -> Reads:
    """Trilinear probes side by side along the longer axis (EXT_texture_filter_anisotropic); ``texels`` is ``duv`` in
    texels of level 0."""
    longer, shorter = _axes(texels)
    probes = (longer / shorter - ROUND).ceil().clamp(1, model.anisotropy)
    axis = duv.nan_to_num(0.0).gather(2, texels.norm(dim=1).argmax(1)[:, None, None].expand(-1, 2, 1))[..., 0]
    count = probes.long()
    who = torch.arange(len(uv), device=uv.device).repeat_interleave(count)
    number = torch.arange(len(who), device=uv.device) - (count.cumsum(0) - count)[who]
    along = (number + 0.5) / probes[who] - 0.5
    level = (longer / probes).log2() + model.bias
    for used, index, weight, blend in _trilinear(uv[who] + along[:, None] * axis[who], level[who], sizes, starts):
        yield who[used], index, weight, blend / probes[who[used]]


def _ellipses(
    uv: Float[Tensor, "n 2"],
    texels: Float[Tensor, "n 2 2"],
    sizes: Sizes,
    starts: tuple[int, ...],
    model: SamplingModel,
) -> Reads:
    """All texels of one mip level in an ellipse with the footprint's axes, a texel wider, by a Gaussian's weights.

    The level is that of the shorter axis, but at least that of the longer one's share ``1 / model.anisotropy``.
    """
    longer, shorter = _axes(texels)
    level = torch.maximum(shorter, longer / model.anisotropy).log2() + model.bias
    level = level.clamp(0, len(sizes) - 1).floor()
    scale = torch.minimum(0.5**level, 2 * model.anisotropy / longer)  # no larger where no level is coarse enough
    size, start = (torch.tensor(table, device=uv.device)[level.long()] for table in (sizes, starts))
    u, v = uv.nan_to_num(0.0).remainder(1.0).unbind(1)
    centre = torch.stack([u * size[:, 1], (1 - v) * size[:, 0]], 1) - 0.5
    for who, x, y, weight in _within(centre, _form(texels * scale[:, None, None])):
        index = start[who] + y % size[who, 0] * size[who, 1] + x % size[who, 1]
        yield who, index[:, None], torch.ones_like(weight)[:, None], weight


def _form(texels: Float[Tensor, "n 2 2"]) -> Float[Tensor, "n 3"]:
    """(a, b, c) of the ellipses ``a x^2 + 2 b x y + c y^2 < a c - b^2`` (x right, y down) that are footprints, a texel
    wider."""
    across, up = texels.unbind(1)
    return torch.stack([up.square().sum(1) + 1, (across * up).sum(1), across.square().sum(1) + 1], 1)


def _within(
    centre: Float[Tensor, "n 2"], form: Float[Tensor, "n 3"]
) -> Iterator[tuple[Int[Tensor, " m"], Int[Tensor, " m"], Int[Tensor, " m"], Float[Tensor, " m"]]]:
    """Which ellipse (``form`` around ``centre``) holds which texels (x, y), by what weight; those of each sum to one.

    The weight is exp(-2 r^2), where r is the distance in units of the ellipse's radius there.
    """
    reach = form[:, [2, 0]].sqrt()
    first = (centre - reach).floor().long()
    extent = (centre + reach).ceil().long() - first + 1
    counts = extent[:, 0] * extent[:, 1]
    for begin, end in chunks(counts) or [(0, 0)]:
        some = counts[begin:end]
        who = torch.arange(begin, end, device=centre.device).repeat_interleave(some)
        number = torch.arange(len(who), device=centre.device) - (some.cumsum(0) - some)[who - begin]
        x, y = first[who, 0] + number % extent[who, 0], first[who, 1] + number // extent[who, 0]
        right, down, (a, b, c) = x - centre[who, 0], y - centre[who, 1], form[who].unbind(1)
        squared = (a * right.square() + 2 * b * right * down + c * down.square()) / (a * c - b.square())
        weight = (-2 * squared).exp() * (squared < 1)
        total = torch.zeros(len(form), device=centre.device).index_add_(0, who, weight)
        yield who, x, y, weight / total[who]


def _trilinear(uv: Float[Tensor, "n 2"], level: Float[Tensor, " n"], sizes: Sizes, starts: tuple[int, ...]) -> Reads:
    """The finer and the coarser mip level around ``level`` (unclamped)."""
    level = level.clamp(0, len(sizes) - 1)
    lower = level.floor().clamp(max=max(len(sizes) - 2, 0))
    for step in (0, 1):
        blend = (level - lower) if step else 1 - (level - lower)
        used = (blend > 0).nonzero()[:, 0]
        yield used, *_bilinear(uv[used], lower[used].long() + step, sizes, starts), blend[used]


def level_of_detail(duv: Float[Tensor, "n 2 2"], size: tuple[int, int], model: SamplingModel) -> Float[Tensor, " n"]:
    """Mip level (unclamped) for a footprint, by the rule of ``model``; ``size`` is (H, W) of level 0."""
    texels = duv * torch.tensor([size[1], size[0]], device=duv.device)[:, None]
    extent: Tensor = texels.norm(dim=1).amax(1) if model.lod == "longer" else torch.linalg.det(texels).abs().sqrt()
    return extent.nan_to_num(0.0).clamp(min=1e-8).log2() + model.bias


def _bilinear(
    uv: Float[Tensor, "n 2"],
    level: Int[Tensor, " n"],
    sizes: tuple[tuple[int, int], ...],
    starts: tuple[int, ...],
) -> tuple[Int[Tensor, "n 4"], Float[Tensor, "n 4"]]:
    """Flat indices and weights of the four texels around ``uv`` at a mip level; textures repeat."""
    size = torch.tensor(sizes, device=uv.device)[level]
    start = torch.tensor(starts, device=uv.device)[level]
    height, width = size[:, 0], size[:, 1]
    u = uv[:, 0].nan_to_num(0.0).remainder(1.0)
    v = (1 - uv[:, 1].nan_to_num(0.0)).remainder(1.0)
    x, y = u * width - 0.5, v * height - 0.5
    x0, y0 = x.floor(), y.floor()
    fx, fy = x - x0, y - y0
    columns = [(x0.long() + k) % width for k in (0, 1)]
    rows = [(y0.long() + k) % height for k in (0, 1)]
    index = torch.stack([start + r * width + c for r in rows for c in columns], 1)
    weight = torch.stack([wy * wx for wy in (1 - fy, fy) for wx in (1 - fx, fx)], 1)
    return index, weight


def _merged(
    entry: Int[Tensor, " taps"], index: Int[Tensor, " taps"], weight: Float[Tensor, " taps"], n_texels: int
) -> Taps:
    """The taps that count, in order, those of the same pixel and texel in one."""
    used = (weight > 1e-6).nonzero()[:, 0]
    pair, order = (entry[used] * n_texels + index[used]).sort(stable=True)
    pair, which = torch.unique_consecutive(pair, return_inverse=True)
    total = torch.zeros(len(pair), device=weight.device).index_add_(0, which, weight[used][order].float())
    return Taps((pair // n_texels).int(), (pair % n_texels).int(), total)


@dataclass(frozen=True)
class AlphaTest:
    """Alpha-tested textures: a fragment is drawn only where the alpha that it reads is at least ``CUTOFF``.

    layout, alpha: the mip levels of ``mesh.opacities``, in order, as one flat array.
    """

    mesh: Mesh
    model: SamplingModel
    layout: MipLayout
    alpha: Float[Tensor, " texels"]

    @classmethod
    def of(cls, mesh: Mesh, model: SamplingModel) -> "AlphaTest | None":
        """The test of a mesh under a hypothesis; ``None`` where all of it is opaque."""
        if not mesh.opacities:
            return None
        layout = mip_layout([(len(alpha), alpha.shape[1]) for alpha in mesh.opacities.values()])
        everything = [torch.arange(h * w, device=mesh.texture.device) for sizes in layout.sizes for h, w in sizes]
        planes = [alpha[..., None] for alpha in mesh.opacities.values()]
        alpha = read_texels(planes, mip_chains(layout, everything), rounded=model.mips == "rounded")
        return cls(mesh, model, layout, alpha[:, 0])

    def drawn(
        self, planes: Planes, row: Int[Tensor, " n"], x: Int[Tensor, " n"], y: Int[Tensor, " n"]
    ) -> Bool[Tensor, " n"]:
        """Whether triangles (rows of ``planes``) are drawn at the pixels (x, y)."""
        texture = self.mesh.texture[planes.face[row]]
        passed = torch.ones_like(texture, dtype=torch.bool)
        for number, sizes, starts in zip(self.mesh.opacities, self.layout.sizes, self.layout.starts, strict=True):
            mine = (texture == number).nonzero()[:, 0]
            share = covered(planes, row[mine], x[mine], y[mine], self.model.positions)
            passed[mine] = False
            mine, share = mine[share.any(1)], share[share.any(1)].float()
            point = torch.stack([x[mine], y[mine]], 1) + _shading_point(
                share, self.model.positions, self.model.shade_at
            )
            uv, duv, _ = _texture_coordinates(planes, self.mesh, row[mine], point)
            read = torch.zeros(len(mine), device=uv.device)
            for used, index, weight, blend in _reads(uv, duv, sizes, starts, self.model):
                read.index_add_(0, used, (self.alpha[index] * weight).sum(1) * blend)
            passed[mine] = read >= CUTOFF
        return passed
