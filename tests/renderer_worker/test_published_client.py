"""SAILenv's own client, as published, against the worker: what it can do with Unity it can do here."""

import importlib
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trompe_server.target import SailenvTarget
from trompe_shared.geometry import Camera, Light, View, light_travel_direction, sailenv_pose
from trompe_shared.object3d import Object3D


@pytest.fixture
def agent(worker: tuple[str, int]) -> Iterator[Any]:
    pytest.importorskip("PIL")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the client imports typing.io
        module = pytest.importorskip("sailenv", reason="pip install sailenv==0.5b0 (Python 3.12 at most)")
        module = importlib.import_module("sailenv.agent")
    agent = module.Agent(host=worker[0], port=worker[1], width=48, height=32)
    agent.socket.settimeout(60)
    agent.register()
    yield agent
    agent.delete()
    agent.socket.close()


def test_the_published_client_sees_what_our_own_sees(
    agent: Any, target: SailenvTarget, make_boxes: Callable[..., Object3D], tmp_path: Path
) -> None:
    box, view = make_boxes(), View(Camera(0.3, 40, 25), Light(30, 60, 0.75, 0.2), (10, 20, 30))
    path = tmp_path / "box.zip"
    path.write_bytes(box.to_zip())
    instance = agent.spawn_object("file:" + agent.send_obj_zip(str(path)))
    position, rotation = sailenv_pose(view.camera)
    agent.set_position(position)
    agent.set_rotation(rotation)
    agent.set_light_direction("Main Light", light_travel_direction(view.light))
    agent.set_light_intensity("Main Light", 0.75)
    agent.set_ambient_light_color(51, 51, 51)
    agent.change_main_camera_clear_flags(10, 20, 30)
    frame = agent.get_frame()
    ours = target.render(box, [view], size=(32, 48))[0]
    assert (np.rint(255 * frame["main"][:, ::-1]).astype(np.uint8) == ours).all()
    assert frame["category"].shape == frame["depth"].shape == (32, 48)
    assert frame["flow"].shape == (32, 48, 2)
    assert np.allclose(agent.get_position(), position)
    agent.despawn_object(instance)
    assert agent.spawned_objects_idstr_names_table == {}


def test_the_published_client_can_change_the_scene_and_is_told_what_there_is(agent: Any) -> None:
    agent.change_scene(agent.scenes[0])
    assert agent.lights_names == ["Main Light", "Rim Light"]
    assert agent.spawnable_objects_names == []
    assert agent.get_light_color("Main Light") is not None


def test_the_published_client_learns_that_a_broken_zip_was_not_spawned(agent: Any, tmp_path: Path) -> None:
    path = tmp_path / "broken.zip"
    path.write_bytes(b"broken")
    assert agent.spawn_object("file:" + agent.send_obj_zip(str(path))) == ""
    assert agent.get_frame()["main"].shape == (32, 48, 3)


def test_the_many_small_sends_of_the_published_client_do_not_wait_for_acknowledgements(agent: Any) -> None:
    start = time.monotonic()
    for angle in range(20):
        agent.set_position((0, 0, 1))
        agent.set_rotation((180, angle, 180))
    assert time.monotonic() - start < 0.8  # 40 ms a wait would make it 1.6 s
