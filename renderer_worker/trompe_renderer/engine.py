"""The picture: a scene of objects, lights and a camera becomes an image. One OpenGL context, one thread."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.options import Quality
from trompe_renderer.passes import ObjectRenderer
from trompe_renderer.platform import create_context, pyrender
from trompe_renderer.scenery import DirectionalLight, Matrix, PointLight, Scenery, viewing
from trompe_renderer.survey import Drawn, Survey, Surveyor
from trompe_renderer.upload import Uploads
from trompe_shared.geometry import FIELD_OF_VIEW

__all__ = ["Engine"]

NEAR: Final = 0.005
FAR: Final = 1000.0
MAX_LIGHTS: Final = 2
"""Lights of each kind."""


class Engine:
    """Renders scenes. Create and use it in one and the same thread; only the end of the process closes it."""

    def __init__(self, quality: Quality) -> None:
        self._context = create_context()
        self._renderer = ObjectRenderer(quality)
        self._surveyor = Surveyor()
        self._uploads = Uploads(anisotropy=quality.anisotropy)
        self._suns = [pyrender.DirectionalLight() for _ in range(MAX_LIGHTS)]
        self._lamps = [pyrender.PointLight() for _ in range(MAX_LIGHTS)]
        self._camera = pyrender.PerspectiveCamera(yfov=np.radians(FIELD_OF_VIEW), znear=NEAR, zfar=FAR)

    def render(self, scenery: Scenery, *, width: int, height: int) -> NDArray[np.uint8]:
        """The picture, (height, width, 3) uint8, sRGB, row 0 on top, as a right-handed camera sees it."""
        try:
            scene = self._scene(scenery)
            return self._renderer.picture(scene, width=width, height=height, backdrop=scenery.backdrop)
        finally:
            self._uploads.trim()

    def check(self) -> None:
        """Draw an empty picture. Raises what the driver does if nothing can be drawn any more."""
        dark = (0.0, 0.0, 0.0)
        self.render(Scenery((), np.eye(4), (), dark, dark), width=8, height=8)

    def survey(self, scenery: Scenery, before: Scenery, *, width: int, height: int) -> Survey:
        """What each pixel of that picture shows, and how it has moved since ``before``."""
        before = before if before.take == scenery.take else scenery
        projection = self._camera.get_projection_matrix(width=width, height=height)
        now, earlier = (viewing(each.camera, projection) for each in (scenery, before))
        poses = before.poses
        try:
            items = [
                Drawn(self._uploads.mesh(p.model), p.number, now @ p.pose, earlier @ poses.get(p.number, p.pose))
                for p in scenery.placements
            ]
            return self._surveyor.survey(items, width=width, height=height)
        finally:
            self._uploads.trim()

    def _scene(self, scenery: Scenery) -> Any:
        color = scenery.backdrop if isinstance(scenery.backdrop, tuple) else (0.0, 0.0, 0.0)
        scene = pyrender.Scene(bg_color=np.array([*color, 1.0]), ambient_light=np.array(scenery.ambient))
        for placement in scenery.placements:
            scene.add(self._uploads.mesh(placement.model), pose=placement.pose)
        suns, lamps = iter(self._suns), iter(self._lamps)
        for light in scenery.lights:
            node = next(suns if isinstance(light, DirectionalLight) else lamps)
            node.color, node.intensity = np.array(light.color), np.pi * light.intensity
            scene.add(node, pose=_pose(light))
        scene.add(self._camera, pose=scenery.camera)
        return scene


def _pose(light: DirectionalLight | PointLight) -> Matrix:
    if isinstance(light, DirectionalLight):
        return _looking_along(light.direction)
    pose = np.eye(4)
    pose[:3, 3] = light.position
    return pose


def _looking_along(direction: Matrix) -> Matrix:
    """Pose (4, 4) whose -z axis is ``direction``."""
    back = -np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    helper = np.array([0.0, 1.0, 0.0]) if abs(back[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    right = np.cross(helper, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    return pose
