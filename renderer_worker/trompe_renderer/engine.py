"""The picture: a scene of objects, lights and a camera becomes an image. One OpenGL context, one thread."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.passes import ObjectRenderer
from trompe_renderer.platform import create_context, pyrender
from trompe_renderer.scenery import Matrix, Scenery
from trompe_renderer.upload import Uploads
from trompe_shared.geometry import FIELD_OF_VIEW

__all__ = ["Engine"]

NEAR: Final = 0.005
FAR: Final = 1000.0
MAX_LIGHTS: Final = 2


class Engine:
    """Renders scenes. Create and use it in one and the same thread; only the end of the process closes it."""

    def __init__(self, *, shadows: bool = True) -> None:
        self._context = create_context()
        self._renderer = ObjectRenderer(shadows=shadows)
        self._uploads = Uploads()
        self._lights = [pyrender.DirectionalLight() for _ in range(MAX_LIGHTS)]
        self._camera = pyrender.PerspectiveCamera(yfov=np.radians(FIELD_OF_VIEW), znear=NEAR, zfar=FAR)

    def render(self, scenery: Scenery, *, width: int, height: int) -> NDArray[np.uint8]:
        """The picture, (height, width, 3) uint8, sRGB, row 0 on top, as a right-handed camera sees it."""
        image = self._renderer.picture(self._scene(scenery), width=width, height=height)
        self._uploads.trim()
        return image

    def _scene(self, scenery: Scenery) -> Any:
        scene = pyrender.Scene(bg_color=np.array([*scenery.background, 1.0]), ambient_light=np.array(scenery.ambient))
        for placement in scenery.placements:
            scene.add(self._uploads.mesh(placement.model), pose=placement.pose)
        for node, light in zip(self._lights, scenery.lights, strict=False):
            node.color, node.intensity = np.array(light.color), np.pi * light.intensity
            scene.add(node, pose=_looking_along(light.direction))
        scene.add(self._camera, pose=scenery.camera)
        return scene


def _looking_along(direction: Matrix) -> Matrix:
    """Pose (4, 4) whose -z axis is ``direction``."""
    back = -np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    helper = np.array([0.0, 1.0, 0.0]) if abs(back[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    right = np.cross(helper, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    return pose
