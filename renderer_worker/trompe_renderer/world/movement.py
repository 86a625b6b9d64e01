"""Movement of spawned objects: along waypoints, or straight on with random bounces off walls.

A pose depends only on the elapsed time and, for bounces, on a seed: the same steps give the same path.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from trompe_renderer.world.validation import checked_number, checked_vector, described
from trompe_shared.errors import RendererError

MAX_BOUNCES: Final = 64
"""Bounces in one step; the rest of the step is not travelled."""

Array = NDArray[np.float64]
Walls = NDArray[np.float64]
"""(N, 4): a point x is inside of a wall (n, d) if n . x + d >= 0; n is a unit vector."""

NO_WALLS: Final[Walls] = np.zeros((0, 4))


def rotation_of(degrees: ArrayLike) -> Rotation:
    """Rotation by Unity's Euler angles (..., 3), degrees: z first, then x, then y."""
    return Rotation.from_euler("YXZ", np.asarray(degrees, dtype=np.float64)[..., [1, 0, 2]], degrees=True)


@dataclass(frozen=True)
class Pose:
    """Position (3,), metres, and rotation of an object in the world."""

    position: Array
    rotation: Rotation

    @classmethod
    def of(cls, position: ArrayLike, degrees: ArrayLike) -> "Pose":
        """A pose from metres (3,) and Unity's Euler angles (3,) in degrees."""
        return cls(np.array(position), rotation_of(degrees))


@dataclass(frozen=True)
class Waypoints:
    """A path through ``points`` (K, 3) in ``duration`` seconds, the same time for each leg; it ends at the last point.

    ``smooth`` paths are Catmull-Rom splines, others straight lines. ``rotations`` takes leg numbers, 0 to K - 1, and
    turns at constant speed along each leg.
    """

    points: Array
    rotations: Slerp
    duration: float
    smooth: bool
    elapsed: float = 0.0

    def moved(self, pose: Pose, seconds: float, *, radius: float, walls: Walls) -> "tuple[Pose, Motion | None]":
        """The pose after ``seconds`` and the rest of the movement, ``None`` at its end. Walls have no effect."""
        elapsed = self.elapsed + seconds
        done = elapsed >= self.duration
        last = len(self.points) - 1
        place = float(last) if done else elapsed / self.duration * last
        there = Pose(self._position(place), self.rotations(place))
        return there, None if done else replace(self, elapsed=elapsed)

    def _position(self, place: float) -> Array:
        leg, share = divmod(place, 1.0)
        a, b, c, d = (self.points[min(max(int(leg) + k, 0), len(self.points) - 1)] for k in (-1, 0, 1, 2))
        if not self.smooth:
            return np.asarray((1 - share) * b + share * c)
        slope, bend, twist = c - a, 2 * a - 5 * b + 4 * c - d, 3 * (b - c) + d - a
        return np.asarray(b + 0.5 * share * (slope + share * (bend + share * twist)))


@dataclass(frozen=True)
class Bounce:
    """Movement at ``speed`` (m/s) along ``direction`` (3,), turning at ``spin`` (rad/s) about ``axis`` (3,).

    Walls reflect it in random directions, drawn from ``seed`` and the number of bounces alone.
    """

    direction: Array
    speed: float
    spin: float
    seed: int
    axis: Array
    bounces: int = 0
    duration: float = field(default=float("inf"), init=False)

    def moved(self, pose: Pose, seconds: float, *, radius: float, walls: Walls) -> "tuple[Pose, Motion | None]":
        """As ``Waypoints.moved``; ``radius``, metres, is that of the object's bounding ball. It never ends."""
        motion, left = self, seconds
        for _ in range(MAX_BOUNCES):
            time, wall = motion._next_wall(pose, radius, walls)
            if wall is None or time >= left:
                return motion._straight_on(pose, left), motion
            pose, left = motion._straight_on(pose, time), left - time
            motion = motion._reflected(wall)
        return pose, motion

    def _straight_on(self, pose: Pose, seconds: float) -> Pose:
        turned = Rotation.from_rotvec(self.spin * seconds * self.axis) * pose.rotation
        return Pose(pose.position + self.speed * seconds * self.direction, turned)

    def _next_wall(self, pose: Pose, radius: float, walls: Walls) -> tuple[float, Array | None]:
        """Seconds until a ball of this radius touches a wall, and the wall's normal (3,)."""
        nearing = -self.speed * (walls[:, :3] @ self.direction)
        gap = np.maximum(walls[:, :3] @ pose.position + walls[:, 3] - radius, 0.0)
        times = np.divide(gap, nearing, out=np.full(len(walls), np.inf), where=nearing > 1e-9)
        if not np.isfinite(times).any():
            return float("inf"), None
        first = int(times.argmin())
        return float(times[first]), walls[first, :3]

    def _reflected(self, normal: Array) -> "Bounce":
        direction, axis = _random_units(self.seed, self.bounces + 1)
        return replace(self, direction=_unit(normal + 0.95 * direction), axis=axis, bounces=self.bounces + 1)


Motion = Waypoints | Bounce


def _random_units(seed: int, number: int) -> tuple[Array, Array]:
    first, second = np.random.default_rng([seed, number]).normal(size=(2, 3))
    return _unit(first), _unit(second)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def room_walls(low: Array, high: Array) -> Walls:
    """The inside of a box between two corners (3,), metres."""
    return np.concatenate([np.c_[np.eye(3), -np.asarray(low)], np.c_[-np.eye(3), np.asarray(high)]])


def frustum_walls(camera: Array, *, field_of_view: float, aspect: float, near: float, far: float) -> Walls:
    """The view frustum of ``camera`` (4, 4), camera-to-world, OpenGL. Units: degrees, width by height, metres."""
    up = np.tan(np.radians(field_of_view) / 2)
    sides = [[sign, 0.0, -up * aspect] for sign in (1, -1)] + [[0.0, sign, -up] for sign in (1, -1)]
    normals = np.array([_unit(np.array(side)) for side in sides] + [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    offsets = np.array([0.0, 0.0, 0.0, 0.0, -near, far])
    world = normals @ camera[:3, :3].T
    return np.column_stack([world, offsets - world @ camera[:3, 3]])


def motion_of(kind: str, description: str | Mapping[str, Any]) -> Motion:
    """A movement described as in SAILenv's git client, in JSON text or parsed. Raises ``RendererError``."""
    makers: Mapping[str, Callable[[Any], Motion]] = {
        "linear_waypoints": lambda table: _waypoints(table, smooth=False),
        "catmull_waypoints": lambda table: _waypoints(table, smooth=True),
        "uniform_movement_random_bounce": _bounce,
    }
    if kind not in makers:
        raise RendererError(f"There is no movement {kind!r}; choose one of {sorted(makers)}.")
    with described(f"The description of a {kind} movement"):
        return makers[kind](json.loads(description) if isinstance(description, str) else description)


def _waypoints(table: Mapping[str, Any], *, smooth: bool) -> Waypoints:
    rows = table["waypoints"]
    if not rows:
        raise RendererError("A movement along waypoints needs at least one.")
    rows = [*rows, rows[-1]] if len(rows) == 1 else rows  # Slerp needs two
    return Waypoints(
        points=np.array([vector_of(row["position"], "waypoint") for row in rows]),
        rotations=Slerp(range(len(rows)), rotation_of([vector_of(row["rotation"], "rotation") for row in rows])),
        duration=checked_number(table["total_time"], "total_time", low=1e-3),
        smooth=smooth,
    )


def _bounce(table: Mapping[str, Any]) -> Bounce:
    direction = np.array(vector_of(table["start_direction"], "direction"))
    if np.linalg.norm(direction) < 1e-6:
        raise RendererError("A movement's start_direction must not be zero.")
    seed = abs(int(table["seed"]))
    return Bounce(
        direction=_unit(direction),
        speed=checked_number(table["speed"], "speed", low=0.0, high=1e4),
        spin=checked_number(table["angular_speed"], "angular_speed", low=-1e4, high=1e4),
        seed=seed,
        axis=_random_units(seed, 0)[1],
    )


def vector_of(table: Mapping[str, float], what: str) -> tuple[float, float, float]:
    """A vector in SAILenv's JSON: {"x": 0, "y": 0, "z": 0}. Raises ``RendererError``."""
    return checked_vector((table["x"], table["y"], table["z"]), what)
