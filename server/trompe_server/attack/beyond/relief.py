"""What the target will show of a surface that moves a little: its own pictures, carried along and relit.

Each view is asked for twice more: under ambient light alone, which shows the albedo, and under the main light alone,
which shows shadows and highlights. Light adds up in linear values, so the two make the picture of any mixture. When the
surface moves, what a pixel shows is looked up where the same point of the surface stood before, and the main light on
it changes as the cosine of its angle to the shading normal does. Which triangle a pixel sees is taken from the
rasteriser and stands still between two calls of ``Relief.at``: an outline that moves has no gradient.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from trompe_server.attack.beyond.shape import Shape
from trompe_server.surrogate.rasterize import Mesh, mesh_of, project, rasterize
from trompe_server.surrogate.sampling import AlphaTest, SamplingModel, fragments_of
from trompe_server.surrogate.shading import ENCODERS, decode_as
from trompe_shared.geometry import FIELD_OF_VIEW, View, spherical
from trompe_shared.object3d import Object3D

__all__ = ["LightProbes", "Relief", "Seen", "probe_light"]

Image8 = NDArray[np.uint8]
Ask = Callable[[Sequence[View]], Image8]
"""Asks the target for images of the object at rest, (views, H, W, 3) uint8."""


@dataclass(frozen=True)
class LightProbes:
    """The target's images (views, H, W, 3) uint8 of the object under ambient light of 1 alone, and under the main
    light at intensity 1 alone."""

    ambient: Image8
    main: Image8


def probe_light(ask: Ask, views: Sequence[View]) -> LightProbes:
    """Ask for both; two renders a view."""

    def under(intensity: float, ambient: float) -> Image8:
        return ask([replace(view, light=replace(view.light, intensity=intensity, ambient=ambient)) for view in views])

    return LightProbes(under(0.0, 1.0), under(1.0, 0.0))


@dataclass(frozen=True)
class Seen:
    """Which triangle each object pixel of one view sees, fixed.

    pixel: row * W + column. covered: the part of it that the object covers. face, entry, share: its fragments; the
    shares of a pixel's add up to 1.
    """

    pixel: Int[Tensor, " pixels"]
    covered: Float[Tensor, "pixels 1"]
    face: Int[Tensor, " n"]
    entry: Int[Tensor, " n"]
    share: Float[Tensor, " n"]


@dataclass(frozen=True)
class Relief:
    """Predicts images of ``shape`` in motion, for ``views``, from ``clean`` images (views, H, W, 3) and ``probes``.

    backgrounds: what the views show without the object, (views, H, W, 3) uint8.
    """

    obj: Object3D
    shape: Shape
    views: tuple[View, ...]
    clean: Image8
    probes: LightProbes
    backgrounds: Image8
    sampling: SamplingModel

    @cached_property
    def _mesh(self) -> Mesh:
        return mesh_of(self.obj)

    @cached_property
    def _alpha(self) -> AlphaTest | None:
        return AlphaTest.of(self._mesh, self.sampling)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the images."""
        return self.clean.shape[1], self.clean.shape[2]

    def at(self, positions: Float[Tensor, "positions 3"], view: int) -> Seen:
        """What a view sees of the surface at ``positions``."""
        sampling, camera = self.sampling, self.views[view].camera
        mesh = replace(self._mesh, positions=positions[self.shape.corners].float())
        planes = project(mesh, camera, self.size, cull=sampling.cull)
        drawn = None if self._alpha is None else partial(self._alpha.drawn, planes)
        visibility = rasterize(planes, self.size, sampling.positions, drawn=drawn)
        found = fragments_of(visibility, mesh, self.size[1], samples=sampling.positions, shade_at=sampling.shade_at)
        covered = torch.zeros(len(visibility.pixel)).index_add_(0, found.entry, found.weight)
        return Seen(visibility.pixel, covered[:, None], found.face, found.entry, found.weight / covered[found.entry])

    def image(
        self,
        seen: Seen,
        view: int,
        positions: Float[Tensor, "positions 3"],
        normals: Float[Tensor, "normals 3"],
    ) -> Float[Tensor, "3 H W"]:
        """A view of the surface at ``positions``, shaded with ``normals``; sRGB in [0, 1]. Differentiable in both."""
        weights = self.weights(seen, view, positions)
        colours = self._colours(seen, view, weights, normals)
        pixels = colours.new_zeros(len(seen.pixel), 3).index_add(0, seen.entry, colours * seen.share[:, None])
        behind = torch.from_numpy(self.backgrounds[view]).view(-1, 3) / 255
        mixed = torch.lerp(behind[seen.pixel], pixels.clamp(0, 1), seen.covered)
        return behind.index_copy(0, seen.pixel, mixed).view(*self.size, 3).permute(2, 0, 1)

    def weights(self, seen: Seen, view: int, positions: Tensor) -> Float[Tensor, "n 3"]:
        """Barycentric weights of the pixels' centres, perspective-correct."""
        corners = self._on_screen(positions, view)[self.shape.corners[seen.face]]  # (n, corner, 3)
        first, second, third = corners.unbind(1)
        pixel = seen.pixel[seen.entry]
        point = torch.stack([pixel % self.size[1] + 0.5, pixel // self.size[1] + 0.5, torch.ones(len(pixel))], 1)
        over_depth = torch.stack(
            [torch.linalg.cross(a, b).mul(point).sum(1) for a, b in ((second, third), (third, first), (first, second))],
            1,
        )
        return over_depth / over_depth.sum(1, keepdim=True)

    def _on_screen(self, points: Float[Tensor, "n 3"], view: int) -> Float[Tensor, "n 3"]:
        """(x, y, 1) * depth of points, x and y in pixels."""
        height, width = self.size
        matrix = torch.from_numpy(self.views[view].camera.world_to_camera()).to(points.dtype)
        eye = points @ matrix[:3, :3].T + matrix[:3, 3]
        focal = height / 2 / math.tan(math.radians(FIELD_OF_VIEW) / 2)
        depth = -eye[:, 2]
        return torch.stack([width / 2 * depth + focal * eye[:, 0], height / 2 * depth - focal * eye[:, 1], depth], 1)

    def _colours(self, seen: Seen, view: int, weights: Float[Tensor, "n 3"], normals: Tensor) -> Float[Tensor, "n 3"]:
        """Colours of the fragments."""
        shape, light = self.shape, self.views[view].light
        at_rest = (weights[..., None] * shape.positions[shape.corners[seen.face]]).sum(1)
        screen = self._on_screen(at_rest, view)
        albedo, main, missed = self._looked_up(view, (screen[:, :2] / screen[:, 2:]).float())
        weights = weights.float()
        before, after = (self._cosine(seen, view, weights, each) for each in (shape.normals, normals))
        colour = torch.tensor(light.colour) / 255
        main = main + albedo * colour * (after - before)
        mixed = light.ambient * albedo + light.intensity * main
        return ENCODERS[self.sampling.encoding](mixed.clamp(0, 1)) + missed

    def _cosine(self, seen: Seen, view: int, weights: Tensor, normals: Tensor) -> Float[Tensor, "n 1"]:
        """Of the angle between the shading normals and the main light, at least 0."""
        light = self.views[view].light
        towards = torch.from_numpy(spherical(light.azimuth, light.elevation)).float()
        mixed = (weights.clamp(0, 1)[..., None] * normals.float()[self.shape.normal[seen.face]]).sum(1)
        return (torch.nn.functional.normalize(mixed, dim=1) @ towards).clamp(min=0)[:, None]

    def _looked_up(
        self, view: int, points: Float[Tensor, "n 2"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Linear light under ambient and under the main light alone, and what these miss of the clean image, at points
        (x, y in pixels) between pixels."""
        height, width = self.size
        layers, solid = self._layers(view), self._solid[view]
        x, y = points[:, 0] - 0.5, points[:, 1] - 0.5
        x0, y0 = x.detach().floor(), y.detach().floor()
        fx, fy = (x - x0)[:, None], (y - y0)[:, None]
        found = torch.zeros(1)
        for dy, wy in ((0, 1 - fy), (1, fy)):
            for dx, wx in ((0, 1 - fx), (1, fx)):
                column, row = (x0.long() + dx).clamp(0, width - 1), (y0.long() + dy).clamp(0, height - 1)
                found = found + wy * wx * layers[solid[row * width + column]]
        return found[:, :3], found[:, 3:6], found[:, 6:]

    @cached_property
    def _solid(self) -> list[Int[Tensor, " pixels"]]:
        """For each pixel near the object's outline at rest (of each view) one beside it that the object fills; for all
        others the pixel itself. The outline shows the background too, which does not move along."""
        return [_nearest(self._filled(view), rounds=OUTLINE) for view in range(len(self.views))]

    def _filled(self, view: int) -> Bool[Tensor, "H W"]:
        """The pixels that nothing but the object shows in."""
        seen = self.at(self.shape.positions, view)
        filled = torch.zeros(self.size[0] * self.size[1], dtype=torch.bool)
        filled[seen.pixel[seen.covered[:, 0] > 1 - 1e-6]] = True
        return filled.view(self.size)

    def _layers(self, view: int) -> Float[Tensor, "pixels 9"]:
        light = self.views[view].light
        curve = decode_as(torch.arange(256) / 255, self.sampling.encoding)
        albedo, main = (curve[torch.from_numpy(each[view]).long()] for each in (self.probes.ambient, self.probes.main))
        mixed = ENCODERS[self.sampling.encoding]((light.ambient * albedo + light.intensity * main).clamp(0, 1))
        missed = torch.from_numpy(self.clean[view]) / 255 - mixed
        return torch.cat([albedo, main, missed], 2).view(-1, 9)


OUTLINE = 4
"""How far beyond the outline at rest the surface is thought to go on, pixels."""


def _nearest(filled: Bool[Tensor, "H W"], *, rounds: int) -> Int[Tensor, " pixels"]:
    """Of each pixel the number of a filled one at most ``rounds`` steps away; its own where there is none."""
    own = torch.arange(filled.numel()).view(filled.shape)
    found = torch.where(filled, own, -1)
    for _ in range(rounds):
        padded = torch.nn.functional.pad(found, (1, 1, 1, 1), value=-1)
        beside = [padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]]
        for neighbour in beside:
            found = torch.where(found < 0, neighbour, found)
    return torch.where(found < 0, own, found).flatten()
