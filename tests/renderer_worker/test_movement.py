"""Movement of spawned objects: the paths alone, and on the wire with a fixed time step."""

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.wire import Wire, boxes
from trompe_renderer.world.movement import NO_WALLS, Motion, Pose, frustum_walls, motion_of, room_walls, rotation_of
from trompe_shared.errors import RendererError
from trompe_shared.geometry import FIELD_OF_VIEW, Camera, euler_to_matrix, look_rotation

HERE = Pose(np.zeros(3), rotation_of((0, 0, 0)))
ROOM = room_walls(np.array([-1.0, -1, -1]), np.array([1.0, 1, 1]))


def xyz(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def waypoints(*points: tuple[float, float, float], total_time: float = 4.0, turn: float = 0.0) -> dict[str, Any]:
    """A description as in the git client; each point turns by ``turn`` degrees more about y."""
    rows = [{"position": xyz(*point), "rotation": xyz(0, turn * k, 0)} for k, point in enumerate(points)]
    return {"waypoints": rows, "total_time": total_time}


def bouncing(speed: float = 1.0, seed: int = 42, direction: tuple[float, float, float] = (0, 0, 1)) -> dict[str, Any]:
    return {"start_direction": xyz(*direction), "speed": speed, "angular_speed": 2.0, "seed": seed}


def after(motion: Motion, seconds: float, *, steps: int = 1, walls: Any = NO_WALLS, radius: float = 0.1) -> list[Pose]:
    """Places after each of ``steps`` even steps."""
    place, places, going = HERE, [], motion
    for _ in range(steps):
        if going is not None:
            place, going = going.moved(place, seconds / steps, radius=radius, walls=walls)  # type: ignore[assignment]
        places.append(place)
    return places


@given(st.tuples(*[st.floats(-400, 400)] * 3))
def test_euler_angles_are_unitys(degrees: tuple[float, float, float]) -> None:
    assert np.allclose(rotation_of(degrees).as_matrix(), euler_to_matrix(np.array(degrees)), atol=1e-12)


# --- waypoints ---


def test_linear_waypoints_are_reached_in_turn_at_even_times_and_the_last_is_the_end() -> None:
    motion = motion_of("linear_waypoints", waypoints((0, 0, 0), (1, 0, 0), (1, 2, 0), turn=90))
    places = after(motion, 6.0, steps=6)
    expected = [(0.5, 0, 0), (1, 0, 0), (1, 1, 0), (1, 2, 0), (1, 2, 0), (1, 2, 0)]
    assert np.allclose([place.position for place in places], expected)
    assert np.allclose(places[0].rotation.as_matrix(), euler_to_matrix(np.array([0, 45, 0])))
    assert np.allclose(places[-1].rotation.as_matrix(), euler_to_matrix(np.array([0, 180, 0])))
    assert motion.duration == 4.0
    at_once = after(motion_of("linear_waypoints", waypoints((1, 2, 3))), 0.1)[0]
    assert np.allclose(at_once.position, (1, 2, 3))


def test_catmull_waypoints_go_through_every_point_without_a_corner() -> None:
    points = [(0.0, 0, 0), (1.0, 1, 0), (2.0, 0, 1), (3.0, 0, 0)]
    motion = motion_of("catmull_waypoints", waypoints(*points, total_time=3.0))
    track = np.array([place.position for place in after(motion, 3.0, steps=300)])
    assert np.allclose(track[[99, 199, 299]], points[1:], atol=1e-9)
    assert np.abs(np.diff(track, n=2, axis=0)).max() < 0.002  # speed changes by little from step to step
    straight = motion_of("catmull_waypoints", waypoints((0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0), total_time=3.0))
    assert np.allclose(after(straight, 1.5)[0].position, (1.5, 0, 0))


@given(st.floats(0.01, 20), st.integers(1, 50))
def test_a_position_along_waypoints_depends_only_on_the_time(seconds: float, steps: int) -> None:
    motion = motion_of("catmull_waypoints", waypoints((0, 0, 0), (1, 1, 0), (2, 0, 1), turn=50))
    at_once, stepwise = after(motion, seconds)[-1], after(motion, seconds, steps=steps)[-1]
    assert np.allclose(at_once.position, stepwise.position, atol=1e-6)


# --- uniform movement ---


def test_without_walls_a_uniform_movement_is_straight_and_turns_evenly() -> None:
    places = after(motion_of("uniform_movement_random_bounce", bouncing(speed=2.0, direction=(0, 3, 4))), 3.0, steps=3)
    assert np.allclose([p.position for p in places], np.outer([2, 4, 6], (0, 0.6, 0.8)))
    turns = [place.rotation.as_matrix() for place in places]
    assert np.allclose([np.trace(turns[k].T @ turns[k + 1]) for k in (0, 1)], 1 + 2 * math.cos(2.0))


@settings(max_examples=30)
@given(st.integers(0, 2**40), st.floats(0.1, 30), st.floats(0.05, 0.4))
def test_a_ball_never_leaves_its_room_and_bounces_at_its_surface(seed: int, speed: float, radius: float) -> None:
    motion = motion_of("uniform_movement_random_bounce", bouncing(speed, seed, (1, 2, 3)))
    places = after(motion, 5.0, steps=50, walls=ROOM, radius=radius)
    assert max(np.abs(place.position).max() for place in places) <= 1 - radius + 1e-6
    assert len({tuple(place.position.round(6)) for place in places}) > 25


def test_bounces_depend_on_the_seed_and_between_them_the_speed_is_the_one_asked_for() -> None:
    def track(seed: int, steps: int) -> NDArray[np.float64]:
        motion = motion_of("uniform_movement_random_bounce", bouncing(3, seed))
        return np.array([place.position for place in after(motion, 4, steps=steps, walls=ROOM)])

    assert np.array_equal(track(1, 20), track(1, 20))
    assert not np.allclose(track(1, 20), track(2, 20))
    lengths = np.linalg.norm(np.diff(track(1, 4000), axis=0), axis=1)
    assert np.median(lengths) == pytest.approx(0.003)
    assert lengths.max() < 0.003 + 1e-9


@given(st.floats(-180, 180), st.floats(-89, 89), st.floats(0.5, 2.0), st.tuples(*[st.floats(-3, 3)] * 3))
def test_a_view_frustum_holds_what_the_camera_sees_from_near_to_far(
    azimuth: float, elevation: float, aspect: float, point: tuple[float, float, float]
) -> None:
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = look_rotation(azimuth, elevation), (0.3, -0.2, 0.1)
    walls = frustum_walls(camera, field_of_view=FIELD_OF_VIEW, aspect=aspect, near=0.3, far=2.0)
    x, y, z = camera[:3, :3].T @ (np.array(point) - camera[:3, 3])
    slope = math.tan(math.radians(FIELD_OF_VIEW / 2))
    seen = 0.3 <= -z <= 2.0 and abs(y) <= -z * slope and abs(x) <= -z * slope * aspect
    assert bool((walls[:, :3] @ point + walls[:, 3] >= 0).all()) == seen


@pytest.mark.parametrize(
    ("kind", "description", "reason"),
    [
        pytest.param("fly", {}, "no movement 'fly'", id="unknown"),
        pytest.param("linear_waypoints", "no json", "JSONDecodeError", id="not JSON"),
        pytest.param("linear_waypoints", "[" * 100_000, "RecursionError", id="nested without end"),
        pytest.param("linear_waypoints", {"waypoints": [], "total_time": 1}, "at least one", id="no points"),
        pytest.param("catmull_waypoints", waypoints((0, 0, 0), total_time=0), "total_time", id="no time"),
        pytest.param("catmull_waypoints", waypoints((0, math.nan, 0)), "finite", id="not a number"),
        pytest.param("catmull_waypoints", {"waypoints": [{}], "total_time": 1}, "KeyError", id="no position"),
        pytest.param("uniform_movement_random_bounce", bouncing(direction=(0, 0, 0)), "zero", id="no direction"),
        pytest.param("uniform_movement_random_bounce", bouncing(speed=-1), "speed", id="negative speed"),
        pytest.param("uniform_movement_random_bounce", {"speed": 1}, "KeyError", id="fields are missing"),
        pytest.param("uniform_movement_random_bounce", [], "TypeError", id="not an object"),
        pytest.param("uniform_movement_random_bounce", bouncing() | {"seed": math.inf}, "Overflow", id="endless seed"),
        pytest.param("linear_waypoints", waypoints((0, 10**400, 0)), "OverflowError", id="no float is so large"),
    ],
)
def test_an_invalid_movement_is_refused(kind: str, description: Any, reason: str) -> None:
    with pytest.raises(RendererError, match=reason):
        motion_of(kind, description)


numbers: st.SearchStrategy[Any] = st.floats(-3, 3) | st.sampled_from(
    [math.inf, math.nan, -1e300, 10**400, 1e-320, 0, "7", None, True, [], {}]
)
vectors = st.fixed_dictionaries({"x": numbers, "y": numbers, "z": numbers})
rows = st.lists(st.fixed_dictionaries({"position": vectors, "rotation": vectors}), max_size=3)
tables = st.fixed_dictionaries(
    {"waypoints": rows, "total_time": numbers, "start_direction": vectors}
    | {"speed": numbers, "angular_speed": numbers, "seed": numbers}
)


@given(st.sampled_from(["linear_waypoints", "catmull_waypoints", "uniform_movement_random_bounce"]), tables)
@example("uniform_movement_random_bounce", bouncing() | {"seed": math.inf})
def test_any_description_is_refused_or_gives_finite_poses(kind: str, table: Any) -> None:
    try:
        motion = motion_of(kind, json.dumps(table))
    except RendererError:
        return
    for place in after(motion, 10.0, steps=4, walls=ROOM):
        assert np.isfinite(place.position).all()
        assert np.isfinite(place.rotation.as_quat()).all()


# --- on the wire ---


@pytest.fixture
def ticking(ticking_worker: tuple[str, int], wire: Callable[..., Wire]) -> Wire:
    agent = wire(ticking_worker, size=(48, 64), long=True)
    agent.look(Camera(1.0, 0, 0))
    return agent


def middle(agent: Wire) -> tuple[float, float]:
    """Mean row and column of the objects in the next frame."""
    rows, columns = np.nonzero(agent.mask())
    assert len(rows), "nothing is seen"
    return float(rows.mean()), float(columns.mean())


def test_an_object_follows_its_waypoints_as_frames_go_by_and_its_flow_says_so(ticking: Wire) -> None:
    path = waypoints((0, -0.2, 0), (0, 0.2, 0), total_time=2.0)
    ticking.spawn(boxes(), position=(0.5, 0.5, 0.5), dynamic=("linear_waypoints", json.dumps(path)))
    frames = [ticking.labels() for _ in range(5)]
    masks = [views["object"].any(axis=-1) for views in frames]
    pixels = 0.1 * 48 / 2 / math.tan(math.radians(30)) / 0.96  # of the side that faces the camera
    rows = [np.nonzero(mask)[0].mean() for mask in masks]
    assert np.allclose(np.diff(rows), [-pixels, -pixels, -pixels, 0], atol=0.6)
    flows = [views["optical"][mask].mean(axis=0) for views, mask in zip(frames, masks, strict=True)]
    assert np.allclose(flows[1:], [(0, -pixels)] * 3 + [(0, 0)], atol=0.2)


def test_a_frame_says_how_much_time_has_passed(ticking: Wire, wire: Callable[..., Wire]) -> None:
    assert ticking.views(0)[1] == 0.5
    agent = wire()
    agent.views(0)
    assert 0 < agent.views(0)[1] < 100


def test_move_object_ends_a_movement_and_an_unknown_movement_is_refused(ticking: Wire) -> None:
    path = waypoints((0, -0.3, 0), (0, 0.3, 0))
    ticking.spawn(boxes(), dynamic=("catmull_waypoints", json.dumps(path)))
    ticking.views(0)
    ticking.ask("move_object", instance=1, position=(0, 0, 0), rotation=(0, 0, 0))
    assert middle(ticking) == middle(ticking)
    assert ticking.spawn_named("mug", dynamic=("fly", "{}")) == ""
    assert "fly" in ticking.ask("last_error")


def flying_ball(*, limited: bool, frustum: dict[str, Any] | None) -> dict[str, Any]:
    dynamic = {"type": "uniform_movement_random_bounce", "description": bouncing(0.7, direction=(1, 0.3, 0))}
    ball = {"id": "a", "prefab": "ball", "position": xyz(0, 0, 0), "rotation": xyz(0, 0, 0), "dynamic": dynamic}
    return {"scene_name": "object_view/scene", "objects": [ball | {"frustum_limited": limited}], "frustum": frustum}


def test_in_a_view_frustum_a_limited_object_stays_in_sight_and_another_flies_off(ticking: Wire) -> None:
    ticking.load(flying_ball(limited=True, frustum={"spawn": True, "far_clip_plane": 1.5}))
    assert len({middle(ticking) for _ in range(40)}) > 20
    for limited, frustum in ((False, {"spawn": True, "far_clip_plane": 1.5}), (True, {"spawn": False}), (True, None)):
        ticking.load(flying_ball(limited=limited, frustum=frustum))
        for _ in range(5):
            ticking.views(0)
        assert not ticking.mask().any()
    ticking.ask("change_scene", scene="object_view/scene")
    ticking.look(Camera(1.0, 0, 0))
    ticking.ask("spawn_view_frustum")
    dynamic = "uniform_movement_random_bounce", json.dumps(bouncing(0.7, direction=(1, 0.3, 0)))
    ticking.spawn_named("ball", dynamic=dynamic)
    for _ in range(8):
        middle(ticking)
