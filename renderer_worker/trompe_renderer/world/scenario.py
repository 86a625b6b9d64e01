"""The JSON of LOAD_SCENARIO: a scene, its objects, and the start times of their movements."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from trompe_renderer.world.movement import Motion, Pose, motion_of, vector_of
from trompe_renderer.world.objects import ObjectRequest
from trompe_renderer.world.validation import checked_number, described
from trompe_shared.errors import RendererError


@dataclass(frozen=True)
class Scenario:
    """A scenario as read; ``objects`` holds an error message in place of each object with a wrong description.

    ``frustum_far``: metres to the far end of the view frustum around its objects; ``None`` without one.
    """

    scene: str
    objects: tuple[ObjectRequest | str, ...]
    frustum_far: float | None


def read_scenario(table: Mapping[str, Any]) -> Scenario:
    """Raises ``RendererError`` for errors outside single objects."""
    objects = [_object_or_error(row) for row in table["objects"]]
    delays = _start_times(table.get("timings"), [None if isinstance(each, str) else each.motion for each in objects])
    timed = (e if isinstance(e, str) else replace(e, delay=delay) for e, delay in zip(objects, delays, strict=True))
    return Scenario(str(table.get("scene_name")), tuple(timed), _frustum_far(table))


def _object_or_error(row: Mapping[str, Any]) -> ObjectRequest | str:
    try:
        with described("An object of the scenario"):
            dynamic = row.get("dynamic")
            return ObjectRequest(
                name=str(row["prefab"]),
                pose=Pose.of(vector_of(row["position"], "position"), vector_of(row["rotation"], "rotation")),
                motion=motion_of(str(dynamic["type"]), dynamic["description"]) if dynamic else None,
                limited=bool(row.get("frustum_limited", True)),
            )
    except RendererError as error:
        return str(error)


def _frustum_far(table: Mapping[str, Any]) -> float | None:
    with described("The scenario's frustum"):
        frustum = table.get("frustum") or {}
        return checked_number(frustum["far_clip_plane"], "far_clip_plane", low=1.0) if frustum.get("spawn") else None


def _start_times(timings: Mapping[str, Any] | None, motions: Sequence[Motion | None]) -> list[float]:
    if not timings:
        return [0.0] * len(motions)
    with described("The timings of the scenario"):
        kind, table = timings["type"], timings["description"]
        if kind == "all_together":
            return [_wait(table)] * len(motions)
        if kind == "wait_until_complete":
            return list(_one_after_another(_wait(table), motions))
        if kind == "dict":
            times = table["times"]
            return [checked_number(times.get(str(k), 0.0), "start time", low=0.0) for k in range(len(motions))]
    raise RendererError(f"There are no timings {kind!r}. Choose all_together, wait_until_complete or dict.")


def _wait(table: Mapping[str, Any]) -> float:
    return checked_number(table["wait_time"], "wait_time", low=0.0)


def _one_after_another(wait: float, motions: Sequence[Motion | None]) -> Iterator[float]:
    """Start times: each ``wait`` seconds after the end of the movement before, or never after an endless one."""
    start = wait
    for motion in motions:
        yield start
        start += (motion.duration if motion else 0.0) + wait
