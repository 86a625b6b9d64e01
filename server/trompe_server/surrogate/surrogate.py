"""The surrogate renderer: images of a repainted object for fixed views, and their gradients, at the cost of a gather.

geometry = prepare_geometry(obj, views, size=(224, 224), sampling=SamplingModel())
surrogate = curve_surrogate(geometry, obj, views, clean, greys, probes)  # or diffuse_surrogate(geometry, views)
images = surrogate.render(surrogate.texels(textures), batch=[0, 1])  # differentiable in the textures
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import FunctionCtx

from trompe_server.surrogate.rasterize import Mesh, mesh_of, project, rasterize
from trompe_server.surrogate.sampling import (
    Gather,
    MipLayout,
    SamplingModel,
    fragments_of,
    gather_of,
    mip_layout,
    mip_pyramid,
)
from trompe_server.surrogate.shading import DiffuseShading, Shading, decode, decode_slope, encode, fit_curve, lambert
from trompe_shared.geometry import View, spherical
from trompe_shared.object3d import Object3D

__all__ = [
    "Geometry",
    "Surrogate",
    "ViewGeometry",
    "curve_surrogate",
    "diffuse_surrogate",
    "prepare_geometry",
    "textures_of",
]

Image8 = NDArray[np.uint8]


@dataclass(frozen=True)
class ViewGeometry:
    """One view, rasterised: its object pixels (row * W + column), what they read, and how the paper's light shades
    them."""

    pixel: Int[Tensor, " pixels"]
    gather: Gather
    coverage: Float[Tensor, "pixels 1"]
    shade: Float[Tensor, "pixels 1"]


@dataclass(frozen=True)
class Geometry:
    """All views of one object under one sampling hypothesis. ``size`` is (H, W)."""

    textures: tuple[str, ...]
    layout: MipLayout
    sampling: SamplingModel
    size: tuple[int, int]
    views: tuple[ViewGeometry, ...]

    @property
    def nbytes(self) -> int:
        """Memory of the operators."""
        return sum(view.gather.nbytes + view.pixel.nbytes for view in self.views)


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
    prepared = tuple(_prepare_view(mesh, layout, view, size, sampling) for view in views)
    return Geometry(mesh.textures, layout, sampling, size, prepared)


def _prepare_view(
    mesh: Mesh, layout: MipLayout, view: View, size: tuple[int, int], sampling: SamplingModel
) -> ViewGeometry:
    planes = project(mesh, view.camera, size, cull=sampling.cull)
    visibility = rasterize(planes, size, sampling.positions)
    fragments = fragments_of(visibility, mesh, size[1], samples=sampling.positions, shade_at=sampling.shade_at)
    n_pixels = len(visibility.pixel)
    normals = (fragments.barycentric.clamp(0, 1)[..., None] * mesh.normals[fragments.face]).sum(1)
    towards = torch.from_numpy(spherical(view.light.azimuth, view.light.elevation)).float().to(normals.device)
    shade = torch.zeros(n_pixels, 1, device=normals.device)
    shade.index_add_(0, fragments.entry, lambert(normals, towards) * fragments.weight[:, None])
    coverage = torch.zeros_like(shade).index_add_(0, fragments.entry, fragments.weight[:, None])
    return ViewGeometry(
        visibility.pixel,
        gather_of(fragments, n_pixels, mesh, layout, sampling),
        coverage,
        shade / coverage.clamp(min=1e-6),
    )


class _RenderViews(Function):
    """Images of some views from the flat texel array, with the gradient's way back.

    ``masks`` (saliency), where given, multiplies the image gradient before it flows into the texture (the paper's
    equation 4).
    """

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        texels: Float[Tensor, "texels 3"],
        surrogate: "Surrogate",
        batch: Sequence[int],
        masks: Bool[Tensor, "views H W"] | None,
    ) -> Float[Tensor, "batch 3 H W"]:
        images = surrogate.base[list(batch)].float().div_(255).flatten(1, 2)  # (batch, H * W, 3)
        slopes = []
        for image, index in zip(images, batch, strict=True):
            colour, slope = surrogate.colours(texels, index)
            image[surrogate.geometry.views[index].pixel] = colour
            slopes.append(slope)
        ctx.surrogate, ctx.batch, ctx.masks, ctx.slopes = surrogate, batch, masks, slopes  # type: ignore[attr-defined]
        ctx.n_texels = len(texels)  # type: ignore[attr-defined]
        return images.view(len(batch), *surrogate.geometry.size, 3).permute(0, 3, 1, 2)

    @staticmethod
    def backward(ctx: FunctionCtx, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        surrogate, masks = ctx.surrogate, ctx.masks  # type: ignore[attr-defined]
        per_view = gradient.permute(0, 2, 3, 1).flatten(1, 2)
        total = gradient.new_zeros(ctx.n_texels, 3)  # type: ignore[attr-defined]
        for image, index, slope in zip(per_view, ctx.batch, ctx.slopes, strict=True):  # type: ignore[attr-defined]
            view = surrogate.geometry.views[index]
            pixels = image[view.pixel] * slope
            if masks is not None:
                pixels *= masks[index].flatten()[view.pixel, None]
            view.gather.add_transpose(pixels, total)
        return total, None, None, None


@dataclass(frozen=True)
class Surrogate:
    """A differentiable model of the target renderer for fixed views.

    base: (views, H, W, 3) uint8, what every pixel shows that the object does not touch.
    shadings: the colour model of each view. anchors: per view, added to the predicted colours of the object's pixels,
    so that the unpainted object is predicted as the target shows it; ``None`` where the target has not been asked.
    """

    geometry: Geometry
    model: str
    base: UInt8[Tensor, "views H W 3"]
    shadings: tuple[Shading, ...]
    anchors: tuple[Float[Tensor, "pixels 3"], ...] | None = None

    @property
    def n_views(self) -> int:
        """How many views it knows."""
        return len(self.geometry.views)

    def texels(self, textures: Mapping[str, Float[Tensor, "H W 3"]]) -> Float[Tensor, "texels 3"]:
        """The flat mip pyramids of ``textures`` (sRGB in [0, 1], row 0 on top). Differentiable; do it once a step."""
        ordered = [textures[name] for name in self.geometry.textures]
        linear = self.geometry.sampling.filtered == "linear"
        if linear:
            return mip_pyramid([decode(texture) for texture in ordered], self.geometry.layout)
        return mip_pyramid(ordered, self.geometry.layout, rounded=self.geometry.sampling.mips == "rounded")

    def render(
        self,
        texels: Float[Tensor, "texels 3"],
        batch: Sequence[int],
        *,
        masks: Bool[Tensor, "views H W"] | None = None,
    ) -> Float[Tensor, "batch 3 H W"]:
        """Images of the views ``batch`` (sRGB in [0, 1]; channels last in memory), differentiable in ``texels``.

        ``masks`` has a row for every view of the surrogate; pixels outside of it pass no gradient.
        """
        images: Tensor = _RenderViews.apply(texels, self, list(batch), masks)  # type: ignore[no-untyped-call]
        return images

    def influence(self, masks: Bool[Tensor, "views H W"] | None = None) -> dict[str, Float[Tensor, "H W"]]:
        """Total weight with which the pixels of all views (those of ``masks`` alone, where given) read each texel."""
        layout = self.geometry.layout
        device = self.base.device
        ones = [torch.ones(*sizes[0], 3, device=device, requires_grad=True) for sizes in layout.sizes]
        texels = mip_pyramid(ones, layout)
        total = torch.zeros_like(texels)
        for index, view in enumerate(self.geometry.views):
            seen = torch.ones(len(view.pixel), 3, device=device)
            if masks is not None:
                seen *= masks[index].flatten()[view.pixel, None]
            view.gather.add_transpose(seen, total)
        weights = torch.autograd.grad(texels, ones, total)
        return {name: weight[..., 0] for name, weight in zip(self.geometry.textures, weights, strict=True)}

    def colours(
        self, texels: Float[Tensor, "texels 3"], view: int
    ) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 3"]]:
        """Colours of a view's object pixels, and their derivative by the texture value each pixel reads."""
        values = self.geometry.views[view].gather.forward(texels)
        if self.geometry.sampling.filtered == "linear":
            values = encode(values.clamp(0, 1))
        colour, slope = self.shadings[view](values.clamp(0, 1))
        if self.geometry.sampling.filtered == "linear":
            slope = slope / decode_slope(values, decode(values)).clamp(min=1e-6)
        if self.anchors is not None:
            colour = colour + self.anchors[view]
            slope = slope * ((colour >= 0) & (colour <= 1))
        return colour.clamp(0, 1), slope


def diffuse_surrogate(geometry: Geometry, views: Sequence[View], *, backdrop: Image8 | None = None) -> Surrogate:
    """The paper's surrogate: asks nothing of the target. ``views`` are those of ``geometry``.

    ``backdrop`` (H, W, 3) uint8 is what stands behind the object in place of the views' uniform backgrounds.
    """
    base = _behind(geometry, views, backdrop)
    shadings = tuple(
        DiffuseShading(view.shade, view.coverage, behind.flatten(0, 1)[view.pixel].float() / 255)
        for view, behind in zip(geometry.views, base, strict=True)
    )
    return Surrogate(geometry, "diffuse", base, shadings)


def _behind(geometry: Geometry, views: Sequence[View], backdrop: Image8 | None) -> UInt8[Tensor, "views H W 3"]:
    """What each view shows where there is no object."""
    colours = np.array([view.background for view in views], np.uint8)[:, None, None, :]
    full = np.broadcast_to(colours if backdrop is None else backdrop, (len(views), *geometry.size, 3))
    return torch.from_numpy(full.copy()).to(geometry.views[0].pixel.device)


def curve_surrogate(
    geometry: Geometry,
    obj: Object3D,
    views: Sequence[View],
    clean: Image8,
    greys: Sequence[int],
    probes: Image8,
    *,
    backdrop: Image8 | None = None,
) -> Surrogate:
    """A surrogate measured on the target: ``calibrated`` with two greys, ``curve`` with more.

    clean: the target's images of ``obj``, (views, H, W, 3) uint8. greys: encoded values, ascending, the first 0.
    probes: the target's images of ``obj`` painted in each grey, (greys, views, H, W, 3) uint8. ``backdrop`` as for
    ``diffuse_surrogate``.
    """
    device = geometry.views[0].pixel.device
    levels = torch.tensor(list(greys), dtype=torch.uint8, device=device)
    images = torch.from_numpy(probes).to(device).flatten(2, 3)
    behind = _behind(geometry, views, backdrop).flatten(1, 2)
    shadings = tuple(
        fit_curve(
            levels,
            images[:, index, view.pixel],
            view.coverage,
            behind[index, view.pixel].float() / 255,
            geometry.sampling.encoding,
        )
        for index, view in enumerate(geometry.views)
    )
    base = torch.from_numpy(clean).to(device)
    plain = Surrogate(geometry, "calibrated" if len(greys) == 2 else "curve", base, shadings)
    return replace(plain, anchors=_anchors(plain, obj))


def textures_of(obj: Object3D, *, device: torch.device | str = "cpu") -> dict[str, Float[Tensor, "H W 3"]]:
    """The albedo textures of ``obj`` as sRGB floats in [0, 1], row 0 on top."""
    return {name: torch.from_numpy(image).to(device).float() / 255 for name, image in obj.textures.items()}


def _anchors(surrogate: Surrogate, obj: Object3D) -> tuple[Float[Tensor, "pixels 3"], ...]:
    """True minus predicted colours of the unpainted object."""
    texels = surrogate.texels(textures_of(obj, device=surrogate.base.device))
    true = surrogate.base.flatten(1, 2)
    return tuple(
        true[index, view.pixel].float() / 255 - surrogate.colours(texels, index)[0]
        for index, view in enumerate(surrogate.geometry.views)
    )
