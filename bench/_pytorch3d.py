"""PyTorch3D on the bench's work, as the paper used it: one face per pixel, no blur, soft Phong shading.

An optional peer. Import this module only where PyTorch3D is installed.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from pytorch3d.renderer import (
    DirectionalLights,
    FoVPerspectiveCameras,
    MeshRasterizer,
    MeshRenderer,
    RasterizationSettings,
    SoftPhongShader,
    TexturesUV,
    look_at_view_transform,
)
from pytorch3d.structures import Meshes, join_meshes_as_scene
from torch import Tensor

from trompe_server.surrogate import textures_of
from trompe_shared.geometry import FIELD_OF_VIEW, View, spherical
from trompe_shared.object3d import Object3D

__all__ = ["PyTorch3DPeer"]


class PyTorch3DPeer:
    """Renders ``obj`` in ``views``, differentiably in its textures, in images of ``size`` (H, W)."""

    def __init__(self, obj: Object3D, views: Sequence[View], size: tuple[int, int]) -> None:
        self.obj, self.n_views = obj, len(views)
        camera = [view.camera for view in views]
        rotation, translation = look_at_view_transform(
            [c.distance for c in camera], [c.elevation for c in camera], [c.azimuth for c in camera]
        )
        cameras = FoVPerspectiveCameras(R=rotation, T=translation, fov=FIELD_OF_VIEW, znear=0.01)
        settings = RasterizationSettings(image_size=size, blur_radius=0.0, faces_per_pixel=1)
        light = views[0].light
        lights = DirectionalLights(direction=[spherical(light.azimuth, light.elevation).tolist()])
        shader = SoftPhongShader(cameras=cameras, lights=lights)
        self.renderer = MeshRenderer(MeshRasterizer(cameras=cameras, raster_settings=settings), shader)
        self.textures = textures_of(obj)

    def forward_backward(self) -> Float[Tensor, "views H W 4"]:
        """One pass over all views and back to the textures; the images it made."""
        leaves = {name: texture.clone().requires_grad_() for name, texture in self.textures.items()}
        images = self.renderer(self._meshes(leaves).extend(self.n_views))
        images[..., :3].sum().backward()
        found: Tensor = images.detach()
        return found

    def _meshes(self, textures: dict[str, Tensor]) -> Meshes:
        parts = [
            Meshes(
                verts=[torch.from_numpy(part.vertices)],
                faces=[torch.from_numpy(part.faces).long()],
                textures=TexturesUV(
                    textures[self.obj.albedo_of(part)][None],
                    [torch.from_numpy(part.faces).long()],
                    [torch.from_numpy(part.uvs)],
                ),
            )
            for part in self.obj.parts
        ]
        return join_meshes_as_scene(parts) if len(parts) > 1 else parts[0]
