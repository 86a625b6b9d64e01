"""nvdiffrast on the bench's work: one texture, trilinear mip mapping, no antialiasing of edges.

An optional peer. Import this module only where nvdiffrast is installed.
"""

import math
from collections.abc import Sequence

import numpy as np
import nvdiffrast.torch as dr
import torch
from jaxtyping import Float
from torch import Tensor

from trompe_server.surrogate import textures_of
from trompe_shared.geometry import FIELD_OF_VIEW, View
from trompe_shared.object3d import Object3D


class NvdiffrastPeer:
    """Renders ``obj``, of one part, in ``views``, differentiably in its texture, in images of ``size`` (H, W).

    cached: rasterise once and look up the texture in each pass, as an expert would for fixed views.
    """

    def __init__(self, obj: Object3D, views: Sequence[View], size: tuple[int, int], *, cached: bool) -> None:
        (part,) = obj.parts
        self.size, self.context = size, dr.RasterizeCudaContext(device="cuda")
        self.texture = textures_of(obj, device="cuda")[obj.albedo_of(part)]
        self.uvs = (
            torch.from_numpy(part.uvs * np.array([1, -1], np.float32) + np.array([0, 1], np.float32))
            .cuda()
            .contiguous()
        )
        self.faces = torch.from_numpy(part.faces).int().cuda().contiguous()
        self.corners = _clip(torch.from_numpy(part.vertices).cuda(), views, size[1] / size[0])
        self.gradient = torch.randn(len(views), *size, 3, device="cuda")
        self.known = self._rasterised() if cached else None

    def _rasterised(self) -> tuple[Tensor, Tensor, Tensor]:
        """(Texture coordinates, their derivatives, mask) of the pixels of all views."""
        shown, by_pixel = dr.rasterize(self.context, self.corners, self.faces, resolution=self.size)
        uv, derivatives = dr.interpolate(self.uvs[None], shown, self.faces, rast_db=by_pixel, diff_attrs="all")
        return uv, derivatives, (shown[..., 3:] > 0).float()

    def forward_backward(self) -> Float[Tensor, "views H W 1"]:
        """One pass over all views and back to the texture; the mask of the object."""
        uv, derivatives, mask = self._rasterised() if self.known is None else self.known
        leaf = self.texture.clone().requires_grad_()
        images = dr.texture(leaf[None], uv, derivatives, filter_mode="linear-mipmap-linear") * mask
        images.backward(self.gradient)
        return mask


def _clip(vertices: Float[Tensor, "n 3"], views: Sequence[View], aspect: float) -> Float[Tensor, "views n 4"]:
    """Clip coordinates of the vertices, row 0 of the images on top."""
    near, far, focal = 0.01, 100.0, 1 / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    projection = torch.tensor(
        [
            [focal / aspect, 0, 0, 0],
            [0, -focal, 0, 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ],
        dtype=torch.float64,
    )
    matrices = torch.stack([projection @ torch.from_numpy(view.camera.world_to_camera()) for view in views]).float()
    points = torch.cat([vertices, torch.ones_like(vertices[:, :1])], 1)
    return (points @ matrices.to(points.device).mT).contiguous()
