"""How spawned objects move by themselves: along waypoints, or straight on until they meet a wall and bounce.

Where something is depends on the time that has passed and, for bounces, on a seed: the same steps give the same way.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.rotation import about, between, from_euler, product
from trompe_renderer.values import checked_number, checked_vector
from trompe_shared.errors import RendererError

__all__ = ["NO_WALLS", "Bounce", "Motion", "Place", "Waypoints", "frustum_walls", "motion_of", "room_walls"]

MAX_BOUNCES: Final = 64
"""Bounces in one step; what is left of the step after them is not travelled."""

Array = NDArray[np.float64]
Walls = NDArray[np.float64]
"""(N, 4): a point x is inside of each wall (n, d) if n . x + d >= 0; n is a unit vector."""

NO_WALLS: Final[Walls] = np.zeros((0, 4))


@dataclass(frozen=True)
class Place:
    """Position (3,), metres, and rotation (4,), a quaternion, of an object in the world."""

    position: Array
    turn: Array


class Motion(Protocol):
    """A way to go."""

    @property
    def duration(self) -> float:
        """Seconds until it ends, from its start."""
        ...

    def moved(self, place: Place, seconds: float, *, radius: float, walls: Walls) -> "tuple[Place, Motion | None]":
        """Where an object with this radius is after that time, and how it goes on; ``None`` at its end."""
        ...


@dataclass(frozen=True)
class Waypoints:
    """Through ``points`` (K, 3) turned by ``turns`` (K, 4), the same time from each to the next, all in ``duration``.

    Smooth (Catmull-Rom) or in straight lines; rotation turns evenly from point to point. It stops at the last.
    """

    points: Array
    turns: Array
    duration: float
    smooth: bool
    elapsed: float = 0.0

    def moved(self, place: Place, seconds: float, *, radius: float, walls: Walls) -> tuple[Place, Motion | None]:
        elapsed = self.elapsed + seconds
        done = elapsed >= self.duration
        leg, share = divmod(len(self.points) - 1 if done else elapsed / self.duration * (len(self.points) - 1), 1.0)
        number = int(leg)
        after = min(number + 1, len(self.points) - 1)
        position = self._smooth(number, share) if self.smooth else self._straight(number, after, share)
        there = Place(position, between(self.turns[number], self.turns[after], share))
        return there, None if done else replace(self, elapsed=elapsed)

    def _straight(self, number: int, after: int, share: float) -> Array:
        return np.asarray((1 - share) * self.points[number] + share * self.points[after])

    def _smooth(self, number: int, share: float) -> Array:
        a, b, c, d = (self.points[min(max(number + k, 0), len(self.points) - 1)] for k in (-1, 0, 1, 2))
        slope, bend, twist = c - a, 2 * a - 5 * b + 4 * c - d, 3 * (b - c) + d - a
        return np.asarray(b + 0.5 * share * (slope + share * (bend + share * twist)))


@dataclass(frozen=True)
class Bounce:
    """At ``speed`` (m/s) along ``direction``, turning at ``spin`` (rad/s) about ``axis``; off walls at random.

    Random numbers depend on ``seed`` and the number of bounces so far, and on nothing else.
    """

    direction: Array
    speed: float
    spin: float
    seed: int
    axis: Array
    bounces: int = 0
    duration: float = field(default=float("inf"), init=False)

    def moved(self, place: Place, seconds: float, *, radius: float, walls: Walls) -> tuple[Place, Motion | None]:
        motion, left = self, seconds
        for _ in range(MAX_BOUNCES):
            time, wall = motion._next_wall(place, radius, walls)
            if wall is None or time >= left:
                return motion._straight_on(place, left), motion
            place, left = motion._straight_on(place, time), left - time
            motion = motion._off(wall)
        return place, motion

    def _straight_on(self, place: Place, seconds: float) -> Place:
        turn = product(about(self.axis, self.spin * seconds), place.turn)
        return Place(place.position + self.speed * seconds * self.direction, turn / np.linalg.norm(turn))

    def _next_wall(self, place: Place, radius: float, walls: Walls) -> tuple[float, Array | None]:
        """Seconds until a ball of this radius touches the first wall that it nears, and that wall's normal."""
        nearing = -self.speed * (walls[:, :3] @ self.direction)
        gap = np.maximum(walls[:, :3] @ place.position + walls[:, 3] - radius, 0.0)
        times = np.divide(gap, nearing, out=np.full(len(walls), np.inf), where=nearing > 1e-9)
        if not np.isfinite(times).any():
            return float("inf"), None
        first = int(times.argmin())
        return float(times[first]), walls[first, :3]

    def _off(self, normal: Array) -> "Bounce":
        """Away from a wall, in a random direction, spinning about another random axis."""
        direction, axis = _random_units(self.seed, self.bounces + 1)
        return replace(self, direction=_unit(normal + 0.95 * direction), axis=axis, bounces=self.bounces + 1)


def _random_units(seed: int, number: int) -> tuple[Array, Array]:
    first, second = np.random.default_rng([seed, number]).normal(size=(2, 3))
    return _unit(first), _unit(second)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


# --- walls ---


def room_walls(low: Array, high: Array) -> Walls:
    """The inside of a box between two corners (3,)."""
    return np.concatenate([np.c_[np.eye(3), -np.asarray(low)], np.c_[-np.eye(3), np.asarray(high)]])


def frustum_walls(camera: Array, *, field_of_view: float, aspect: float, near: float, far: float) -> Walls:
    """What a camera sees: ``camera`` (4, 4) camera-to-world, OpenGL; degrees, width by height, metres."""
    up = np.tan(np.radians(field_of_view) / 2)
    sides = [[sign, 0.0, -up * aspect] for sign in (1, -1)] + [[0.0, sign, -up] for sign in (1, -1)]
    normals = np.array([_unit(np.array(side)) for side in sides] + [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    offsets = np.array([0.0, 0.0, 0.0, 0.0, -near, far])
    world = normals @ camera[:3, :3].T
    return np.column_stack([world, offsets - world @ camera[:3, 3]])


# --- descriptions ---


def motion_of(kind: str, description: str | Mapping[str, Any]) -> Motion:
    """A movement as SAILenv's git client describes it, in JSON text or parsed. Raises ``RendererError``."""
    makers: Mapping[str, Callable[[Any], Motion]] = {
        "linear_waypoints": lambda table: _waypoints(table, smooth=False),
        "catmull_waypoints": lambda table: _waypoints(table, smooth=True),
        "uniform_movement_random_bounce": _bounce,
    }
    if kind not in makers:
        raise RendererError(f"There is no movement {kind!r}; choose one of {sorted(makers)}.")
    try:
        return makers[kind](json.loads(description) if isinstance(description, str) else description)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise RendererError(f"A {kind} movement is described wrongly: {type(error).__name__} {error}.") from error


def _waypoints(table: Mapping[str, Any], *, smooth: bool) -> Waypoints:
    rows = table["waypoints"]
    if not rows:
        raise RendererError("A movement along waypoints needs at least one.")
    return Waypoints(
        points=np.array([vector_of(row["position"], "waypoint") for row in rows]),
        turns=np.array([from_euler(vector_of(row["rotation"], "rotation")) for row in rows]),
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
    """A vector as JSON of SAILenv's: {"x": 0, "y": 0, "z": 0}."""
    return checked_vector((table["x"], table["y"], table["z"]), what)
