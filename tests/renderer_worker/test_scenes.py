"""Scenes, scenarios, and backgrounds: a colour or the sky."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.wire import Wire, boxes, pixel_rays
from trompe_renderer.world.scenes import CATEGORIES, SCENES, scene_named
from trompe_shared.errors import RendererError
from trompe_shared.geometry import Camera
from trompe_shared.shipped import shipped_objects

Connect = Callable[..., Wire]
ROOM = "room_01/scene"


@pytest.fixture
def room(wire: Connect) -> Wire:
    agent = wire(size=(90, 120), long=True)
    agent.ask("change_scene", scene=ROOM)
    return agent


def names_in(agent: Any) -> set[str]:
    """Kinds of things in the next frame."""
    names = dict(agent.ask("get_categories"))
    return {names[int(number)] for number in np.unique(agent.labels()["category"])}


def test_all_scenes_are_named_at_the_handshake_and_can_be_loaded(wire: Connect) -> None:
    agent = wire()
    assert agent.scenes == list(SCENES) == ["object_view/scene", ROOM]
    for scene in agent.scenes:
        agent.ask("change_scene", scene=scene)
        assert agent.picture().shape == (32, 48, 3)


def test_the_room_is_furnished_and_its_first_view_shows_it(room: Wire) -> None:
    assert {"table", "chair", "teapot", "mug", "floor", "wall", "window", "rug"} <= names_in(room)
    picture = room.picture()
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 1000
    assert 60 < picture.mean() < 180


def test_from_inside_the_room_nothing_but_the_window_looks_out(room: Wire) -> None:
    seen: set[str] = set()
    for azimuth in range(0, 360, 45):
        for elevation in (-60, 0, 60):
            room.ask("set_position", position=(-0.9, 1.3, 0.9))
            room.ask("set_rotation", rotation=(elevation, azimuth, 0))
            views = room.labels()
            outside = views["category"] == 0
            seen |= {name for name, number in CATEGORIES.items() if (views["category"] == number).any()}
            if outside.any():
                columns = np.nonzero(outside)[1]
                around = views["category"][:, max(columns.min() - 3, 0) : columns.max() + 4]
                assert (around == CATEGORIES["window"]).any()
    assert seen >= {"none", "ceiling", "cupboard", "door", "floor", "picture", "rug", "wall", "window", "ball", "lamp"}


def test_the_rooms_furniture_stands_on_something() -> None:
    grounds = {0.0, 0.013, 0.753, 0.86}
    for fixture in scene_named(ROOM).static_objects[8:]:
        lowest = min(part.vertices[:, 1].min() for part in fixture.model.obj.parts) + fixture.pose.position[1]
        assert min(abs(lowest - ground) for ground in grounds) < 1e-3


def test_the_room_has_lights_of_both_kinds_and_the_point_light_falls_with_the_square_of_distance(room: Wire) -> None:
    lights = room.ask("get_lights_names")
    kinds = {light: room.ask("get_light_type", light=light) for light in lights}
    assert kinds == {"Main Light": "Directional", "Rim Light": "Directional", "Ceiling Light": "Point"}
    for light in lights:
        room.ask("set_light_intensity", light=light, intensity=0.0)
    room.ask("set_ambient_light_color", color=(0, 0, 0))
    indoors = room.labels()["category"] != CATEGORIES["none"]
    assert np.median(room.picture()[indoors]) == 0
    assert (room.picture()[indoors] == 0).mean() > 0.95  # all but the sky at the window's edge
    white = {"front": np.full((4, 4, 3), 255, np.uint8)}
    room.spawn(boxes(textures=white), position=(-1, 1, 0))
    room.ask("set_position", position=(-1, 1, 0.3))
    room.ask("set_rotation", rotation=(0, 180, 0))
    room.ask("set_light_intensity", light="Ceiling Light", intensity=0.5)
    room.ask("set_light_color", light="Ceiling Light", color=(255, 255, 255))
    levels = []
    for distance in (1.0, 2**0.5, 2.0):
        room.ask("set_light_position", light="Ceiling Light", position=(-1, 1, 0.04 + distance))
        levels.append((room.picture()[45, 60] / 255.0) ** 2.2)
    assert np.allclose(levels, np.outer([0.5, 0.25, 0.125], np.ones(3)), atol=0.03)


def test_fixtures_cannot_be_moved_or_removed_and_spawned_things_are_numbered_after_them(room: Wire) -> None:
    for command, values in (
        ("despawn_object", {"instance": 1}),
        ("move_object", {"instance": 1, "position": (0, 0, 0), "rotation": (0, 0, 0)}),
    ):
        with pytest.raises(RendererError, match="No object 1"):
            room.ask(command, **values)
    number = int(room.spawn_named("ball", position=(0, 1.5, 0)))
    assert number == len(scene_named(ROOM).static_objects) + 1
    room.ask("despawn_object", instance=number)


def test_furniture_casts_shadows_in_the_room_and_its_walls_do_not(
    wire: Connect, shadowless_worker: tuple[str, int], room: Wire
) -> None:
    plain = wire(shadowless_worker, size=(90, 120))
    plain.ask("change_scene", scene=ROOM)
    lit, shaded = (agent.picture().astype(int) for agent in (plain, room))
    darker = (lit - shaded).max(axis=-1) > 10
    floor = np.isin(room.labels()["category"], (CATEGORIES["floor"], CATEGORIES["rug"]))
    assert 0.1 < darker[floor].mean() < 0.7


def test_the_script_makes_the_room_that_is_shipped(tmp_path: Path) -> None:
    root = Path(__file__).parents[2]
    script = [sys.executable, str(root / "scripts" / "make_room.py"), "--out", str(tmp_path)]
    subprocess.run(script, check=True, capture_output=True, timeout=240)
    shipped = root / "renderer_worker" / "trompe_renderer" / "world" / "room_01"
    assert sorted(p.name for p in shipped.iterdir()) == sorted(p.name for p in tmp_path.iterdir())
    assert json.loads((shipped / "scene.json").read_text()) == json.loads((tmp_path / "scene.json").read_text())
    for path in shipped.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name


# --- backgrounds ---


@pytest.mark.parametrize("elevation", [-70, -20, 0, 15, 60])
def test_the_sky_has_its_horizon_where_the_camera_is_level(wire: Connect, elevation: float) -> None:
    agent, camera = wire(), Camera(1.0, 30, elevation)
    agent.look(camera)
    agent.ask("set_clear_color", color=(-1, 0, -1))
    picture, rays = agent.picture().astype(int), pixel_rays(agent.size) @ camera.world_to_camera()[:3, :3]
    up = rays[..., 1] / np.linalg.norm(rays, axis=-1)  # sine of the height above the horizon
    blue = picture[..., 2] > picture[..., 0] + 10
    assert blue[up > 0.02].all()
    assert not blue[up < -0.02].any()
    bright = picture[..., 0][up > 0.02]
    if len(bright) > 100:
        assert np.corrcoef(bright, up[up > 0.02])[0, 1] < -0.8  # deeper blue towards the zenith
    agent.ask("set_clear_color", color=(1, 2, 3))
    assert (agent.picture() == (1, 2, 3)).all()


def test_edges_blend_with_the_background(wire: Connect) -> None:
    agent = wire(size=(48, 64))
    agent.look(Camera(0.4, 30, 25))
    agent.spawn(boxes())
    pictures = []
    for level in (40, 200):
        agent.ask("set_clear_color", color=(level, level, level))
        pictures.append(agent.picture().astype(int))
    partly = (pictures[1] - pictures[0])[..., 0]
    assert ((partly > 20) & (partly < 140)).sum() > 10


@pytest.mark.parametrize("name", sorted(shipped_objects()))
def test_every_object_that_is_shipped_can_be_spawned_by_its_name(wire: Connect, name: str) -> None:
    agent = wire(long=True)
    assert name in agent.ask("get_spawnable_objects_names")
    agent.look(Camera(shipped_objects()[name].distance, 30, 20))
    assert agent.spawn_named(name) == "1"
    assert names_in(agent) == {"none", name}


# --- scenarios ---


def actor(prefab: str, **more: Any) -> dict[str, Any]:
    at = {"x": 0.0, "y": 0.0, "z": 0.0}
    return {"id": prefab, "prefab": prefab, "position": at, "rotation": at, "dynamic": None} | more


def scenario(*objects: Any, **more: Any) -> dict[str, Any]:
    return {"scene_name": "object_view/scene", "objects": list(objects)} | more


def test_a_scenario_loads_its_scene_spawns_its_objects_and_leaves_the_camera(wire: Connect) -> None:
    agent = wire(long=True)
    agent.look(Camera(1.5, 20, 10))
    agent.spawn_named("book")
    ids = agent.load(scenario(actor("mug"), actor("chair", position={"x": 0.4, "y": 0, "z": 0})))
    assert ids == ("1", "2")
    assert np.allclose(agent.ask("get_position"), Camera(1.5, 20, 10).position())
    assert names_in(agent) == {"none", "mug", "chair"}
    assert agent.load(scenario(scene_name=ROOM)) == ()
    assert agent.ask("get_lights_names")[-1] == "Ceiling Light"


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        pytest.param(actor("zeppelin"), "no object 'zeppelin'", id="no such object"),
        pytest.param({"prefab": "mug"}, "KeyError", id="fields are missing"),
        pytest.param("mug", "AttributeError", id="not an object"),
        pytest.param(actor("mug", dynamic={"type": "fly", "description": {}}), "fly", id="no such movement"),
        pytest.param(actor("mug", position={"x": 1e30, "y": 0, "z": 0}), "finite", id="too far away"),
        pytest.param(actor("mug", position={"x": 10**400, "y": 0, "z": 0}), "OverflowError", id="no float is so large"),
    ],
)
def test_an_object_of_a_scenario_that_is_refused_has_no_id_and_the_others_have(
    wire: Connect, wrong: Any, reason: str
) -> None:
    agent = wire(long=True)
    assert agent.load(scenario(actor("mug"), wrong, actor("ball"))) == ("1", "", "2")
    assert reason in agent.ask("last_error")


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        pytest.param({"scene_name": "room_99/scene"}, "room_99", id="no such scene"),
        pytest.param({"timings": {"type": "never", "description": {}}}, "never", id="no such timings"),
        pytest.param({"timings": {"type": "all_together", "description": {}}}, "wait_time", id="no wait time"),
        pytest.param({"frustum": {"spawn": True, "far_clip_plane": -3}}, "far_clip_plane", id="no room to move in"),
    ],
)
def test_a_scenario_that_cannot_be_loaded_changes_nothing_and_gives_no_ids(
    wire: Connect, more: dict[str, Any], reason: str
) -> None:
    agent = wire(long=True)
    agent.look(Camera(0.3, 0, 0))
    agent.spawn_named("book")
    assert agent.load(scenario(actor("mug"), actor("ball"), **more)) == ("", "")
    assert reason in agent.ask("last_error")
    assert names_in(agent) == {"none", "book"}


@pytest.mark.parametrize(
    ("timings", "starts"),
    [
        pytest.param(None, (0, 0, 0), id="none"),
        pytest.param({"type": "all_together", "description": {"wait_time": 1.0}}, (1, 1, 1), id="all together"),
        pytest.param(
            {"type": "wait_until_complete", "description": {"wait_time": 0.5}}, (0.5, 2.0, 3.5), id="one by one"
        ),
        pytest.param({"type": "dict", "description": {"times": {"0": 2.0, "2": 1.0}}}, (2, 0, 1), id="by a table"),
    ],
)
def test_objects_of_a_scenario_start_when_its_timings_say(
    ticking_worker: tuple[str, int], wire: Connect, timings: Any, starts: tuple[float, ...]
) -> None:
    def rising(number: int) -> dict[str, Any]:
        at = {"x": 0.8 * number - 0.8, "y": -0.4, "z": 0.0}
        rows = [{"position": at | {"y": y}, "rotation": {"x": 0, "y": 0, "z": 0}} for y in (-0.4, 0.4)]
        dynamic = {"type": "linear_waypoints", "description": {"waypoints": rows, "total_time": 1.0}}
        return actor("ball", position=at, dynamic=dynamic)

    agent = wire(ticking_worker, size=(60, 80))
    agent.look(Camera(1.6, 0, 0))
    agent.load(scenario(*[rising(number) for number in range(3)], timings=timings))
    rows: list[list[float]] = [[], [], []]
    for _ in range(10):
        colors = agent.labels()["object"]
        for number, third in enumerate(np.array_split(colors[:, ::-1], 3, axis=1)):  # x grows to the left
            rows[number].append(float(np.nonzero(third.any(axis=-1))[0].mean()))
    for start, track in zip(starts, rows, strict=True):
        arrived = 0.5 * (1 + int(np.flatnonzero(np.array(track) < 20)[0]))
        assert arrived == start + 1.0
