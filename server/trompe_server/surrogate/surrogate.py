"""The surrogate renderer: images of a repainted object and their gradients, at the cost of one gather per view.

geometry = prepare_geometry(obj, views, size=(224, 224), sampling=SamplingModel())
surrogate = curve_surrogate(geometry, obj, views, clean, greys, probes)  # or diffuse_surrogate(geometry, views)
texels = surrogate.texels(textures)
images = surrogate.render(texels, batch=0)  # views surrogate.batches[0]; differentiable in the textures
"""

import itertools
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import FunctionCtx
from torch.nn.functional import softshrink

from trompe_server.surrogate.canvas import Canvas, canvas_of
from trompe_server.surrogate.opacity import Opacities
from trompe_server.surrogate.pixel_filter import KernelName, PixelFilter, kernel_of
from trompe_server.surrogate.pyramid import MipChain, MipLayout, StoredChain, mip_chains, mip_layout, read_texels
from trompe_server.surrogate.rasterize import Mesh, Visibility, mesh_of, project, rasterize
from trompe_server.surrogate.sampling import FilteredGather, Gather, SamplingModel, Taps, fragments_of, taps_of
from trompe_server.surrogate.shading import Chord, CurveShading, DiffuseShading, decode, encode, fit_curve, lambert
from trompe_server.surrogate.tone import ToneMap, ToneShading, fit_tone
from trompe_server.system.threads import side_by_side
from trompe_shared.geometry import Camera, View, spherical
from trompe_shared.object3d import Object3D

Image8 = NDArray[np.uint8]
Shading = DiffuseShading | CurveShading | ToneShading

NO_BACKDROPS: Final[Mapping[str, Image8]] = {}

HARDLY: Final = 0.05
"""Share of the reads of a texture, by weight, below which its finest mip levels are spare."""

BATCH: Final = 5
"""Views per operator on a CPU, and images of one gradient of a network: half the memory of ten, 2 to 5 % slower."""

BATCH_ON_A_CARD: Final = 20
"""Views per operator on a graphics card, where starting an operator of five takes longer than its work."""


@dataclass(frozen=True)
class ViewBatch:
    """Consecutive rasterised views: object pixels, their reads, and their shade under the paper's light.

    pixel: (view * H + row) * W + column, with the batch's views from 0. counts: object pixels of each view. sub_pixels:
    the same in sub-pixels, if a reconstruction filter averages them.
    """

    views: range
    pixel: Int[Tensor, " pixels"]
    counts: tuple[int, ...]
    gather: Gather | FilteredGather
    coverage: Float[Tensor, "pixels 1"]
    shade: Float[Tensor, "pixels 1"]
    sub_pixels: "ViewBatch | None" = None

    def of(self, images: Shaped[Tensor, "views H W ..."]) -> Shaped[Tensor, "pixels ..."]:
        """Values (pixels, ...) of the images of all views, on any device, at the object pixels of this batch."""
        some = images[self.views.start : self.views.stop].to(self.pixel.device)
        return some.flatten(0, 2).index_select(0, self.pixel)


@dataclass(frozen=True)
class Geometry:
    """All views of one object under one sampling hypothesis. ``size`` is (H, W).

    reads: for each mip level in the layout's order, the texels read by any view, in the order of the first read, so
    that neighbours in an image are neighbours in memory. Concatenated they are the operators' ``texels``.
    areas: the same views with mip levels, whose reads say what part of the texture a pixel shows, if ``sampling`` reads
    single texels instead; otherwise ``None``. Those of a pixel, not of its sub-pixels.
    """

    textures: tuple[str, ...]
    layout: MipLayout
    reads: tuple[Int[Tensor, " _"], ...]
    sampling: SamplingModel
    size: tuple[int, int]
    batches: tuple[ViewBatch, ...]
    areas: "Geometry | None" = None

    def values(self, textures: Mapping[str, Float[Tensor, "H W 3"]]) -> Float[Tensor, "texels 3"]:
        """The texels read by any view from the mip levels of sRGB ``textures`` by name: encoded, or linear if the
        sampling model filters light. Differentiable."""
        ordered = [textures[name].to(self.device) for name in self.textures]
        if self.sampling.filtered == "linear":
            return read_texels([decode(texture) for texture in ordered], self.chains)
        return read_texels(ordered, self.chains, rounded=self.sampling.mips == "rounded")

    def read_weights(self, masks: Bool[Tensor, "views H W"] | None = None) -> Float[Tensor, "texels 1"]:
        """Total weight of each read in the pixels of all views, or in those of ``masks``."""
        total = torch.zeros(sum(map(len, self.reads)), 1, device=self.device)
        for batch in self.batches:
            seen = torch.ones(len(batch.pixel), 1, device=self.device)
            total += batch.gather.transpose(seen if masks is None else seen * batch.of(masks)[:, None])
        return total

    @cached_property
    def chains(self) -> list[MipChain]:
        """The mip levels of each texture with their reads."""
        return mip_chains(self.layout, self.reads)

    @property
    def device(self) -> torch.device:
        """Device of the operators."""
        return self.reads[0].device

    @property
    def nbytes(self) -> int:
        """Memory of the operators in bytes."""
        own = sum(batch.gather.nbytes + batch.pixel.nbytes for batch in self.batches)
        return own + (self.areas.nbytes if self.areas else 0)


KEPT_LEVELS: Final = 2**29
"""Bytes of mip levels that ``Painted`` keeps beyond the last one asked for."""


@dataclass(frozen=True)
class Painted:
    """The textures of an object, read by many hypotheses: their mip levels are averaged once for each way to do so."""

    obj: Object3D
    device: torch.device
    stored: dict[tuple[str, bool], tuple[StoredChain, ...]] = field(default_factory=dict)
    """Mip levels by the members of ``SamplingModel`` that change them, the last one used at the end."""

    def texels(self, geometry: Geometry) -> Float[Tensor, "texels 3"]:
        """``geometry.values`` of the textures, without a gradient."""
        sampling = geometry.sampling
        key = sampling.filtered, sampling.mips == "rounded" and sampling.filtered != "linear"
        chains = self.stored.pop(key, None) or self._chains(geometry, *key)
        self.stored[key] = chains
        while len(self.stored) > 1 and sum(c.nbytes for each in self.stored.values() for c in each) > KEPT_LEVELS:
            del self.stored[next(iter(self.stored))]
        pairs = zip(chains, geometry.chains, strict=True)
        return torch.cat([part for stored, chain in pairs for part in stored.read(chain.reads)])

    def _chains(self, geometry: Geometry, filtered: str, rounded: bool) -> tuple[StoredChain, ...]:
        table = torch.arange(256, device=self.device) / 255
        table = decode(table) if filtered == "linear" else table
        textures = [tensor_of(self.obj.textures[name]).to(self.device) for name in geometry.textures]
        return tuple(StoredChain.of(texture, table, rounded=rounded) for texture in textures)


def prepare_geometry(
    obj: Object3D,
    views: Sequence[View],
    *,
    size: tuple[int, int],
    sampling: SamplingModel,
    device: torch.device | str = "cpu",
    known: dict[Camera, Visibility] | None = None,
) -> Geometry:
    """Rasterise ``obj`` once for all ``views`` and images of ``size`` (H, W).

    known: the visible triangles of hypotheses with the same ``samples``, ``shift`` and ``cull``. Views of an opaque
    object are looked up there, and added.
    """
    mesh = mesh_of(obj, device=device)
    layout = mip_layout([obj.textures[name].shape[:2] for name in mesh.textures])
    opacities = Opacities.of(mesh, sampling)

    def visible(camera: Camera) -> Visibility:
        if opacities is not None or known is None:
            return _visible(mesh, opacities, camera, size, sampling)
        if camera not in known:
            known[camera] = _visible(mesh, None, camera, size, sampling)
        return known[camera]

    def prepare(view: View) -> _View:
        return _prepare_view(mesh, layout, opacities, view, visible(view.camera), size, sampling)

    prepared = side_by_side(prepare, views, split=torch.device(device).type == "cpu")
    reads = _in_order_of_reading([view.taps.index for view in prepared], layout)
    starts = itertools.chain.from_iterable(layout.starts)
    texels = torch.cat([level + start for level, start in zip(reads, starts, strict=True)])
    place = torch.empty(layout.total, dtype=torch.int32, device=device)
    place[texels] = torch.arange(len(texels), dtype=torch.int32, device=device)
    count = BATCH_ON_A_CARD if texels.is_cuda else BATCH
    numbers = [range(first, min(first + count, len(views))) for first in range(0, len(views), count)]
    batches = tuple(
        _joined(some, prepared[some.start : some.stop], place, len(texels), size, sampling) for some in numbers
    )
    areas = None
    if sampling.minified != "mipmaps":
        whole = sampling.subdivision == 1
        shown = sampling.but(minified="mipmaps", samples=sampling.samples if whole else "centre")
        areas = prepare_geometry(obj, views, size=size, sampling=shown, device=device, known=known if whole else None)
    return Geometry(mesh.textures, layout, reads, sampling, size, batches, areas)


NEVER: Final = torch.iinfo(torch.int64).max


def _in_order_of_reading(taps: Sequence[Int[Tensor, " taps"]], layout: MipLayout) -> tuple[Int[Tensor, " _"], ...]:
    """The texels of each mip level in the ``taps`` of any view, in the order of their first read."""
    first, count = torch.full((layout.total,), NEVER, device=taps[0].device), 0
    for index in taps:
        number = torch.arange(count, count + len(index), device=index.device)
        first.scatter_reduce_(0, index.long(), number, "amin")
        count += len(index)
    reads = []
    for level in torch.split(first, [h * w for sizes in layout.sizes for h, w in sizes]):
        read = (level < NEVER).nonzero()[:, 0]
        reads.append(read[level[read].argsort()])
    return tuple(reads)


@dataclass(frozen=True)
class _View:
    """One view of a ``ViewBatch``, in pixels or sub-pixels."""

    pixel: Int[Tensor, " pixels"]
    taps: Taps
    coverage: Float[Tensor, "pixels 1"]
    shade: Float[Tensor, "pixels 1"]


def _visible(
    mesh: Mesh, opacities: Opacities | None, camera: Camera, size: tuple[int, int], sampling: SamplingModel
) -> Visibility:
    size = (size[0] * sampling.subdivision, size[1] * sampling.subdivision)
    planes = project(mesh, camera, size, cull=sampling.cull)
    drawn, blended = None, None
    if opacities is not None:
        drawn = partial(opacities.drawn, planes)
        blended = None if opacities.blended is None else opacities.blended[planes.face]
    return rasterize(planes, size, sampling.positions, drawn=drawn, blended=blended)


def _prepare_view(
    mesh: Mesh,
    layout: MipLayout,
    opacities: Opacities | None,
    view: View,
    visibility: Visibility,
    size: tuple[int, int],
    sampling: SamplingModel,
) -> _View:
    width, samples = size[1] * sampling.subdivision, sampling.positions
    alpha = None if opacities is None or opacities.blended is None else opacities.of_fragments
    fragments = fragments_of(visibility, mesh, width, samples=samples, shade_at=sampling.shade_at, alpha=alpha)
    n_pixels = len(visibility.pixel)
    normals = (fragments.barycentric.clamp(0, 1)[..., None] * mesh.normals.index_select(0, fragments.face)).sum(1)
    towards = torch.from_numpy(spherical(view.light.azimuth, view.light.elevation)).float().to(normals.device)
    shade = torch.zeros(n_pixels, 1, device=normals.device)
    shade.index_add_(0, fragments.entry, lambert(normals, towards) * fragments.weight[:, None])
    coverage = torch.zeros_like(shade).index_add_(0, fragments.entry, fragments.weight[:, None])
    taps = taps_of(fragments, n_pixels, mesh, layout, sampling)
    return _View(visibility.pixel, taps, coverage, shade / coverage.clamp(min=1e-6))


def _joined(
    numbers: range,
    views: Sequence[_View],
    place: Int[Tensor, " texels"],
    n_texels: int,
    size: tuple[int, int],
    sampling: SamplingModel,
) -> ViewBatch:
    """The ``views`` with ``numbers`` as one operator; texel ``t`` is the read number ``place[t]`` of ``n_texels``."""
    parts = sampling.subdivision
    counts = tuple(len(view.pixel) for view in views)
    taps = Taps(
        torch.cat([view.taps.entry + sum(counts[:k]) for k, view in enumerate(views)]),
        place.index_select(0, torch.cat([view.taps.index for view in views])),
        torch.cat([view.taps.weight for view in views]),
    )
    batch = ViewBatch(
        numbers,
        torch.cat([view.pixel + k * size[0] * size[1] * parts**2 for k, view in enumerate(views)]),
        counts,
        Gather.of(taps, sum(counts), n_texels),
        torch.cat([view.coverage for view in views]),
        torch.cat([view.shade for view in views]),
    )
    return batch if parts == 1 else _filtered(batch, size, sampling)


def _filtered(batch: ViewBatch, size: tuple[int, int], sampling: SamplingModel) -> ViewBatch:
    """A batch of sub-pixels under the reconstruction filter of ``sampling``; ``size``: (H, W) of the image."""
    assert isinstance(batch.gather, Gather)
    shape, parts = (len(batch.views), *size), sampling.subdivision
    kernel = kernel_of(*sampling.kernel, parts)
    pixel_filter, coverage = PixelFilter.of(batch.pixel, batch.coverage, shape, kernel, parts)
    counts = torch.bincount(pixel_filter.pixel // (size[0] * size[1]), minlength=len(batch.views))
    return ViewBatch(
        batch.views,
        pixel_filter.pixel,
        tuple(counts.tolist()),
        FilteredGather(batch.gather, pixel_filter, batch.coverage, 1 / coverage),
        coverage,
        pixel_filter.forward(batch.shade * batch.coverage) / coverage,
        batch,
    )


def refiltered(geometry: Geometry, kernel: tuple[KernelName, float]) -> Geometry:
    """``geometry`` of sub-pixels under another reconstruction filter."""
    sampling = geometry.sampling.but(kernel=kernel)
    sub_pixels = [batch.sub_pixels for batch in geometry.batches]
    batches = tuple(_filtered(batch, geometry.size, sampling) for batch in sub_pixels if batch is not None)
    return replace(geometry, sampling=sampling, batches=batches)


class _RenderViews(Function):
    """Images of a batch of views as an autograd function of the texels; non-finite gradients count as zero.

    masks: saliency that multiplies the image gradient before it flows into the texture (the paper's equation 4).
    """

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        texels: Float[Tensor, "texels 3"],
        surrogate: "Surrogate",
        batch: int,
        masks: Bool[Tensor, "views H W"] | None,
    ) -> Float[Tensor, "batch 3 H W"]:
        some = surrogate.geometry.batches[batch]
        colours, slopes = surrogate.colours(texels.detach(), batch)
        images = surrogate.base[some.views.start : some.views.stop].float().div_(255)
        images.view(-1, 3).index_copy_(0, some.pixel, colours)
        if masks is not None:
            slopes = slopes * some.of(masks).view(-1, *[1] * (slopes.dim() - 1))
        ctx.some, ctx.slopes = some, slopes  # type: ignore[attr-defined]
        return images.permute(0, 3, 1, 2)

    @staticmethod
    def backward(ctx: FunctionCtx, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        some: ViewBatch = ctx.some  # type: ignore[attr-defined]
        slopes: Tensor = ctx.slopes  # type: ignore[attr-defined]
        pixels = gradient.permute(0, 2, 3, 1).reshape(-1, 3).index_select(0, some.pixel).nan_to_num_(0, 0, 0)
        pulled = pixels.mul_(slopes) if slopes.dim() == 2 else (pixels[:, None, :] @ slopes)[:, 0]
        return some.gather.transpose(pulled), None, None, None


@dataclass(frozen=True)
class Surrogate:
    """A differentiable model of the target renderer for fixed views.

    base: (views, H, W, 3) uint8, colours of the pixels without object. shadings: colour model of each batch of views.
    missed: true minus predicted colours of the unpainted object without anchoring; ``None`` without target images.
    """

    geometry: Geometry
    model: str
    base: UInt8[Tensor, "views H W 3"]
    shadings: tuple[Shading, ...]
    missed: tuple[Float[Tensor, "pixels 3"], ...] | None = None
    _canvases: list[tuple[list[Tensor], list[Tensor], Canvas]] = field(
        default_factory=list, init=False, repr=False, compare=False
    )
    """The last canvas with its textures and masks."""

    @property
    def n_views(self) -> int:
        """Number of views."""
        return len(self.base)

    @property
    def batches(self) -> tuple[range, ...]:
        """The views of each batch."""
        return tuple(batch.views for batch in self.geometry.batches)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the images."""
        return self.geometry.size

    @property
    def textures(self) -> tuple[str, ...]:
        """Names of the textures."""
        return self.geometry.textures

    @property
    def n_texels(self) -> int:
        """Number of texels read by any view."""
        return sum(map(len, self.geometry.reads))

    @property
    def device(self) -> torch.device:
        """Device of the operators."""
        return self.geometry.device

    def texels(self, textures: Mapping[str, Float[Tensor, "H W 3"]]) -> Float[Tensor, "texels 3"]:
        """The texels read from ``textures`` (sRGB in [0, 1], row 0 on top). Differentiable; call it once per step."""
        return self.geometry.values(textures)

    def canvas(
        self, textures: Mapping[str, Float[Tensor, "H W 3"]], moving: Mapping[str, Bool[Tensor, "h w"]]
    ) -> Canvas:
        """The tiles of ``textures`` with a ``moving`` texel or block of texels; ``canvas.read`` is a cheaper
        ``texels``.

        The last canvas is cached, because an attack asks for the same one every few steps.
        """
        geometry, linear = self.geometry, self.geometry.sampling.filtered == "linear"
        whole, masks = ([table[name] for name in geometry.textures] for table in (textures, moving))
        for textures_before, masks_before, canvas in self._canvases:
            if all(map(operator.is_, textures_before, whole)) and all(map(torch.equal, masks_before, masks)):
                return canvas
        rounded = geometry.sampling.mips == "rounded" and not linear
        canvas = canvas_of(whole, masks, geometry.chains, linear=linear, rounded=rounded)
        self._canvases[:] = [(whole, masks, canvas)]
        return canvas

    def render(
        self, texels: Float[Tensor, "texels 3"], batch: int, *, masks: Bool[Tensor, "views H W"] | None = None
    ) -> Float[Tensor, "batch 3 H W"]:
        """Images of the views ``batches[batch]``, sRGB in [0, 1], channels last in memory. Differentiable.

        masks: for all views of the surrogate; pixels outside pass no gradient.
        """
        images: Tensor = _RenderViews.apply(texels, self, batch, masks)  # type: ignore[no-untyped-call]
        return images

    def render_all(self, texels: Float[Tensor, "texels 3"]) -> Float[Tensor, "views 3 H W"]:
        """The images of all views at once."""
        return torch.cat([self.render(texels, batch) for batch in range(len(self.batches))])

    @torch.no_grad()
    def images(self, obj: Object3D) -> UInt8[np.ndarray, "views H W 3"]:
        """Images of ``obj`` in 8 bits, as a target renders them."""
        shown = self.render_all(Painted(obj, self.device).texels(self.geometry))
        images: UInt8[np.ndarray, "views H W 3"] = shown.mul(255).round().byte().permute(0, 2, 3, 1).cpu().numpy()
        return images

    def clean_errors(self) -> tuple[float, ...]:
        """Mean error of the unpainted object's pixels before anchoring, for each view, sRGB in [0, 1] units.

        Zero for views without object and without target images.
        """
        if self.missed is None:
            return (0.0,) * self.n_views
        return tuple(
            float(part.abs().mean()) if len(part) else 0.0
            for batch, missed in zip(self.geometry.batches, self.missed, strict=True)
            for part in torch.split(missed, list(batch.counts))
        )

    def influence(self, masks: Bool[Tensor, "views H W"] | None = None) -> dict[str, Float[Tensor, "H W"]]:
        """Total weight of each texel in the pixels of all views, or in those of ``masks``."""
        geometry, device = self._areas, self.base.device
        ones = [torch.ones(*sizes[0], 1, device=device, requires_grad=True) for sizes in geometry.layout.sizes]
        weights = torch.autograd.grad(read_texels(ones, geometry.chains), ones, geometry.read_weights(masks))
        return {name: weight[..., 0] for name, weight in zip(geometry.textures, weights, strict=True)}

    @property
    def _areas(self) -> Geometry:
        return self.geometry.areas or self.geometry

    @cached_property
    def footprint(self) -> Mapping[str, float]:
        """Texels that a pixel reads of each texture: the geometric mean over all views; 1 for an unseen texture.

        A texture stored twice as finely has four times the footprint.
        """
        found = {}
        for (name, share), sizes in zip(self._level_shares.items(), self.geometry.layout.sizes, strict=True):
            texels = torch.tensor([math.log(sizes[0][0] * sizes[0][1] / (h * w)) for h, w in sizes])
            found[name] = math.exp(float((share * texels).sum()))
        return found

    @cached_property
    def spare_levels(self) -> Mapping[str, int]:
        """Finest mip levels of each texture that views hardly read: less than ``HARDLY`` of their reads, by weight.

        Without mip levels, those below the median of what pixels show: other views read other texels of it.
        """
        least = HARDLY if self.geometry.areas is None else 0.5
        return {name: int((share.cumsum(0) < least).sum()) for name, share in self._level_shares.items()}

    @cached_property
    def _level_shares(self) -> Mapping[str, Float[Tensor, " levels"]]:
        """Shares of each texture's mip levels in its reads, by weight; all of the finest for an unseen texture."""
        return {
            name: each / each.sum() if each.any() else torch.eye(1, len(each))[0]
            for name, each in self.level_weights.items()
        }

    @cached_property
    def level_weights(self) -> Mapping[str, Float[Tensor, " levels"]]:
        """Total weight of the reads of each texture's mip levels in the pixels of all views, on the CPU."""
        geometry = self._areas
        by_level = iter(torch.split(geometry.read_weights()[:, 0].cpu(), [len(level) for level in geometry.reads]))
        weights = [torch.stack([next(by_level).sum() for _ in sizes]) for sizes in geometry.layout.sizes]
        return dict(zip(geometry.textures, weights, strict=True))

    def spread(self, pixels: Float[Tensor, "pixels 3"], batch: int) -> Float[Tensor, "texels 3"]:
        """Weighted sums of a batch's ``pixels`` at each texel read: the transpose of the texels' gathering."""
        return self.geometry.batches[batch].gather.transpose(pixels)

    def colours(self, texels: Float[Tensor, "texels 3"], batch: int) -> tuple[Float[Tensor, "pixels 3"], Tensor]:
        """(Colours of a batch's object pixels, their derivative by the pixel's texture value as in ``Shading``)."""
        values = self.geometry.batches[batch].gather.forward(texels)
        if self.geometry.sampling.filtered != "linear":
            return self.shadings[batch](values)
        encoded, rate = encode.with_slope(values.clamp_(0, 1))
        colour, slope = self.shadings[batch](encoded)
        return colour, slope * (rate if slope.dim() == 2 else rate[:, None, :])


def diffuse_surrogate(
    geometry: Geometry, views: Sequence[View], *, backdrops: Mapping[str, Image8] = NO_BACKDROPS
) -> Surrogate:
    """The paper's surrogate; it needs no image of the target. ``views``: those of ``geometry``.

    backdrops: pictures behind the object by the name in a view, (H, W, 3) uint8.
    """
    base = _behind(geometry, views, backdrops)
    shadings = tuple(
        DiffuseShading(batch.shade * batch.coverage, (1 - batch.coverage) * (batch.of(base) / 255))
        for batch in geometry.batches
    )
    return Surrogate(geometry, "diffuse", base, shadings)


def behind(
    views: Sequence[View], backdrops: Mapping[str, Image8], size: tuple[int, int]
) -> UInt8[np.ndarray, "views H W 3"]:
    """The background of each view: its colour, or its picture from ``backdrops``."""
    images = np.empty((len(views), *size, 3), np.uint8)
    for image, view in zip(images, views, strict=True):
        image[:] = view.background if view.backdrop is None else backdrops[view.backdrop]
    return images


def _behind(geometry: Geometry, views: Sequence[View], backdrops: Mapping[str, Image8]) -> UInt8[Tensor, "views H W 3"]:
    return torch.from_numpy(behind(views, backdrops, geometry.size)).to(geometry.device)


def curve_surrogate(
    geometry: Geometry,
    obj: Object3D | Painted,
    views: Sequence[View],
    clean: Image8,
    greys: Sequence[int],
    probes: Image8,
    *,
    tone: ToneMap | None = None,
    backdrops: Mapping[str, Image8] = NO_BACKDROPS,
) -> Surrogate:
    """A surrogate measured on the target: ``calibrated`` with two greys, ``curve`` with more.

    clean: the target's images of ``obj``, (views, H, W, 3) uint8. greys: encoded values, ascending, the first 0.
    probes: the target's images of ``obj`` painted in each grey, (greys, views, H, W, 3) uint8. tone: for a sampling
    model with ``encoding`` "measured", with two greys. backdrops: as for ``diffuse_surrogate``.
    """
    base = torch.from_numpy(np.ascontiguousarray(clean)).to(geometry.device)
    shown = [torch.from_numpy(probe).to(base.device) for probe in probes]
    uncovered = _behind(geometry, views, backdrops)
    texels = painted(obj, geometry.device).texels(geometry)
    tone = tone if tone is None else tone.to(geometry.device)
    by_chord, encoding = geometry.sampling.slope == "chord" and len(greys) == 2, geometry.sampling.encoding
    levels = torch.tensor(list(greys), dtype=torch.uint8, device=base.device)
    shadings: list[Shading] = []
    for batch in geometry.batches:
        chord = Chord(batch.of(base), _albedo(geometry, batch, texels)) if by_chord else None
        coverage, background = batch.coverage, batch.of(uncovered) / 255
        if geometry.sampling.edges == "linear":  # the light behind a pixel's uncovered share is part of its light
            coverage, background = torch.ones_like(coverage), torch.zeros_like(background)
        seen = torch.stack([batch.of(probe) for probe in shown])
        if encoding == "measured":
            if tone is None or len(greys) != 2:
                raise ValueError("a measured tone curve needs a `tone` and two greys")
            shadings.append(fit_tone(greys[1], seen, coverage, background, tone, chord))
        else:
            shadings.append(fit_curve(levels, seen, coverage, background, encoding, chord))
    plain = Surrogate(geometry, "calibrated" if len(greys) == 2 else "curve", base, tuple(shadings))
    return _anchored(plain, texels)


def _albedo(geometry: Geometry, batch: ViewBatch, texels: Float[Tensor, "texels 3"]) -> Float[Tensor, "pixels 3"]:
    """Linear albedo of a batch's object pixels."""
    values = batch.gather.forward(texels).clamp_(0, 1)
    return values if geometry.sampling.filtered == "linear" else decode(values)


def _anchored(plain: Surrogate, texels: Float[Tensor, "texels 3"]) -> Surrogate:
    """``plain`` anchored to the target's image of the unpainted object, whose ``texels`` these are.

    The target's image is rounded to 8 bits: a prediction that rounds to it stays, any other is shifted until it does.
    """
    missed = tuple(
        batch.of(plain.base) / 255 - plain.colours(texels, number)[0]
        for number, batch in enumerate(plain.geometry.batches)
    )
    anchored = tuple(
        replace(shading, shift=shading.shift + softshrink(miss, SAME_LEVEL))
        for shading, miss in zip(plain.shadings, missed, strict=True)
    )
    return replace(plain, shadings=anchored, missed=missed)


SAME_LEVEL = 0.499 / 255
"""Largest distance of a prediction to the 8-bit value it rounds to."""


def painted(obj: Object3D | Painted, device: torch.device) -> Painted:
    """The textures of ``obj``, which may know them already."""
    return obj if isinstance(obj, Painted) else Painted(obj, device)


def textures_of(obj: Object3D, *, device: torch.device | str = "cpu") -> dict[str, Float[Tensor, "H W 3"]]:
    """The albedo textures of ``obj`` as sRGB floats in [0, 1], row 0 on top."""
    return {name: tensor_of(image).to(device).float() / 255 for name, image in obj.textures.items()}


def tensor_of(texture: Image8) -> UInt8[Tensor, "H W 3"]:
    """A texture as a tensor, a flipped or read-only one too: torch refuses or warns of a view of it."""
    return torch.from_numpy(np.require(texture, requirements=("C", "W")))
