"""A snapshot as most engines take it: surfaces with meshes and textures, found by content, and a background."""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.world.model import HashedModel
from trompe_renderer.world.snapshot import Matrix, Sky, Snapshot
from trompe_renderer.world.validation import unit_color
from trompe_shared.geometry import FIELD_OF_VIEW
from trompe_shared.object3d import PLAIN_ROUGHNESS, Material, decode_rgb, roughness_metallic
from trompe_shared.opacity import CUTOFF
from trompe_shared.wavefront import Part

NEAR: Final = 0.005
FAR: Final = 1000.0
"""Clipping planes, metres, for all but tiny and huge objects."""
MAX_ENTRIES: Final = 256
MAX_BYTES: Final = 512 * 2**20

Pixels = NDArray[np.uint8]
Use = Literal["albedo", "normal", "metallic"]
Ball = tuple[Matrix, NDArray[np.floating[Any]], float]
"""Pose (4, 4) of an object, its middle in object coordinates, and its size."""
T = TypeVar("T")


@dataclass(frozen=True)
class TextureImage:
    """A texture of a model by its use; a repainted model's albedo is that of ``obj.textures``."""

    use: Use
    name: str
    model: HashedModel

    @property
    def key(self) -> str:
        """Equal for equal pixels."""
        name, model = self.name, self.model
        key = model.albedos.get(name) or f"{model.shape} {self.use} {name}"
        return key + (model.opacities[name][0] if self.use == "albedo" else "")

    @property
    def transparent(self) -> bool:
        """Whether the pixels of an albedo have alpha."""
        return self.model.opacities[self.name][1] is not None

    def pixels(self) -> Pixels:
        """(H, W, channels) uint8, row 0 on top: sRGB, with alpha if transparent; a normal map; (roughness, metallic).

        Of an alpha-tested material alpha below one half cuts holes.
        """
        name, obj = self.name, self.model.obj
        if self.use == "albedo":
            texture, opacity = obj.textures[name], self.model.opacities[name][1]
            alike = opacity is not None and opacity.shape == texture.shape[:2]
            return np.dstack([texture, opacity]) if alike else texture  # type: ignore[list-item]
        data = obj.files[name]
        return decode_rgb(data, name) if self.use == "normal" else roughness_metallic(data, name)


@dataclass(frozen=True)
class Surface:
    """A part of an instance. ``key`` is equal for equal ``part``; ``pose`` (4, 4) is object-to-world.

    ``opacity``: of a blended surface, otherwise ``None``.
    """

    key: str
    part: Part
    pose: Matrix
    albedo: TextureImage
    normal: TextureImage | None
    metallic: TextureImage | None
    opacity: float | None

    @property
    def ball(self) -> "Ball":
        """Its bounding box's middle and diagonal."""
        low, high = self.part.vertices.min(0), self.part.vertices.max(0)
        return self.pose, (low + high) / 2, float(np.linalg.norm(high - low))


def without_backs(part: Part) -> Part:
    """``part`` without faces that are the back of another one, for engines that draw both sides of all."""
    places = np.unique(part.vertices, axis=0, return_inverse=True)[1].reshape(-1)
    _, first = np.unique(np.sort(places[part.faces], axis=1), axis=0, return_index=True)
    return replace(part, faces=part.faces[np.sort(first)])


def surfaces_of(world: Snapshot) -> Iterator[Surface]:
    """The parts of all instances."""
    for instance in world.instances:
        model = instance.model
        for number, part in enumerate(model.obj.parts):
            look: Material = model.obj.materials[part.material]
            yield Surface(
                f"{model.shape} {number}",
                part,
                instance.pose,
                TextureImage("albedo", look.albedo, model),
                TextureImage("normal", look.normal, model) if look.normal else None,
                TextureImage("metallic", look.metallic, model) if look.metallic else None,
                look.opacity,
            )


class ContentCache(Generic[T]):
    """Values by content key; ``trim`` forgets those unused for longest. ``drop`` is called with forgotten ones."""

    def __init__(self, drop: Callable[[T], object] = lambda _: None) -> None:
        self._entries: OrderedDict[str, tuple[T, int]] = OrderedDict()
        self._drop = drop

    def get(self, key: str, make: Callable[[], tuple[T, int]]) -> T:
        """The value of ``key``; ``make`` makes it, and its size in bytes, on first use."""
        if key not in self._entries:
            self._entries[key] = make()
        self._entries.move_to_end(key)
        return self._entries[key][0]

    def take(self, wanted: Callable[[T], bool]) -> T | None:
        """Remove and return the value unused for longest among those ``wanted``; ``None`` without one."""
        found = next((key for key, (value, _) in self._entries.items() if wanted(value)), None)
        return None if found is None else self._entries.pop(found)[0]

    def trim(self) -> None:
        """Keep to the limits. Call it when no picture is being drawn."""
        size = sum(count for _, count in self._entries.values())
        while len(self._entries) > MAX_ENTRIES or size > MAX_BYTES:
            _, (value, count) = self._entries.popitem(last=False)
            size -= count
            self._drop(value)


def scene_table(
    world: Snapshot,
    surfaces: Iterable[Surface],
    kept: ContentCache[str],
    *,
    add_mesh: Callable[[Surface], tuple[str, int]],
    add_image: Callable[[TextureImage], tuple[str, int]],
) -> dict[str, Any]:
    """A snapshot as JSON for an engine in another process, which finds meshes and images by key.

    Matrices are lists of rows. ``kept``: the keys that the engine has; ``add_mesh`` and ``add_image`` send what it
    lacks and return its key and its size in bytes there.
    """

    def image_key(image: TextureImage | None) -> str | None:
        return kept.get(image.key, lambda: add_image(image)) if image else None

    def item(surface: Surface) -> dict[str, Any]:
        return {
            "mesh": kept.get(surface.key, lambda: add_mesh(surface)),
            "pose": surface.pose.tolist(),
            "albedo": image_key(surface.albedo),
            "normal": image_key(surface.normal),
            "metallic": image_key(surface.metallic),
            "alpha": surface.opacity is not None or surface.albedo.transparent,
            "opacity": surface.opacity,
            "cutoff": CUTOFF if surface.opacity is None else 0,
            "roughness": PLAIN_ROUGHNESS,
        }

    return {
        "fov": FIELD_OF_VIEW,
        "camera": world.camera.tolist(),
        "ambient": world.ambient,
        "lights": [asdict(light) | {"color": unit_color(light.color)} for light in world.lights],
        "items": [item(surface) for surface in surfaces],
    }


def clipping_planes(camera: Matrix, balls: Iterable[Ball]) -> tuple[float, float]:
    """Distances (near, far), metres: nearer for a tiny object close to the camera, farther for a distant or huge one,
    for which the near plane moves away too, as depth has a fixed number of bits."""
    near, far, free = NEAR, FAR, np.inf
    for pose, centroid, scale in balls:
        centre = pose[:3, :3] @ centroid + pose[:3, 3]
        away = float(np.linalg.norm(centre - camera[:3, 3]))
        size = float(np.linalg.norm(pose[:3, :3], 2)) * scale
        near = min(near, 0.1 * max(size, away - size)) or near
        far = max(far, away + size)
        free = min(free, away - size / 2)
    return (max(near, 1e-3 * free) if np.isfinite(free) else near), far


def ray_range(camera: Matrix, balls: Iterable[Ball]) -> tuple[float, float]:
    """``clipping_planes`` of a ray tracer, which has no depth buffer: at most 1 mm, and at least 100 km."""
    near, far = clipping_planes(camera, balls)
    return min(1e-3, near), max(1e5, far)


def sphere_around(surfaces: Iterable[Surface]) -> tuple[NDArray[np.float64], float]:
    """Centre (3,) and radius, metres, of a sphere around all surfaces; around the origin without any."""
    balls = [surface.ball for surface in surfaces]
    if not balls:
        return np.zeros(3), 1.0
    centres = np.array([pose[:3, :3] @ middle + pose[:3, 3] for pose, middle, _ in balls])
    radii = np.array([np.linalg.norm(pose[:3, :3], 2) * size / 2 for pose, _, size in balls])[:, None]
    centre = ((centres - radii).min(0) + (centres + radii).max(0)) / 2
    return centre, float((np.linalg.norm(centres - centre, axis=1) + radii[:, 0]).max())


def background_pixels(world: Snapshot, *, width: int, height: int) -> Pixels:
    """The background alone, (height, width, 3) uint8, sRGB, row 0 on top."""
    if not isinstance(world.background, Sky):
        return np.full((height, width, 3), np.round(255 * np.array(world.background)), np.uint8)
    slope = np.tan(np.radians(FIELD_OF_VIEW / 2))
    y = slope * (1 - (2 * np.arange(height)[:, None] + 1) / height)
    x = slope * ((2 * np.arange(width) + 1) / width - 1) * width / height
    rays = np.stack(np.broadcast_arrays(x, y, -1.0), axis=-1) @ world.camera[:3, :3].T  # (H, W, 3)
    return _sky(rays[..., 1] / np.linalg.norm(rays, axis=-1))


def _sky(height: NDArray[np.float64]) -> Pixels:
    """Colours (..., 3) uint8 by the sine of the elevation, as pyrender's ``SkyPass``."""
    horizon, zenith, ground = np.array([[0.84, 0.89, 0.93], [0.30, 0.52, 0.78], [0.47, 0.49, 0.43]])
    up, edge = np.sqrt(np.clip(height, 0, 1))[..., None], np.clip((height + 0.01) / 0.02, 0, 1)[..., None]
    edge = edge**2 * (3 - 2 * edge)
    return np.asarray(np.round(255 * (ground + edge * (horizon + up * (zenith - horizon) - ground))), np.uint8)


def composited(color: NDArray[np.floating[Any]], alpha: NDArray[np.floating[Any]], world: Snapshot) -> Pixels:
    """A picture (H, W, 3) uint8 over the background, blended by encoded values as image editors do.

    color (H, W, 3): sRGB in [0, 1], not premultiplied. alpha (H, W, 1).
    """
    height, width = color.shape[:2]
    behind = background_pixels(world, width=width, height=height) / 255.0
    return np.asarray(np.round(255 * (behind + np.clip(alpha, 0, 1) * (np.clip(color, 0, 1) - behind))), np.uint8)


def rgba_of(pixels: Pixels) -> Pixels:
    """(H, W, 4) uint8, bottom row first, of a texture's pixels; roughness in green, metallic in blue, as in glTF."""
    height, width, channels = pixels.shape
    rgba = np.full((height, width, 4), 255, np.uint8)
    rgba[..., slice(1, 3) if channels == 2 else slice(channels)] = pixels[::-1]
    return rgba


def linear_light(color: NDArray[np.float64]) -> NDArray[np.float64]:
    """sRGB in [0, 1] to linear light."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def encoded_light(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear light to sRGB, clipped to [0, 1]."""
    clipped = np.clip(linear, 0, 1)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)
