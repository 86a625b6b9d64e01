"""PyTorch3D on the bench's work, as the paper used it: one face per pixel, no blur, soft Phong shading.

An optional peer. Import this module only where PyTorch3D is installed.
"""

from collections.abc import Mapping, Sequence

import numpy as np
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
)
from pytorch3d.structures import Meshes, join_meshes_as_scene
from torch import Tensor

from trompe_server.surrogate import textures_of
from trompe_shared.geometry import FIELD_OF_VIEW, View, spherical
from trompe_shared.object3d import Object3D

PYTORCH3DS = np.diag([-1.0, 1.0, -1.0])
"""From OpenGL's camera coordinates (x right, looks along -z) to PyTorch3D's (x left, looks along +z)."""


class PyTorch3DPeer:
    """Renders ``obj`` in ``views``, differentiably in its textures, in images of ``size`` (H, W)."""

    def __init__(self, obj: Object3D, views: Sequence[View], size: tuple[int, int], device: str = "cpu") -> None:
        self.obj, self.n_views = obj, len(views)
        light = spherical(views[0].light.azimuth, views[0].light.elevation).tolist()
        self.renderer = _renderer(views, size, DirectionalLights(direction=[light], device=device)).to(device)
        self.textures = textures_of(obj, device=device)

    def forward_backward(self) -> Float[Tensor, "views H W 4"]:
        """One pass over all views and back to the textures; the images it made."""
        leaves = {name: texture.clone().requires_grad_() for name, texture in self.textures.items()}
        images = self.renderer(_meshes(self.obj, leaves).extend(self.n_views))
        images[..., :3].sum().backward()
        found: Tensor = images.detach()
        return found


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
    parts = []
    for part in obj.parts:
        texture = textures[obj.albedo_of(part)]
        vertices, uvs = (torch.from_numpy(each).to(texture.device) for each in (part.vertices, part.uvs))
        faces = torch.from_numpy(part.faces).long().to(texture.device)
        parts.append(Meshes([vertices], [faces], TexturesUV(texture[None], [faces], [uvs])))
    return join_meshes_as_scene(parts) if len(parts) > 1 else parts[0]
