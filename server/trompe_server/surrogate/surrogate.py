"""The surrogate renderer: images of a repainted object for fixed views, and their gradients, at the cost of a gather.

geometry = prepare_geometry(obj, views, size=(224, 224), sampling=SamplingModel())
surrogate = curve_surrogate(geometry, obj, views, clean, greys, probes)  # or diffuse_surrogate(geometry, views)
texels = surrogate.texels(textures)
images = surrogate.render(texels, batch=0)  # of the views surrogate.batches[0]; differentiable in the textures
"""

import itertools
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
from trompe_server.surrogate.pyramid import MipChain, MipLayout, mip_chains, mip_layout, read_texels
from trompe_server.surrogate.rasterize import Mesh, mesh_of, project, rasterize
from trompe_server.surrogate.sampling import AlphaTest, Gather, SamplingModel, Taps, fragments_of, taps_of
from trompe_server.surrogate.shading import CurveShading, DiffuseShading, Shading, decode, encode, fit_curve, lambert
from trompe_shared.geometry import View, spherical
from trompe_shared.object3d import Object3D

__all__ = [
    "BATCH",
    "NO_BACKDROPS",
    "Geometry",
    "Surrogate",
    "ViewBatch",
    "behind",
    "curve_surrogate",
    "diffuse_surrogate",
    "prepare_geometry",
    "textures_of",
]

Image8 = NDArray[np.uint8]


NO_BACKDROPS: Final[Mapping[str, Image8]] = {}

BATCH = 10
"""Views that are one operator: the fastest on CPUs (larger batches miss the caches)."""


@dataclass(frozen=True)
class ViewBatch:
    """Some successive views, rasterised: their object pixels, what they read, and how the paper's light shades them.

    pixel: (view * H + row) * W + column, the views of the batch counted from 0. counts: object pixels of each view.
    """

    views: range
    pixel: Int[Tensor, " pixels"]
    counts: tuple[int, ...]
    gather: Gather
    coverage: Float[Tensor, "pixels 1"]
    shade: Float[Tensor, "pixels 1"]

    def of(self, images: Shaped[Tensor, "views H W ..."]) -> Shaped[Tensor, "pixels ..."]:
        """What ``images`` of all views show at the object's pixels of these, (pixels, ...)."""
        return images[self.views.start : self.views.stop].flatten(0, 2).index_select(0, self.pixel)


@dataclass(frozen=True)
class Geometry:
    """All views of one object under one sampling hypothesis. ``size`` is (H, W).

    reads: of each mip level in the layout's order, the texels that some view reads, in the order in which views first
    do: what lies side by side in an image does so in memory. These alone, one level after the other, are what the
    operators know as ``texels``.
    """

    textures: tuple[str, ...]
    layout: MipLayout
    reads: tuple[Int[Tensor, " _"], ...]
    sampling: SamplingModel
    size: tuple[int, int]
    batches: tuple[ViewBatch, ...]

    def texels(self, textures: Sequence[Float[Tensor, "H W 3"]], *, rounded: bool = False) -> Float[Tensor, "texels 3"]:
        """The texels that some view reads of the mip levels of ``textures``. Differentiable."""
        return read_texels(textures, self.chains, rounded=rounded)

    @cached_property
    def chains(self) -> list[MipChain]:
        """The mip levels of each texture, with what is read of them."""
        return mip_chains(self.layout, self.reads)

    @property
    def device(self) -> torch.device:
        """Where the operators lie."""
        return self.reads[0].device

    @property
    def nbytes(self) -> int:
        """Memory of the operators."""
        return sum(batch.gather.nbytes + batch.pixel.nbytes for batch in self.batches)


def prepare_geometry(
    obj: Object3D,
    views: Sequence[View],
    *,
    size: tuple[int, int],
    sampling: SamplingModel,
    device: torch.device | str = "cpu",
) -> Geometry:
    """Rasterise ``obj`` once for all ``views`` and images of ``size`` (H, W)."""
    mesh = mesh_of(obj, device=device)
    layout = mip_layout([obj.textures[name].shape[:2] for name in mesh.textures])
    test = AlphaTest.of(mesh, sampling)
    prepared = [_prepare_view(mesh, layout, test, view, size, sampling) for view in views]
    reads = _in_order_of_reading([view.taps.index for view in prepared], layout)
    starts = itertools.chain.from_iterable(layout.starts)
    texels = torch.cat([level + start for level, start in zip(reads, starts, strict=True)])
    place = torch.empty(layout.total, dtype=torch.int32, device=device)
    place[texels] = torch.arange(len(texels), dtype=torch.int32, device=device)
    numbers = [range(first, min(first + BATCH, len(views))) for first in range(0, len(views), BATCH)]
    batches = tuple(_joined(some, prepared[some.start : some.stop], place, len(texels), size) for some in numbers)
    return Geometry(mesh.textures, layout, reads, sampling, size, batches)


NEVER: Final = torch.iinfo(torch.int64).max


def _in_order_of_reading(taps: Sequence[Int[Tensor, " taps"]], layout: MipLayout) -> tuple[Int[Tensor, " _"], ...]:
    """Of each mip level the texels that the ``taps`` of some view read, those first that are read first."""
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
    """One view, as ``ViewBatch`` has several."""

    pixel: Int[Tensor, " pixels"]
    taps: Taps
    coverage: Float[Tensor, "pixels 1"]
    shade: Float[Tensor, "pixels 1"]


def _prepare_view(
    mesh: Mesh,
    layout: MipLayout,
    test: AlphaTest | None,
    view: View,
    size: tuple[int, int],
    sampling: SamplingModel,
) -> _View:
    planes = project(mesh, view.camera, size, cull=sampling.cull)
    drawn = None if test is None else partial(test.drawn, planes)
    visibility = rasterize(planes, size, sampling.positions, drawn=drawn)
    fragments = fragments_of(visibility, mesh, size[1], samples=sampling.positions, shade_at=sampling.shade_at)
    n_pixels = len(visibility.pixel)
    normals = (fragments.barycentric.clamp(0, 1)[..., None] * mesh.normals[fragments.face]).sum(1)
    towards = torch.from_numpy(spherical(view.light.azimuth, view.light.elevation)).float().to(normals.device)
    shade = torch.zeros(n_pixels, 1, device=normals.device)
    shade.index_add_(0, fragments.entry, lambert(normals, towards) * fragments.weight[:, None])
    coverage = torch.zeros_like(shade).index_add_(0, fragments.entry, fragments.weight[:, None])
    taps = taps_of(fragments, n_pixels, mesh, layout, sampling)
    return _View(visibility.pixel, taps, coverage, shade / coverage.clamp(min=1e-6))


def _joined(
    numbers: range, views: Sequence[_View], place: Int[Tensor, " texels"], n_texels: int, size: tuple[int, int]
) -> ViewBatch:
    """``views``, which are those of ``numbers``, as one operator that finds texel ``t`` of those read, of which there
    are ``n_texels``, at ``place[t]``."""
    counts = tuple(len(view.pixel) for view in views)
    taps = Taps(
        torch.cat([view.taps.entry + sum(counts[:k]) for k, view in enumerate(views)]),
        place.index_select(0, torch.cat([view.taps.index for view in views])),
        torch.cat([view.taps.weight for view in views]),
    )
    return ViewBatch(
        numbers,
        torch.cat([view.pixel + k * size[0] * size[1] for k, view in enumerate(views)]),
        counts,
        Gather.of(taps, sum(counts), n_texels),
        torch.cat([view.coverage for view in views]),
        torch.cat([view.shade for view in views]),
    )


class _RenderViews(Function):
    """Images of a batch of views from the texels, with the gradient's way back (where that is not finite, as zero).

    ``masks`` (saliency), where given, multiplies the image gradient before it flows into the texture (the paper's
    equation 4).
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
            slopes = slopes * some.of(masks)[:, None]
        ctx.some, ctx.slopes = some, slopes  # type: ignore[attr-defined]
        return images.permute(0, 3, 1, 2)

    @staticmethod
    def backward(ctx: FunctionCtx, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        some: ViewBatch = ctx.some  # type: ignore[attr-defined]
        pixels = gradient.permute(0, 2, 3, 1).reshape(-1, 3).index_select(0, some.pixel).nan_to_num_(0, 0, 0)
        return some.gather.transpose(pixels.mul_(ctx.slopes)), None, None, None  # type: ignore[attr-defined]


@dataclass(frozen=True)
class _Painted:
    """A canvas, and what it was made for."""

    textures: Sequence[Float[Tensor, "H W 3"]]
    moving: Sequence[Bool[Tensor, "H W"]]
    canvas: Canvas

    def fits(self, textures: Sequence[Float[Tensor, "H W 3"]], moving: Sequence[Bool[Tensor, "H W"]]) -> bool:
        """Whether it is the one for these textures, which must be the same tensors."""
        return all(map(operator.is_, self.textures, textures)) and all(map(torch.equal, self.moving, moving))


@dataclass(frozen=True)
class Surrogate:
    """A differentiable model of the target renderer for fixed views.

    base: (views, H, W, 3) uint8, what every pixel shows that the object does not touch.
    shadings: the colour model of each batch of views. missed: true minus predicted colours of the unpainted object, as
    the colour model alone would have it; ``None`` where the target has not been asked.
    """

    geometry: Geometry
    model: str
    base: UInt8[Tensor, "views H W 3"]
    shadings: tuple[Shading, ...]
    missed: tuple[Float[Tensor, "pixels 3"], ...] | None = None
    _last_canvas: list["_Painted"] = field(default_factory=list, init=False, repr=False, compare=False)

    @property
    def n_views(self) -> int:
        """How many views it knows."""
        return len(self.base)

    @property
    def batches(self) -> tuple[range, ...]:
        """The views of each batch."""
        return tuple(batch.views for batch in self.geometry.batches)

    def texels(self, textures: Mapping[str, Float[Tensor, "H W 3"]]) -> Float[Tensor, "texels 3"]:
        """What the views read of ``textures`` (sRGB in [0, 1], row 0 on top). Differentiable; do it once a step."""
        ordered = [textures[name] for name in self.geometry.textures]
        if self.geometry.sampling.filtered == "linear":
            return self.geometry.texels([decode(texture) for texture in ordered])
        return self.geometry.texels(ordered, rounded=self.geometry.sampling.mips == "rounded")

    def canvas(
        self, textures: Mapping[str, Float[Tensor, "H W 3"]], moving: Mapping[str, Bool[Tensor, "H W"]]
    ) -> Canvas:
        """What may move of ``textures``: the tiles that hold a texel which is ``moving``. ``canvas.read`` is then a
        cheaper ``texels``. An attack asks for the same one every few steps: the last one is kept."""
        geometry, linear = self.geometry, self.geometry.sampling.filtered == "linear"
        whole, masks = ([table[name] for name in geometry.textures] for table in (textures, moving))
        if not (self._last_canvas and self._last_canvas[0].fits(whole, masks)):
            rounded = geometry.sampling.mips == "rounded" and not linear
            canvas = canvas_of(whole, masks, geometry.chains, linear=linear, rounded=rounded)
            self._last_canvas[:] = [_Painted(whole, masks, canvas)]
        return self._last_canvas[0].canvas

    def render(
        self, texels: Float[Tensor, "texels 3"], batch: int, *, masks: Bool[Tensor, "views H W"] | None = None
    ) -> Float[Tensor, "batch 3 H W"]:
        """Images of the views ``batches[batch]`` (sRGB in [0, 1]; channels last in memory), differentiable in
        ``texels``.

        ``masks`` has a row for every view of the surrogate; pixels outside of it pass no gradient.
        """
        images: Tensor = _RenderViews.apply(texels, self, batch, masks)  # type: ignore[no-untyped-call]
        return images

    def render_all(
        self, texels: Float[Tensor, "texels 3"], *, masks: Bool[Tensor, "views H W"] | None = None
    ) -> Float[Tensor, "views 3 H W"]:
        """The images of all views at once."""
        return torch.cat([self.render(texels, batch, masks=masks) for batch in range(len(self.batches))])

    def clean_errors(self) -> tuple[float, ...]:
        """Per view the mean error of the unpainted object's pixels before anchoring, sRGB in [0, 1] units.

        Zero where a view shows no object, and where the target has not been asked.
        """
        if self.missed is None:
            return (0.0,) * self.n_views
        per_view = [
            part.abs().mean() if len(part) else part.new_zeros(())
            for batch, missed in zip(self.geometry.batches, self.missed, strict=True)
            for part in torch.split(missed, list(batch.counts))
        ]
        return tuple(float(error) for error in per_view)

    def influence(self, masks: Bool[Tensor, "views H W"] | None = None) -> dict[str, Float[Tensor, "H W"]]:
        """Total weight with which the pixels of all views (those of ``masks`` alone, where given) read each texel."""
        geometry, device = self.geometry, self.base.device
        ones = [torch.ones(*sizes[0], 3, device=device, requires_grad=True) for sizes in geometry.layout.sizes]
        texels = geometry.texels(ones)
        total = torch.zeros_like(texels)
        for batch in geometry.batches:
            seen = torch.ones(len(batch.pixel), 3, device=device)
            total += batch.gather.transpose(seen if masks is None else seen * batch.of(masks)[:, None])
        weights = torch.autograd.grad(texels, ones, total)
        return {name: weight[..., 0] for name, weight in zip(geometry.textures, weights, strict=True)}

    def colours(
        self, texels: Float[Tensor, "texels 3"], batch: int
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3"]]:
        """Colours of a batch's object pixels, and their derivative by the texture value each pixel reads."""
        values = self.geometry.batches[batch].gather.forward(texels)
        if self.geometry.sampling.filtered != "linear":
            return self.shadings[batch](values)
        encoded, rate = encode.with_slope(values.clamp_(0, 1))
        colour, slope = self.shadings[batch](encoded)
        return colour, slope * rate


def diffuse_surrogate(
    geometry: Geometry, views: Sequence[View], *, backdrops: Mapping[str, Image8] = NO_BACKDROPS
) -> Surrogate:
    """The paper's surrogate: asks nothing of the target. ``views`` are those of ``geometry``.

    ``backdrops`` are the pictures that stand behind the object where a view has one, (H, W, 3) uint8 by name.
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
    """What each view shows where there is no object: its background, or the picture of ``backdrops`` that it names."""
    images = np.empty((len(views), *size, 3), np.uint8)
    for image, view in zip(images, views, strict=True):
        image[:] = view.background if view.backdrop is None else backdrops[view.backdrop]
    return images


def _behind(geometry: Geometry, views: Sequence[View], backdrops: Mapping[str, Image8]) -> UInt8[Tensor, "views H W 3"]:
    return torch.from_numpy(behind(views, backdrops, geometry.size)).to(geometry.device)


def curve_surrogate(
    geometry: Geometry,
    obj: Object3D,
    views: Sequence[View],
    clean: Image8,
    greys: Sequence[int],
    probes: Image8,
    *,
    backdrops: Mapping[str, Image8] = NO_BACKDROPS,
) -> Surrogate:
    """A surrogate measured on the target: ``calibrated`` with two greys, ``curve`` with more.

    clean: the target's images of ``obj``, (views, H, W, 3) uint8. greys: encoded values, ascending, the first 0.
    probes: the target's images of ``obj`` painted in each grey, (greys, views, H, W, 3) uint8. ``backdrops`` as for
    ``diffuse_surrogate``.
    """
    base = torch.from_numpy(clean).to(geometry.device)
    levels = torch.tensor(list(greys), dtype=torch.uint8, device=base.device)
    uncovered = _behind(geometry, views, backdrops)
    shadings = [
        fit_curve(
            levels,
            torch.stack([batch.of(torch.from_numpy(probe).to(base.device)) for probe in probes]),
            batch.coverage,
            batch.of(uncovered) / 255,
            geometry.sampling.encoding,
        )
        for batch in geometry.batches
    ]
    plain = Surrogate(geometry, "calibrated" if len(greys) == 2 else "curve", base, tuple(shadings))
    return _anchored(plain, obj, shadings)


def _anchored(plain: Surrogate, obj: Object3D, shadings: Sequence[CurveShading]) -> Surrogate:
    """``plain``, whose ``shadings`` these are, made to predict the unpainted object as the target shows it.

    The target's image is rounded to 8 bits: a prediction that would be rounded to it is believed as it is, any other is
    shifted until it would.
    """
    texels = plain.texels(textures_of(obj, device=plain.base.device))
    missed = tuple(
        batch.of(plain.base) / 255 - plain.colours(texels, number)[0]
        for number, batch in enumerate(plain.geometry.batches)
    )
    anchored = tuple(
        shading.anchored(softshrink(miss, SAME_LEVEL)) for shading, miss in zip(shadings, missed, strict=True)
    )
    return replace(plain, shadings=anchored, missed=missed)


SAME_LEVEL = 0.499 / 255
"""A prediction this near to an 8-bit value is rounded to it."""


def textures_of(obj: Object3D, *, device: torch.device | str = "cpu") -> dict[str, Float[Tensor, "H W 3"]]:
    """The albedo textures of ``obj`` as sRGB floats in [0, 1], row 0 on top."""
    return {name: torch.from_numpy(image).to(device).float() / 255 for name, image in obj.textures.items()}
