"""Objects in the world: static parts of scenes, and objects spawned by agents."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.world.model import HashedModel
from trompe_renderer.world.movement import Motion, Pose, Walls
from trompe_renderer.world.snapshot import Instance
from trompe_renderer.world.validation import Vector


@dataclass(frozen=True)
class ObjectRequest:
    """A request to spawn the object ``name``; the other fields as in ``WorldObject``."""

    name: str
    pose: Pose
    scale: Vector = (1.0, 1.0, 1.0)
    motion: Motion | None = None
    delay: float = 0.0
    limited: bool = True


@dataclass(frozen=True)
class WorldObject:
    """An object, which starts to move after ``delay`` seconds. ``limited``: it stays in the view frustum.

    ``radius``, metres, is that of its bounding ball around its origin; 0 for an object at rest.
    """

    model: HashedModel
    category: int
    pose: Pose
    scale: Vector = (1.0, 1.0, 1.0)
    motion: Motion | None = None
    delay: float = 0.0
    limited: bool = True
    radius: float = 0.0

    def after(self, seconds: float, walls: Walls) -> "WorldObject":
        """The same object later."""
        if self.motion is None or seconds <= self.delay:
            return replace(self, delay=max(self.delay - seconds, 0.0))
        pose, motion = self.motion.moved(self.pose, seconds - self.delay, radius=self.radius, walls=walls)
        return replace(self, pose=pose, motion=motion, delay=0.0)

    def instance(self, number: int) -> Instance:
        """The object for a snapshot."""
        pose: NDArray[np.float64] = np.eye(4)
        pose[:3, :3] = self.pose.rotation.as_matrix() * np.array(self.scale)
        pose[:3, 3] = self.pose.position
        return Instance(self.model, pose, number, self.category)
