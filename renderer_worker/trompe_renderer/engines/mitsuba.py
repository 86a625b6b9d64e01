"""The Mitsuba 3 engine: a path tracer. Pictures are random, by the noise number of the snapshot."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Annotated, Any, Final, Literal

import drjit
import mitsuba
import numpy as np
from click import IntRange
from numpy.typing import NDArray

from trompe_renderer.engines.engine import noise_seed
from trompe_renderer.engines.surfaces import (
    ContentCache,
    Surface,
    TextureImage,
    composited,
    encoded_light,
    ray_range,
    surfaces_of,
    without_backs,
)
from trompe_renderer.world.snapshot import Snapshot, WorldLight
from trompe_renderer.world.validation import unit_color
from trompe_shared.engine import EngineInfo
from trompe_shared.geometry import FIELD_OF_VIEW
from trompe_shared.opacity import CUTOFF

MAX_RAYS: Final = 2**23
"""Rays of one pass: bounds the memory."""


@dataclass(frozen=True)
class MitsubaOptions:
    """``samples`` of a pixel, its reconstruction ``filter``, and the longest path: 2 is direct light alone."""

    samples: Annotated[int, IntRange(1, 65536)] = 64
    filter: Literal["gaussian", "box", "tent", "mitchell", "catmullrom", "lanczos"] = "gaussian"
    depth: Annotated[int, IntRange(2, 1000)] = 6


class MitsubaEngine:
    """Vectorised with LLVM; scalar, and slower, where LLVM is missing."""

    def __init__(self, options: MitsubaOptions) -> None:
        variant = "llvm_ad_rgb" if drjit.has_backend(drjit.JitBackend.LLVM) else "scalar_rgb"
        mitsuba.set_variant(variant)
        self.info = EngineInfo("mitsuba", version("mitsuba"), variant, deterministic=False)
        self._options = options
        self._meshes: ContentCache[Any] = ContentCache()
        self._textures: ContentCache[Any] = ContentCache()

    def render(self, world: Snapshot, *, width: int, height: int) -> NDArray[np.uint8]:
        surfaces = list(surfaces_of(world))
        scene = mitsuba.load_dict(
            {
                "type": "scene",
                "integrator": self._integrator(width * height),
                "sensor": _sensor(world, surfaces, self._options.filter, width, height),
                **{f"light{number}": _light(light) for number, light in enumerate(world.lights)},
                **({"ambient": {"type": "constant", "radiance": _rgb(world.ambient)}} if any(world.ambient) else {}),
                **{f"mesh{number}": self._mesh(number, each) for number, each in enumerate(surfaces)},
            }
        )
        rgba = np.array(mitsuba.render(scene, spp=self._options.samples, seed=noise_seed(world)))
        for cache in (self._meshes, self._textures):
            cache.trim()
        alpha = np.clip(rgba[..., 3:], 0, 1)
        return composited(encoded_light(rgba[..., :3] / np.maximum(alpha, 1e-4)), alpha, world)

    def _integrator(self, pixels: int) -> dict[str, Any]:
        samples = self._options.samples
        at_once = max(
            count
            for count in range(1, samples + 1)
            if (samples % count == 0 and count * pixels <= MAX_RAYS) or count == 1
        )
        path = {"type": "path", "max_depth": self._options.depth, "hide_emitters": True}
        return path | ({"samples_per_pass": at_once} if at_once < samples else {})

    def _mesh(self, number: int, surface: Surface) -> Any:
        """The mesh in world coordinates, with its material."""
        key = f"{number} {surface.key} {surface.pose.tobytes().hex()}"
        mesh = self._meshes.get(key, lambda: (_mesh(key, surface), surface.part.vertices.nbytes * 3))
        mesh.set_bsdf(mitsuba.load_dict(self._material(surface)))
        return mesh

    def _material(self, surface: Surface) -> dict[str, Any]:
        albedo = surface.albedo.pixels()
        color = self._texture(surface.albedo, "color", lambda: albedo[..., :3])
        material: dict[str, Any] = {"type": "diffuse", "reflectance": color}
        if (maps := surface.metallic) is not None:
            material = {
                "type": "principled",
                "base_color": color,
                "roughness": self._texture(maps, "roughness", lambda: maps.pixels()[..., :1]),
                "metallic": self._texture(maps, "metallic", lambda: maps.pixels()[..., 1:]),
            }
        if (bumps := surface.normal) is not None:
            material = {"type": "normalmap", "normalmap": self._texture(bumps, "raw", bumps.pixels), "bsdf": material}
        material = {"type": "twosided", "bsdf": material}
        opacity = surface.opacity
        if albedo.shape[2] == 3 and opacity is None:
            return material
        alpha = albedo[..., 3:] if albedo.shape[2] == 4 else np.full((1, 1, 1), 255, np.uint8)
        drawn = np.where(alpha < 255 * CUTOFF, 0, 255) if opacity is None else np.round(alpha * opacity)
        mask = self._texture(surface.albedo, f"opacity {opacity}", lambda: drawn.astype(np.uint8))
        return {"type": "mask", "opacity": mask, "bsdf": material}

    def _texture(self, image: TextureImage, use: str, pixels: Any) -> Any:
        """Row 0 is v = 0 in Mitsuba."""

        def make() -> tuple[Any, int]:
            content = np.ascontiguousarray(pixels()[::-1])
            bitmap = mitsuba.Bitmap(content)
            return mitsuba.load_dict({"type": "bitmap", "bitmap": bitmap, "raw": use != "color"}), 2 * content.nbytes

        return self._textures.get(f"{image.key} {use}", make)


def _mesh(name: str, surface: Surface) -> Any:
    part, pose = without_backs(surface.part), surface.pose
    mesh = mitsuba.Mesh(name, len(part.vertices), len(part.faces), has_vertex_normals=True, has_vertex_texcoords=True)
    normals = part.normals @ np.linalg.inv(pose[:3, :3])  # the inverse transpose, of rows
    parameters = mitsuba.traverse(mesh)
    for key, array in {
        "vertex_positions": part.vertices @ pose[:3, :3].T + pose[:3, 3],
        "vertex_normals": normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12),
        "vertex_texcoords": part.uvs,
    }.items():
        parameters[key] = np.ascontiguousarray(array, np.float32).ravel()
    parameters["faces"] = part.faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def _sensor(world: Snapshot, surfaces: Sequence[Surface], rfilter: str, width: int, height: int) -> dict[str, Any]:
    """Mitsuba's camera looks along z, with x to the left."""
    near, far = ray_range(world.camera, [surface.ball for surface in surfaces])
    return {
        "type": "perspective",
        "fov": FIELD_OF_VIEW,
        "fov_axis": "y",
        "near_clip": near,
        "far_clip": far,
        "to_world": mitsuba.ScalarTransform4f((world.camera @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist()),
        "sampler": {"type": "independent"},
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": rfilter},
        },
    }


def _light(light: WorldLight) -> dict[str, Any]:
    power = _rgb(np.pi * light.intensity * np.array(unit_color(light.color)))
    if light.kind == "Point":
        return {"type": "point", "position": list(light.position), "intensity": power}
    return {"type": "directional", "direction": list(light.direction), "irradiance": power}


def _rgb(color: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(value) for value in color]}
