"""Stand-ins for a target renderer and classifiers: coarse, deterministic and fast."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn

from trompe_server.classifiers import NetworkClassifier
from trompe_shared.engine import EngineInfo
from trompe_shared.geometry import FIELD_OF_VIEW, View, spherical
from trompe_shared.object3d import Object3D


def fake_classifier(
    *,
    n_classes: int = 10,
    image_size: tuple[int, int] = (32, 32),
    seed: int = 0,
    classes: tuple[str, ...] | None = None,
) -> NetworkClassifier:
    """A classifier of 4 x 4 thumbnails with one hidden layer; ``seed`` fixes its weights."""
    hidden, generator = 32, torch.Generator().manual_seed(seed)
    network = nn.Sequential(
        nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(48, hidden), nn.ReLU(), nn.Linear(hidden, n_classes)
    )
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * (2 / parameter.shape[-1]) ** 0.5)
    return NetworkClassifier("fake", network, image_size, n_classes, classes)


class Scores:
    """A network seen through an .onnx file: scores, no gradients."""

    def __init__(self, inner: Any) -> None:
        self.inner: Any = inner
        self.name, self.classes = "net", inner.classes
        self.image_size, self.n_classes = inner.image_size, inner.n_classes

    def predict(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        scores: NDArray[np.float32] = self.inner.predict(images)
        return scores

    def scores(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        with torch.no_grad():
            logits: Tensor = self.inner.logits(images)
        return logits


Floats = NDArray[np.float64]


@dataclass(frozen=True)
class _Points:
    """Points of a surface (N, 3), their normals (N, 3), their colours (N, 3) in linear light."""

    positions: Floats
    normals: Floats
    colors: Floats


FAKE: Final = EngineInfo("fake", "1")


@dataclass(frozen=True)
class FakeTarget:
    """Splats about ``points`` surface points under Lambert's law: no shadows, filters or specular light."""

    points: int = 20_000
    engine: EngineInfo = FAKE

    def render(
        self,
        obj: Object3D,
        views: Sequence[View],
        *,
        size: tuple[int, int],
        on_frame: Callable[[], None] | None = None,
    ) -> NDArray[np.uint8]:
        """See ``TargetRenderer.render``."""
        surface = _sample(obj, self.points)
        images = np.zeros((len(views), *size, 3), np.uint8)
        for image, view in zip(images, views, strict=True):
            _splat(image, surface, view)
            if on_frame is not None:
                on_frame()
        return images

    def close(self) -> None:
        """Nothing to close."""


def _sample(obj: Object3D, count: int) -> _Points:
    """Points spread over all faces by area, the same ones for the same mesh whatever its textures."""
    corners = np.concatenate([p.vertices[p.faces] for p in obj.parts]).astype(np.float64)  # (F, 3, 3)
    uvs = np.concatenate([p.uvs[p.faces] for p in obj.parts]).astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    random = np.random.default_rng(0)
    faces = np.repeat(np.arange(len(corners)), np.ceil(count * areas / areas.sum()).astype(np.int64))
    weights = random.dirichlet(np.ones(3), len(faces))[..., None]
    part_of_face = np.repeat(np.arange(len(obj.parts)), [len(p.faces) for p in obj.parts])
    uv, parts = (uvs[faces] * weights).sum(axis=1), part_of_face[faces]
    colors = np.zeros((len(faces), 3))
    for number, part in enumerate(obj.parts):
        texture, mine = obj.textures[obj.albedo_of(part)], parts == number
        height, width = texture.shape[:2]
        column, row = (uv[mine] % 1.0 * (width, height)).astype(np.int64).T
        colors[mine] = (texture[height - 1 - row.clip(0, height - 1), column.clip(0, width - 1)] / 255.0) ** 2.2
    return _Points((corners[faces] * weights).sum(axis=1), normals[faces] / areas[faces, None], colors)


def _splat(image: NDArray[np.uint8], surface: _Points, view: View) -> None:
    """Draw the points that face the camera into ``image`` (H, W, 3), the nearest last."""
    height, width = image.shape[:2]
    image[:] = view.background
    matrix = view.camera.world_to_camera()
    x, y, z = (surface.positions @ matrix[:3, :3].T + matrix[:3, 3]).T
    facing = ((view.camera.position() - surface.positions) * surface.normals).sum(axis=1) > 0
    scale = 0.5 * height / np.tan(np.radians(FIELD_OF_VIEW) / 2) / np.maximum(-z, 1e-3)
    column, row = np.floor(0.5 * width + scale * x), np.floor(0.5 * height - scale * y)
    seen = facing & (z < -1e-3) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    seen = np.flatnonzero(seen)[np.argsort(z[seen], kind="stable")]
    lambert = np.maximum(surface.normals @ spherical(view.light.azimuth, view.light.elevation), 0.0)
    lit = view.light.intensity * lambert[:, None] * (np.array(view.light.colour) / 255)
    linear = surface.colors * (view.light.ambient + lit)
    shaded = np.rint(255 * linear.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)
    image[row[seen].astype(np.int64), column[seen].astype(np.int64)] = shaded[seen]
