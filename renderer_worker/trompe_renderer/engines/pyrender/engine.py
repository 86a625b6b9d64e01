"""The pyrender engine: a snapshot becomes a pyrender scene, then an image. One OpenGL context, one thread."""

from importlib.metadata import version
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.engines.engine import GBuffer
from trompe_renderer.engines.pyrender.gbuffer import GBufferPass
from trompe_renderer.engines.pyrender.gpu_cache import GpuCache
from trompe_renderer.engines.pyrender.passes import ObjectRenderer, PyrenderOptions
from trompe_renderer.engines.pyrender.platform import GL, create_context, pyrender
from trompe_renderer.engines.surfaces import clipping_planes
from trompe_renderer.world.snapshot import Matrix, Snapshot, WorldLight
from trompe_renderer.world.validation import unit_color
from trompe_shared.engine import EngineInfo
from trompe_shared.geometry import FIELD_OF_VIEW

MAX_LIGHTS: Final = 2
"""Lights of each kind."""
SOFTWARE: Final = "llvmpipe"
"""Mesa's renderer on processors; a card's pictures differ from its by a few levels."""


class PyrenderEngine:
    """A ``LabellingEngine``. Its OpenGL context lives until the process ends."""

    def __init__(self, options: PyrenderOptions) -> None:
        self._context = create_context()
        driver = GL.glGetString(GL.GL_RENDERER).decode()
        self.info = EngineInfo("pyrender", version("pyrender"), "" if SOFTWARE in driver else driver)
        self._renderer = ObjectRenderer(options)
        self._gbuffers = GBufferPass()
        self._cache = GpuCache(anisotropy=options.anisotropy)
        self._directional = [pyrender.DirectionalLight() for _ in range(MAX_LIGHTS)]
        self._point = [pyrender.PointLight() for _ in range(MAX_LIGHTS)]
        self._camera = pyrender.PerspectiveCamera(yfov=np.radians(FIELD_OF_VIEW))

    def render(self, world: Snapshot, *, width: int, height: int) -> NDArray[np.uint8]:
        try:
            return self._renderer.picture(self._scene(world), width=width, height=height, background=world.background)
        finally:
            self._cache.trim()

    def gbuffer(self, world: Snapshot, before: Snapshot, *, width: int, height: int) -> GBuffer:
        before = before if before.sequence == world.sequence else world
        self._clip(world)
        projection = self._camera.get_projection_matrix(width=width, height=height)
        now, earlier = (projection @ np.linalg.inv(each.camera) for each in (world, before))
        poses = {instance.number: instance.pose for instance in before.instances}
        try:
            calls = [
                (self._cache.mesh(i.model), i.number, now @ i.pose, earlier @ poses.get(i.number, i.pose))
                for i in world.instances
            ]
            return self._gbuffers.draw(calls, width=width, height=height)
        finally:
            self._cache.trim()

    def _scene(self, world: Snapshot) -> Any:
        color = world.background if isinstance(world.background, tuple) else (0.0, 0.0, 0.0)
        scene = pyrender.Scene(bg_color=np.array([*color, 1.0]), ambient_light=np.array(world.ambient))
        for instance in world.instances:
            scene.add(self._cache.mesh(instance.model), pose=instance.pose)
        directional, point = iter(self._directional), iter(self._point)
        for light in world.lights:
            node = next(directional if light.kind == "Directional" else point)
            node.color, node.intensity = np.array(unit_color(light.color)), np.pi * light.intensity
            scene.add(node, pose=_pose(light))
        self._clip(world)
        scene.add(self._camera, pose=world.camera)
        return scene

    def _clip(self, world: Snapshot) -> None:
        balls = [(i.pose, mesh.centroid, mesh.scale) for i in world.instances for mesh in [self._cache.mesh(i.model)]]
        self._camera.znear, self._camera.zfar = clipping_planes(world.camera, balls)


def _pose(light: WorldLight) -> Matrix:
    """(4, 4): at the position of a point light, or with -z along the direction of a directional light."""
    pose = np.eye(4)
    if light.kind == "Point":
        pose[:3, 3] = light.position
        return pose
    back = -np.asarray(light.direction, dtype=np.float64) / np.linalg.norm(light.direction)
    helper = np.array([0.0, 1.0, 0.0]) if abs(back[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    right = np.cross(helper, back)
    right /= np.linalg.norm(right)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    return pose
