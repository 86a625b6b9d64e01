"""SAILenv's published client works with the worker as with Unity."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.wire import boxes
from trompe_server.renderers import SailenvTarget
from trompe_shared.geometry import Camera, Light, View, light_travel_direction, sailenv_pose
from trompe_shared.object3d import Object3D
from trompe_shared.shipped import shipped_objects


@pytest.fixture
def connect(worker: tuple[str, int]) -> Iterator[Callable[..., Any]]:
    """Registers agents of the published client and deletes them in the end."""
    module = pytest.importorskip("sailenv.agent", reason="pip install sailenv==0.5b0 (Python 3.12 at most)")
    agents: list[Any] = []

    def register(**options: Any) -> Any:
        agent = module.Agent(host=worker[0], port=worker[1], **({"width": 48, "height": 32} | options))
        agent.socket.settimeout(240)
        agent.register()
        agents.append(agent)
        return agent

    yield register
    for agent in agents:
        agent.delete()
        assert agent.socket.recv(1) == b""  # the worker hangs up
        agent.socket.close()


@pytest.fixture
def agent(connect: Callable[..., Any]) -> Any:
    return connect()


def zipped(obj: Object3D, folder: Path) -> str:
    path = folder / "box.zip"
    path.write_bytes(obj.to_zip())
    return str(path)


LIGHT_VALUES = {
    "color": (10, 20, 30),
    "intensity": (0.5,),
    "indirect_multiplier": (2.0,),
    "position": ((1.0, 2.0, 3.0),),
    "direction": ((0.0, -1.0, 0.5),),
}
"""Arguments of the client's methods for lights."""


@pytest.mark.parametrize("gzip", [False, True], ids=["plain", "gzip"])
def test_a_whole_script_of_the_published_client_runs(
    connect: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str], gzip: bool
) -> None:
    agent = connect(use_gzip=gzip)
    assert agent.id >= 0
    for scene in reversed(agent.scenes):
        agent.change_scene(scene)
        assert agent.categories[0] == "none"
        assert agent.spawnable_objects_names == sorted(shipped_objects())
        assert set(agent.spawnable_objects_names) < set(agent.categories.values())
    assert agent.lights_names == ["Main Light", "Rim Light"]
    path = agent.send_obj_zip(zipped(boxes(), tmp_path))
    instances = [agent.spawn_object(f"file:{path}"), agent.spawn_object("ball", position=(0.2, 0, 0))]
    assert list(agent.spawned_objects_idstr_names_table) == instances
    _see_sixty_poses(agent)
    for light in agent.lights_names:
        for name, values in LIGHT_VALUES.items():
            getattr(agent, f"set_light_{name}")(light, *values)
            read = getattr(agent, f"get_light_{name}")(light)
            assert np.allclose(read, values[0] if len(values) == 1 else values)
        assert agent.get_light_type(light) == "Directional"
    agent.set_ambient_light_color(40, 50, 60)
    assert agent.get_ambient_light_color() == (40, 50, 60)
    agent.toggle_follow()
    agent.change_main_camera_clear_flags(-1, -1, -1)
    assert not np.allclose(agent.get_frame()["main"][0, 0], 1)
    for instance in instances:
        agent.despawn_object(instance)
    frame = agent.get_frame()
    assert not frame["object"].any()
    assert not frame["category"].any()
    assert capsys.readouterr().out == ""  # the client prints refusals


def _see_sixty_poses(agent: Any) -> None:
    """60 cameras around the origin, all five views of each; every pose shows another picture."""
    mains = set()
    for azimuth in np.linspace(0, 360, 6, endpoint=False):
        for elevation in np.linspace(-60, 60, 10):
            position, rotation = sailenv_pose(Camera(0.5, float(azimuth), float(elevation)))
            agent.set_position(position)
            agent.set_rotation(rotation)
            frame = agent.get_frame()
            shown = frame["object"].any(axis=-1)
            assert shown.any()
            assert (frame["category"][shown] > 0).all()
            assert (frame["depth"][shown] < 1).all()
            assert (frame["depth"][~shown] == 1).all()
            assert (frame["flow"][~shown] == 0).all()
            assert all((size > 0) for size in frame["sizes"].values())
            assert 0 <= frame["deltaTime"] < 60
            assert frame["main"].shape == (32, 48, 3)
            mains.add(frame["main"].tobytes())
    assert len(mains) == 60


def test_the_published_client_receives_refusals_and_only_the_views_that_it_asked_for(
    connect: Callable[..., Any], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    agent = connect(main_frame_active=False, flow_frame_active=False)
    (tmp_path / "broken.zip").write_bytes(b"broken")
    assert agent.spawn_object("file:" + agent.send_obj_zip(str(tmp_path / "broken.zip"))) == ""
    agent.change_scene("moon/scene")
    agent.set_rotation((np.inf, 0, 0))
    assert agent.get_light_type("Sun") is None
    assert agent.spawn_object("yeti") == ""
    agent.despawn_object("77")
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 6
    assert "There is no scene 'moon/scene'" in said[1]
    assert "finite" in said[2]
    frame = agent.get_frame()  # of the views that it asked for
    assert frame["main"] is None
    assert frame["flow"] is None
    assert frame["category"].shape == frame["depth"].shape == (32, 48)


def test_the_published_client_receives_the_same_picture_as_ours(
    agent: Any, target: SailenvTarget, tmp_path: Path
) -> None:
    box, view = boxes(), View(Camera(0.3, 40, 25), Light(30, 60, 0.75, 0.2), (10, 20, 30))
    instance = agent.spawn_object("file:" + agent.send_obj_zip(zipped(box, tmp_path)))
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


def test_the_many_small_sends_of_the_published_client_do_not_wait_for_acknowledgements(agent: Any) -> None:
    seconds = []
    for angle in range(200):
        start = time.monotonic()
        agent.set_position((0, 0, 1))
        agent.set_rotation((180, angle, 180))
        seconds.append(time.monotonic() - start)
    assert np.percentile(seconds, 10) < 0.02  # on a busy machine too; each wait would be one of 40 ms
