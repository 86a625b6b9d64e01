"""PyTorch3D on the bench's work, as the paper used it: one face per pixel, no blur, soft Phong shading.

An optional peer. Import this module only where PyTorch3D is installed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from pytorch3d.renderer import (
    DirectionalLights,
    FoVPerspectiveCameras,
    MeshRasterizer,
    MeshRenderer,
    RasterizationSettings,
    SoftPhongShader,
    TexturesUV,
)
from pytorch3d.structures import Meshes, join_meshes_as_scene
from torch import Tensor

from trompe_server.scene import Scene
from trompe_server.surrogate import Geometry, SamplingModel, Surrogate, textures_of
from trompe_server.surrogate.pyramid import mip_layout
from trompe_server.surrogate.surrogate import BATCH, behind
from trompe_shared.geometry import FIELD_OF_VIEW, View, spherical
from trompe_shared.object3d import Object3D

__all__ = ["PyTorch3DPeer", "PyTorch3DSurrogate", "pytorch3d_surrogate"]

LEVEL = 2
"""Textures are read at this mip level, a quarter of their size: the level that comes nearest to the paper's 0.33."""
NO_SPECULAR = ((0.0, 0.0, 0.0),)
PYTORCH3DS = np.diag([-1.0, 1.0, -1.0])
"""From OpenGL's camera coordinates (x right, looks along -z) to PyTorch3D's (x left, looks along +z)."""


class PyTorch3DPeer:
    """Renders ``obj`` in ``views``, differentiably in its textures, in images of ``size`` (H, W)."""

    def __init__(self, obj: Object3D, views: Sequence[View], size: tuple[int, int]) -> None:
        self.obj, self.n_views = obj, len(views)
        lights = DirectionalLights(direction=[spherical(views[0].light.azimuth, views[0].light.elevation).tolist()])
        self.renderer = _renderer(views, size, lights)
        self.textures = textures_of(obj)

    def forward_backward(self) -> Float[Tensor, "views H W 4"]:
        """One pass over all views and back to the textures; the images it made."""
        leaves = {name: texture.clone().requires_grad_() for name, texture in self.textures.items()}
        images = self.renderer(_meshes(self.obj, leaves).extend(self.n_views))
        images[..., :3].sum().backward()
        found: Tensor = images.detach()
        return found


@dataclass(frozen=True)
class PyTorch3DSurrogate(Surrogate):
    """PyTorch3D in the place of our surrogate renderer, in the same attack: diffuse light from each view's own lamp,
    rasterised anew at every look, as the paper has it. Its texels are those of one mip level; all of them may move.
    """

    obj: Object3D = field(kw_only=True)
    renderers: tuple[MeshRenderer, ...] = field(kw_only=True)

    @property
    def batches(self) -> tuple[range, ...]:
        """See ``Surrogate``."""
        return tuple(range(first, min(first + BATCH, self.n_views)) for first in range(0, self.n_views, BATCH))

    def render(
        self, texels: Float[Tensor, "texels 3"], batch: int, *, masks: Bool[Tensor, "views H W"] | None = None
    ) -> Float[Tensor, "batch 3 H W"]:
        """See ``Surrogate``."""
        views = self.batches[batch]
        seen = self.renderers[batch](_meshes(self.obj, self._tables(texels)).extend(len(views)))
        there = seen[..., 3:] > 0
        if masks is not None:
            shown = masks[views.start : views.stop, ..., None]
            seen = torch.where(shown, seen, seen.detach())
        images = torch.where(there, seen[..., :3].clamp(0, 1), self.base[views.start : views.stop] / 255)
        return images.permute(0, 3, 1, 2)

    def influence(self, masks: Bool[Tensor, "views H W"] | None = None) -> dict[str, Float[Tensor, "H W"]]:
        """No texel is left out: PyTorch3D does not say which it reads."""
        sizes = zip(self.geometry.textures, self.geometry.layout.sizes, strict=True)
        return {name: torch.full(levels[0], torch.inf) for name, levels in sizes}

    def _tables(self, texels: Float[Tensor, "texels 3"]) -> dict[str, Float[Tensor, "H W 3"]]:
        sizes = [levels[LEVEL] for levels in self.geometry.layout.sizes]
        parts = torch.split(texels, [height * width for height, width in sizes])
        return {
            name: part.view(*size, 3) for name, part, size in zip(self.geometry.textures, parts, sizes, strict=True)
        }


def pytorch3d_surrogate(scene: Scene) -> PyTorch3DSurrogate:
    """PyTorch3D for a job's object, views and image size."""
    obj, views, size = scene.obj, scene.views, scene.size
    layout = mip_layout([texture.shape[:2] for texture in obj.textures.values()])
    reads = tuple(
        torch.arange(height * width if level == LEVEL else 0)
        for levels in layout.sizes
        for level, (height, width) in enumerate(levels)
    )
    geometry = Geometry(tuple(obj.textures), layout, reads, SamplingModel(), size, ())
    base = torch.from_numpy(behind(views, scene.backdrops, size))
    parts = [views[first : first + BATCH] for first in range(0, len(views), BATCH)]
    renderers = tuple(_renderer(some, size, _diffuse_lights(some)) for some in parts)
    return PyTorch3DSurrogate(geometry, "PyTorch3D, diffuse", base, (), obj=obj, renderers=renderers)


def _diffuse_lights(views: Sequence[View]) -> DirectionalLights:
    """PyTorch3D's default light without its highlight, from where each view has it."""
    return DirectionalLights(
        direction=[spherical(view.light.azimuth, view.light.elevation).tolist() for view in views],
        specular_color=NO_SPECULAR,
    )


def _renderer(views: Sequence[View], size: tuple[int, int], lights: DirectionalLights) -> MeshRenderer:
    cameras = _cameras(views)
    settings = RasterizationSettings(image_size=size, blur_radius=0.0, faces_per_pixel=1)
    shader = SoftPhongShader(cameras=cameras, lights=lights)
    return MeshRenderer(MeshRasterizer(cameras=cameras, raster_settings=settings), shader)


def _cameras(views: Sequence[View]) -> FoVPerspectiveCameras:
    matrices = [view.camera.world_to_camera() for view in views]
    rotation = np.stack([(PYTORCH3DS @ matrix[:3, :3]).T for matrix in matrices])
    translation = np.stack([PYTORCH3DS @ matrix[:3, 3] for matrix in matrices])
    return FoVPerspectiveCameras(
        R=torch.from_numpy(rotation).float(), T=torch.from_numpy(translation).float(), fov=FIELD_OF_VIEW, znear=0.01
    )


def _meshes(obj: Object3D, textures: Mapping[str, Tensor]) -> Meshes:
    parts = [
        Meshes(
            verts=[torch.from_numpy(part.vertices)],
            faces=[torch.from_numpy(part.faces).long()],
            textures=TexturesUV(
                textures[obj.albedo_of(part)][None],
                [torch.from_numpy(part.faces).long()],
                [torch.from_numpy(part.uvs)],
            ),
        )
        for part in obj.parts
    ]
    return join_meshes_as_scene(parts) if len(parts) > 1 else parts[0]
