"""LOAD_SCENARIO's JSON: a scene, objects in it, and when each starts to move."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from trompe_renderer.dynamics import Motion, motion_of, vector_of
from trompe_renderer.values import Vector, checked_number
from trompe_shared.errors import RendererError

__all__ = ["Actor", "Script", "read_script"]

_WRONG: Final = (ValueError, KeyError, TypeError, AttributeError, OverflowError)


@dataclass(frozen=True)
class Actor:
    """One object of a scenario."""

    name: str
    position: Vector
    rotation: Vector
    motion: Motion | None
    limited: bool


@dataclass(frozen=True)
class Script:
    """A scenario as read; ``actors`` has a reason for each object that is described wrongly.

    ``delays``: seconds until each starts to move. ``reach``: how far the camera's view is a room for its objects,
    metres; ``None`` if it is none.
    """

    scene: str
    actors: tuple[Actor | str, ...]
    delays: tuple[float, ...]
    reach: float | None


def read_script(scenario: Mapping[str, Any]) -> Script:
    """Raises ``RendererError`` for what concerns all objects."""
    actors = tuple(_actor_or_reason(row) for row in scenario["objects"])
    motions = [None if isinstance(actor, str) else actor.motion for actor in actors]
    delays = _start_times(scenario.get("timings"), motions)
    return Script(str(scenario.get("scene_name")), actors, tuple(delays), _frustum_reach(scenario))


def _actor_or_reason(row: Mapping[str, Any]) -> Actor | str:
    try:
        return _read_actor(row)
    except RendererError as error:
        return str(error)


def _read_actor(row: Mapping[str, Any]) -> Actor:
    try:
        dynamic = row.get("dynamic")
        return Actor(
            name=str(row["prefab"]),
            position=vector_of(row["position"], "position"),
            rotation=vector_of(row["rotation"], "rotation"),
            motion=motion_of(str(dynamic["type"]), dynamic["description"]) if dynamic else None,
            limited=bool(row.get("frustum_limited", True)),
        )
    except _WRONG as error:
        raise RendererError(f"An object of the scenario is wrong: {type(error).__name__} {error}.") from error


def _frustum_reach(scenario: Mapping[str, Any]) -> float | None:
    try:
        frustum = scenario.get("frustum") or {}
        return checked_number(frustum["far_clip_plane"], "far_clip_plane", low=1.0) if frustum.get("spawn") else None
    except _WRONG as error:
        raise RendererError(f"The scenario's frustum is wrong: {type(error).__name__} {error}.") from error


def _start_times(timings: Mapping[str, Any] | None, motions: Sequence[Motion | None]) -> list[float]:
    if not timings:
        return [0.0] * len(motions)
    try:
        kind, table = timings["type"], timings["description"]
        if kind == "all_together":
            return [_wait(table)] * len(motions)
        if kind == "wait_until_complete":
            return list(_one_after_another(_wait(table), motions))
        if kind == "dict":
            times = table["times"]
            return [checked_number(times.get(str(k), 0.0), "start time", low=0.0) for k in range(len(motions))]
    except _WRONG as error:
        raise RendererError(f"The scenario's timings are wrong: {type(error).__name__} {error}.") from error
    raise RendererError(f"There are no timings {kind!r}; choose all_together, wait_until_complete or dict.")


def _wait(table: Mapping[str, Any]) -> float:
    return checked_number(table["wait_time"], "wait_time", low=0.0)


def _one_after_another(wait: float, motions: Sequence[Motion | None]) -> Iterator[float]:
    """Each starts ``wait`` seconds after the one before has ended; after one that never ends, none does."""
    start = wait
    for motion in motions:
        yield start
        start += (motion.duration if motion else 0.0) + wait
