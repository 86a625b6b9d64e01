"""The worker on the wire: every command, both dialects, and agents that cannot harm each other."""

import io
import math
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest
from PIL import Image

from trompe_renderer.link import Link, Memory
from trompe_renderer.options import Options
from trompe_renderer.server import MAX_AGENTS, MOST_TOLD, Server, Shared, _Agent
from trompe_renderer.session import Session
from trompe_shared.errors import ProtocolError, RendererError
from trompe_shared.object3d import Object3D, encode_png, pack_zip
from trompe_shared.sailenv import COMMANDS, MAX_TEXT, VIEW_FLAGS, Command, decode_frame

Connect = Callable[..., Any]
Boxes = Callable[..., Object3D]
ALL_VIEWS = sum(VIEW_FLAGS.values())

SAMPLES: dict[str, dict[str, Any]] = {
    "change_scene": {"scene": "object_view/scene"},
    "set_position": {"position": (0, 0, 1)},
    "set_rotation": {"rotation": (180, 0, 180)},
    "spawn_object": {
        "name": "mug",
        "position": (0, 0, 0),
        "rotation": (0, 0, 0),
        "remove_dynamics": True,
        "scale": (1, 1, 1),
        "use_parent": True,
    },
    "despawn_object": {"instance": 7},
    "send_obj_zip": {"file": ("x.zip", b"")},
    "set_clear_color": {"color": (1, 2, 3)},
    "set_ambient_light_color": {"color": (1, 2, 3)},
    "move_object": {"instance": 7, "position": (0, 0, 0), "rotation": (0, 0, 0)},
    "load_scenario": {"scenario": {"objects": [{}]}},
    "repaint_object": {"instance": 7, "textures": []},
    "set_background_picture": {"file": ("x.png", encode_png(np.zeros((4, 4, 3), np.uint8)))},
}
"""Field values of each command that has fields; those of the lights are made in ``sample``."""


def sample(command: Command) -> dict[str, Any]:
    values = {"color": (1, 2, 3), "intensity": 0.5, "multiplier": 2.0, "position": (1, 2, 3), "direction": (0, -1, 0)}
    if "light" in command.request:
        return {"light": "Rim Light"} | {name: values[name] for name in command.request if name != "light"}
    return SAMPLES.get(command.name, {})


def is_closed(connection: socket.socket) -> bool:
    """Whether the other side hangs up, with or without reading all it was sent."""
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


def test_every_command_is_answered_in_full(wire: Connect) -> None:
    agent = wire()
    for command in COMMANDS.values():
        if command.name in {"frame", "delete", "render_views"}:
            continue
        try:
            agent.ask(command.name, **sample(command))
        except RendererError:
            assert command.name in {"despawn_object", "move_object", "repaint_object"}
        agent.socket.setblocking(False)
        with pytest.raises(BlockingIOError):
            agent.socket.recv(1)
        agent.socket.settimeout(60)
    assert agent.picture().shape == (32, 48, 3)


@pytest.mark.parametrize("gzip", [False, True])
def test_all_views_have_the_form_that_the_protocol_gives_them(wire: Connect, gzip: bool) -> None:
    views, delta_time = wire(gzip=gzip).views(ALL_VIEWS)
    assert delta_time >= 0
    assert np.array(Image.open(io.BytesIO(views["main"]))).shape == (32, 48, 3)
    assert np.array(Image.open(io.BytesIO(views["object"]))).shape == (32, 48, 3)
    assert np.array(Image.open(io.BytesIO(views["depth"]))).shape == (32, 48)
    assert len(views["category"]) == 32 * 48 * 3
    assert len(views["optical"]) == 32 * 48 * 2 * 4


def test_a_frame_without_views_is_a_delta_time(wire: Connect) -> None:
    assert wire().views(0)[0] == {}


@pytest.mark.parametrize("unused", [2, 64, 128, 2 + 64 + 128])
def test_bits_that_stand_for_no_view_add_none(wire: Connect, unused: int) -> None:
    agent = wire()
    agent.socket.sendall(COMMANDS["frame"].encode_request(flags=unused + 32))
    length = int.from_bytes(agent.read(4), "little")
    assert Image.open(io.BytesIO(agent.read(length))).mode == "L"
    assert struct.unpack("<f", agent.read(4))[0] >= 0
    assert agent.ask("get_position") == (0, 0, 0)


def test_the_handshake_names_the_agent_and_the_scenes(wire: Connect) -> None:
    first, second = wire(), wire()
    assert first.agent != second.agent
    assert first.scenes[0] == "object_view/scene"


@pytest.mark.parametrize("tail", [{}, {"frustum_limited": True, "dynamic": None}], ids=["short", "long"])
def test_both_dialects_of_spawn_are_understood(wire: Connect, make_boxes: Boxes, tail: dict[str, Any]) -> None:
    agent = wire()
    for number in (1, 2):
        assert agent.spawn(make_boxes(), **tail) == str(number)
    agent.ask("set_position", position=(0, 0, 0.3))
    agent.ask("set_rotation", rotation=(180, 0, 180))
    assert (agent.picture()[16, 24] != 255).any()
    agent.ask("despawn_object", instance=1)
    agent.ask("despawn_object", instance=2)
    assert (agent.picture() == 255).all()


def test_the_picture_is_sent_mirrored_as_unity_shows_it(wire: Connect, make_boxes: Boxes) -> None:
    agent = wire()
    agent.spawn(make_boxes(((0.05, 0, 0), (0.02, 0.02, 0.02))))
    agent.ask("set_position", position=(0, 0, 0.3))
    agent.ask("set_rotation", rotation=(180, 0, 180))
    columns = np.nonzero((agent.picture() != 255).any(axis=(0, 2)))[0]
    assert columns.max() < 24


def test_an_object_is_placed_turned_and_scaled_as_unity_would(wire: Connect, make_boxes: Boxes) -> None:
    agent = wire(size=(64, 64))
    agent.ask("set_position", position=(0, 0, 0.5))
    agent.ask("set_rotation", rotation=(180, 0, 180))
    agent.spawn(make_boxes(((0.05, 0, 0), (0.02, 0.01, 0.01))), rotation=(0, 0, 90), scale=(2, 1, 1))
    rows, columns = np.nonzero((agent.picture() != 255).any(axis=-1))
    assert rows.max() < 32  # x became up
    assert 2.5 * np.ptp(columns) < np.ptp(rows) < 6 * np.ptp(columns)
    agent.ask("move_object", instance=1, position=(0, -0.2, 0), rotation=(0, 0, 90))
    assert np.nonzero((agent.picture() != 255).any(axis=-1))[0].min() > 32


def test_lights_say_what_they_were_told(wire: Connect) -> None:
    agent = wire()
    assert agent.ask("get_lights_names") == ["Main Light", "Rim Light"]
    assert agent.ask("get_light_type", light="Main Light") == "Directional"
    assert agent.ask("get_light_type", light="Sun") == "light_not_found"
    for name, value in (("color", (10, 20, 30)), ("intensity", 0.25), ("indirect_multiplier", 3.0)):
        field = "multiplier" if name == "indirect_multiplier" else name
        agent.ask(f"set_light_{name}", light="Rim Light", **{field: value})
        assert agent.ask(f"get_light_{name}", light="Rim Light") == value
    for name in ("position", "direction"):
        agent.ask(f"set_light_{name}", light="Main Light", **{name: (1.0, -2.0, 0.5)})
        assert agent.ask(f"get_light_{name}", light="Main Light") == (1.0, -2.0, 0.5)
    assert agent.ask("get_ambient_light_color") == (128, 128, 128)


def test_the_rim_light_lights_once_it_has_an_intensity(wire: Connect, make_boxes: Boxes) -> None:
    agent = wire()
    agent.spawn(make_boxes())
    agent.ask("set_position", position=(0, 0, 0.3))
    agent.ask("set_rotation", rotation=(180, 0, 180))
    agent.ask("set_light_intensity", light="Main Light", intensity=0.0)
    dark = agent.picture()[16, 24].astype(int)
    agent.ask("set_light_direction", light="Rim Light", direction=(0, 0, -1))
    agent.ask("set_light_color", light="Rim Light", color=(255, 0, 0))
    assert (agent.picture()[16, 24] == dark).all()
    agent.ask("set_light_intensity", light="Rim Light", intensity=0.5)
    red, _, blue = agent.picture()[16, 24].astype(int) - dark
    assert red > 20
    assert blue <= 2


@pytest.mark.parametrize(
    ("command", "values"),
    [
        pytest.param("set_position", {"position": (math.nan, 0, 0)}, id="position not a number"),
        pytest.param("set_rotation", {"rotation": (math.inf, 0, 0)}, id="rotation infinite"),
        pytest.param("set_clear_color", {"color": (0, 256, 0)}, id="colour out of range"),
        pytest.param("set_light_intensity", {"light": "Main Light", "intensity": -1}, id="negative light"),
        pytest.param("set_light_direction", {"light": "Main Light", "direction": (0, 0, 0)}, id="no direction"),
        pytest.param("set_light_color", {"light": "Sun", "color": (0, 0, 0)}, id="no such light"),
        pytest.param("set_light_indirect_multiplier", {"light": "Sun", "multiplier": 1.0}, id="no such light either"),
        pytest.param("get_light_direction", {"light": "Sun"}, id="no direction of no light"),
        pytest.param("change_scene", {"scene": "room"}, id="no such scene"),
        pytest.param("move_object", SAMPLES["move_object"], id="no such instance to move"),
        pytest.param("despawn_object", {"instance": 99}, id="no such instance"),
    ],
)
def test_what_makes_no_sense_is_refused_with_a_reason_that_can_be_asked_again(
    wire: Connect, command: str, values: dict[str, Any]
) -> None:
    agent = wire()
    with pytest.raises(RendererError) as refusal:
        agent.ask(command, **values)
    reason = agent.ask("last_error")
    assert len(reason) > 10
    assert reason in str(refusal.value)
    assert agent.ask("last_error") == ""


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        pytest.param(b"PK no zip at all", "zip", id="not a zip"),
        pytest.param(pack_zip({"readme.txt": b"hello"}), ".obj", id="no mesh"),
        pytest.param(pack_zip({"a.obj": b"v 0 0 0\nf 1 2 3\n"}), "a.obj", id="broken mesh"),
    ],
)
def test_a_broken_object_is_stored_and_its_spawn_refused(wire: Connect, data: bytes, reason: str) -> None:
    agent = wire()
    path = agent.ask("send_obj_zip", file=("a.zip", data))
    assert path
    assert agent.ask("spawn_object", **(SAMPLES["spawn_object"] | {"name": f"file:{path}"})) == ""
    assert reason in agent.ask("last_error")
    assert agent.picture().shape == (32, 48, 3)


@pytest.mark.parametrize("name", ["file:/etc/passwd", "file:../x.zip", "box", "file:"])
def test_only_paths_that_this_agent_was_given_can_be_spawned(wire: Connect, make_boxes: Boxes, name: str) -> None:
    wire().spawn(make_boxes())
    assert wire().ask("spawn_object", **(SAMPLES["spawn_object"] | {"name": name})) == ""


def test_a_fresh_scene_is_empty_and_lit_as_at_the_start(wire: Connect, make_boxes: Boxes) -> None:
    agent = wire()
    agent.spawn(make_boxes())
    agent.ask("set_light_intensity", light="Main Light", intensity=9.0)
    agent.ask("set_clear_color", color=(0, 0, 0))
    agent.ask("change_scene", scene="object_view/scene")
    assert agent.ask("get_light_intensity", light="Main Light") == 1.25
    assert (agent.picture() == 255).all()


def test_agents_do_not_see_each_others_objects(wire: Connect, make_boxes: Boxes) -> None:
    busy, idle = wire(), wire()
    for agent in (busy, idle):
        agent.ask("set_position", position=(0, 0, 0.3))
        agent.ask("set_rotation", rotation=(180, 0, 180))
    busy.spawn(make_boxes())
    assert (busy.picture() != 255).any()
    assert (idle.picture() == 255).all()


@pytest.mark.parametrize(
    "junk",
    [
        pytest.param(bytes([0xAA]) * 100, id="unknown command"),
        pytest.param(b"\x02" + struct.pack("<i", -5), id="negative length"),
        pytest.param(b"\x1d" + struct.pack("<i", 2) + b"{}", id="a scenario whose reply has no length"),
        pytest.param(b"\x0c" + struct.pack("<i", 2**31 - 1), id="huge length"),
        pytest.param(bytes(np.random.default_rng(5).integers(0x20, 0xDF, 1000, dtype=np.uint8)), id="noise"),
    ],
)
def test_an_agent_that_talks_nonsense_is_closed_and_no_other(wire: Connect, junk: bytes) -> None:
    good, bad = wire(), wire()
    bad.socket.sendall(junk)
    assert is_closed(bad.socket)
    assert good.picture().shape == (32, 48, 3)


@pytest.mark.parametrize("hello", [struct.pack("<ii?", 0, 10, False), struct.pack("<ii?", 10, 100_000, False)])
def test_a_handshake_for_images_of_impossible_size_is_closed(worker: tuple[str, int], hello: bytes) -> None:
    with socket.create_connection(worker, timeout=60) as connection:
        connection.sendall(hello)
        assert is_closed(connection)


def test_an_agent_that_hangs_up_in_mid_sentence_leaves_the_worker_alive(worker: tuple[str, int], wire: Connect) -> None:
    with socket.create_connection(worker, timeout=60) as connection:
        connection.sendall(b"\x10")
    assert wire().picture().shape == (32, 48, 3)


def test_delete_ends_the_connection(wire: Connect) -> None:
    agent = wire()
    agent.socket.sendall(COMMANDS["delete"].encode_request())
    assert is_closed(agent.socket)


def test_a_worker_that_cannot_listen_says_so(worker: tuple[str, int]) -> None:
    command = [sys.executable, "-m", "trompe_renderer", "--port", str(worker[1])]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 1
    assert ended.stdout == ""
    assert f"Cannot listen on 127.0.0.1:{worker[1]}" in ended.stderr


def test_an_upload_of_the_same_bytes_gets_the_same_path_and_of_others_another(wire: Connect, make_boxes: Boxes) -> None:
    agent, box = wire(), make_boxes()
    paths = [agent.ask("send_obj_zip", file=("same name", data)) for data in (box.to_zip(), box.to_zip(), b"other")]
    assert paths[0] == paths[1] != paths[2]


class _BrokenRenderer:
    def render(self, *_args: object, **_options: object) -> None:
        raise RuntimeError("out of memory")

    survey = render


@contextmanager
def agent_of_a_broken_renderer(wire_to: Connect, **shared_values: Any) -> Iterator[Any]:
    """Agent 3 of a server in this process, which can answer everything but draw nothing."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            connection = listener.accept()[0]
            with connection:
                shared = Shared(_BrokenRenderer(), Options(), **shared_values)  # type: ignore[arg-type]
                with suppress(ProtocolError):
                    _Agent(Link(connection, Memory()), 3, shared).serve()

        thread = threading.Thread(target=serve)
        thread.start()
        agent = wire_to(listener.getsockname())
        yield agent
        with suppress(OSError):
            agent.socket.sendall(COMMANDS["delete"].encode_request())
        thread.join(timeout=30)
        agent.socket.close()


@pytest.mark.parametrize("flags", [1, 4, 32, ALL_VIEWS])
def test_a_frame_that_cannot_be_rendered_is_sent_flat_and_marked(wire_to: Connect, flags: int) -> None:
    with agent_of_a_broken_renderer(wire_to) as agent:
        views, delta_time = agent.views(flags)
        assert math.isnan(delta_time)
        assert list(views) == [name for name, bit in VIEW_FLAGS.items() if flags & bit]
        if "main" in views:
            assert np.array(Image.open(io.BytesIO(views["main"]))).shape == (32, 48, 3)
        assert "out of memory" in agent.ask("last_error")


@pytest.mark.parametrize("flags", [0, 1, ALL_VIEWS])
def test_each_view_is_sent_whole_once_the_one_before_is_on_its_way(
    wire_to: Connect, monkeypatch: pytest.MonkeyPatch, flags: int
) -> None:
    """The published client reads a length by one ``recv``: if a segment ends within it, the stream is lost."""
    done: list[Any] = []
    send, drain = Link.send, Link.drain

    def note_send(link: Link, *pieces: Any) -> None:
        done.append(b"".join(map(bytes, pieces)))
        send(link, *pieces)

    def note_drain(link: Link) -> None:
        drain(link)
        done.append("drained")

    with agent_of_a_broken_renderer(wire_to) as agent:
        monkeypatch.setattr(Link, "send", note_send)
        monkeypatch.setattr(Link, "drain", note_drain)
        agent.views(flags)
        monkeypatch.undo()
    views = flags.bit_count()
    assert done[1::2] == ["drained"] * max(views - 1, 0)
    for number, piece in enumerate(done[::2], start=1):
        rest = 4 if number >= views else 0  # deltaTime goes with the last view
        assert len(piece) == (4 + int.from_bytes(piece[:4], "little") if views else 0) + rest


@pytest.mark.parametrize(
    ("command", "values", "answer"),
    [
        pytest.param("spawn_object", SAMPLES["spawn_object"], "", id="an empty text"),
        pytest.param("send_obj_zip", SAMPLES["send_obj_zip"], "", id="no path"),
        pytest.param("load_scenario", {"scenario": {"objects": [{}, {}, {}]}}, ("", "", ""), id="ids that are missing"),
        pytest.param("set_position", SAMPLES["set_position"], None, id="a status"),
    ],
)
def test_an_error_of_the_worker_is_answered_in_full_like_a_refusal(
    wire_to: Connect, monkeypatch: pytest.MonkeyPatch, command: str, values: dict[str, Any], answer: Any
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise MemoryError("none left")

    monkeypatch.setattr(Session, command, fail)
    with agent_of_a_broken_renderer(wire_to) as agent:
        if command == "load_scenario":
            assert agent.load(values["scenario"]) == answer
        elif answer is None:
            with pytest.raises(RendererError, match="none left"):
                agent.ask(command, **values)
        else:
            assert agent.ask(command, **values) == answer
        assert "none left" in agent.ask("last_error")
        assert agent.ask("get_position") == (0, 0, 0)


@pytest.mark.parametrize("letter", ["x", "\0", "€", "\U0001f600"])
def test_the_reason_of_a_refusal_is_no_longer_than_can_be_told(wire_to: Connect, letter: str) -> None:
    with agent_of_a_broken_renderer(wire_to) as agent:
        with pytest.raises(RendererError, match="no scene"):
            agent.ask("change_scene", scene=letter * MAX_TEXT)
        assert len(agent.ask("last_error")) <= MOST_TOLD
        assert agent.ask("get_position") == (0, 0, 0)


def test_a_large_frame_waits_until_there_is_memory_for_it_and_a_small_one_does_not(
    wire_to: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = Memory(1000)
    memory.take(1, timeout=0)
    with agent_of_a_broken_renderer(wire_to, pictures=memory) as agent:
        agent.views(ALL_VIEWS)
        monkeypatch.setattr("trompe_renderer.server.SMALL", 1000)
        agent.views(0)
        agent.socket.sendall(COMMANDS["frame"].encode_request(flags=ALL_VIEWS))
        agent.socket.settimeout(0.3)
        with pytest.raises(TimeoutError):
            agent.socket.recv(1)
        memory.give_back(1)
        agent.socket.settimeout(60)
        decode_frame(agent.read, flags=ALL_VIEWS, compressed=False)
        agent.views(ALL_VIEWS)  # what was lent has come back


@contextmanager
def server_without_opengl(monkeypatch: pytest.MonkeyPatch, listener: Any) -> Iterator[Server]:
    """A server in this process that can draw nothing."""
    monkeypatch.setattr("trompe_renderer.server.Renderer", lambda _: _BrokenRenderer())
    server = Server(listener)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server
    server.stop()
    thread.join(timeout=30)


class _Exhausted:
    """A listening socket that has no file descriptor left for the first agent."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener, self._failed = listener, False
        self.fileno, self.getsockname, self.close = listener.fileno, listener.getsockname, listener.close

    def accept(self) -> Any:
        if not self._failed:
            self._failed = True
            raise OSError(24, "Too many open files")
        return self._listener.accept()


def test_an_agent_that_cannot_be_accepted_does_not_end_the_worker(
    wire_to: Connect, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with server_without_opengl(monkeypatch, _Exhausted(socket.create_server(("127.0.0.1", 0)))) as server:
        agent = wire_to(server.address)
        assert agent.ask("get_position") == (0, 0, 0)
        agent.socket.close()
    assert "cannot be accepted: [Errno 24]" in caplog.text


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        pytest.param(b"\x0c" + struct.pack("<i", 5) + b"x", "closed at send_obj_zip: timed out", id="stays silent"),
        pytest.param(b"\xaa", "closed at 0xaa, what it sent is malformed", id="unknown command"),
        pytest.param(b"\x02" + struct.pack("<i", -5), "closed at change_scene, what it sent", id="negative length"),
    ],
)
def test_an_agent_that_is_closed_is_logged_with_its_command_and_the_reason(
    wire_to: Connect, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, sent: bytes, said: str
) -> None:
    monkeypatch.setattr(Link.__init__, "__kwdefaults__", {"timeout": 0.2})
    with server_without_opengl(monkeypatch, socket.create_server(("127.0.0.1", 0))) as server:
        agent = wire_to(server.address)
        agent.socket.sendall(sent)
        assert is_closed(agent.socket)
        agent.socket.close()
    assert f"agent {agent.agent}: {said}" in caplog.text


@pytest.mark.parametrize(
    ("command", "values", "reason"),
    [
        pytest.param("change_scene", {"scene": "moon/scene"}, "moon/scene", id="with a status"),
        pytest.param("get_light_color", {"light": "Sun"}, "Sun", id="instead of a value"),
        pytest.param("get_light_type", {"light": "Sun"}, "Sun", id="by a word of its own"),
        pytest.param("spawn_object", SAMPLES["spawn_object"] | {"name": "yeti"}, "yeti", id="by an empty text"),
        pytest.param("load_scenario", SAMPLES["load_scenario"], "None", id="by ids that are missing"),
    ],
)
def test_every_refusal_is_logged_with_the_agent_the_command_and_the_reason(
    wire_to: Connect, caplog: pytest.LogCaptureFixture, command: str, values: dict[str, Any], reason: str
) -> None:
    with agent_of_a_broken_renderer(wire_to) as agent:
        with suppress(RendererError):
            agent.ask(command, **values)
        assert reason in agent.ask("last_error")
    messages = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert any(text.startswith(f"agent 3: refused {command}: ") and reason in text for text in messages)


def test_more_agents_than_there_are_places_are_turned_away_until_one_leaves(
    worker: tuple[str, int], wire_to: Connect
) -> None:
    agents = []
    with suppress(EOFError, ConnectionError):
        for _ in range(MAX_AGENTS + 1):
            agents.append(wire_to(worker))
    assert len(agents) <= MAX_AGENTS
    assert agents[0].picture().shape == (32, 48, 3)
    for agent in agents:
        agent.socket.close()
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            late = wire_to(worker)
        except (EOFError, ConnectionError):
            time.sleep(0.05)
        else:
            late.socket.close()
            return
    raise AssertionError("no place became free")
