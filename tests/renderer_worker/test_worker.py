"""The worker on the wire: every command, both dialects, and agents that cannot harm each other."""

import io
import math
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any
from unittest.mock import DEFAULT, Mock

import numpy as np
import pytest
from PIL import Image

from tests.wire import ORIGIN, Wire, boxes
from trompe_renderer.protocol.agent import MAX_REASON
from trompe_renderer.protocol.limits import Limits, MemoryBudget, Options
from trompe_renderer.protocol.link import Link
from trompe_renderer.protocol.server import Server
from trompe_renderer.protocol.session import Session
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError
from trompe_shared.geometry import Camera
from trompe_shared.local_files import pack_zip
from trompe_shared.sailenv import COMMANDS, MAX_TEXT, VIEW_FLAGS, decode_frame

Connect = Callable[..., Wire]
ALL_VIEWS = sum(VIEW_FLAGS.values())
NEAR = Camera(0.3, 0, 0)

SPAWN = ORIGIN | {"name": "mug", "remove_dynamics": True, "use_parent": True}


def is_closed(connection: socket.socket) -> bool:
    """Whether the other side hangs up, with or without reading everything."""
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


@pytest.mark.parametrize("gzip", [False, True])
def test_all_views_have_the_form_that_the_protocol_gives_them(wire: Connect, gzip: bool) -> None:
    agent = wire(gzip=gzip)
    views, delta_time = agent.views(ALL_VIEWS)
    assert delta_time >= 0
    shapes = {name: np.array(Image.open(io.BytesIO(views[name]))).shape for name in ("main", "object", "depth")}
    assert shapes == {"main": (32, 48, 3), "object": (32, 48, 3), "depth": (32, 48)}
    assert len(views["category"]) == 32 * 48 * 3
    assert len(views["optical"]) == 32 * 48 * 2 * 4
    assert agent.views(0)[0] == {}  # a delta time alone


@pytest.mark.parametrize("unused", [2, 64, 128, 2 + 64 + 128])
def test_unused_bits_add_no_view(agent: Wire, unused: int) -> None:
    agent.send("frame", flags=unused + 32)
    length = int.from_bytes(agent.read(4), "little")
    assert Image.open(io.BytesIO(agent.read(length))).mode == "L"
    assert struct.unpack("<f", agent.read(4))[0] >= 0
    assert agent.ask("get_position") == (0, 0, 0)


def test_lights_keep_their_settings(agent: Wire) -> None:
    assert agent.ask("get_lights_names") == ["Main Light", "Rim Light"]
    assert agent.ask("get_light_type", light="Main Light") == "Directional"
    assert agent.ask("get_light_type", light="Sun") == "light_not_found"
    vector = (1.0, -2.0, 0.5)
    settings = {"color": (10, 20, 30), "intensity": 0.25, "indirect_multiplier": 3.0}
    for name, value in (settings | {"position": vector, "direction": vector}).items():
        agent.ask(f"set_light_{name}", light="Rim Light", **{name.removeprefix("indirect_"): value})
        assert agent.ask(f"get_light_{name}", light="Rim Light") == value
    assert agent.ask("get_ambient_light_color") == (128, 128, 128)


def test_the_rim_light_lights_once_it_has_an_intensity(agent: Wire) -> None:
    agent.spawn(boxes())
    agent.look(NEAR)
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
        pytest.param(
            "move_object", {"instance": 7, "position": (0, 0, 0), "rotation": (0, 0, 0)}, id="no such instance to move"
        ),
        pytest.param("despawn_object", {"instance": 99}, id="no such instance"),
    ],
)
def test_a_wrong_value_is_refused_and_last_error_repeats_the_reason(
    agent: Wire, command: str, values: dict[str, Any]
) -> None:
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
def test_a_broken_object_is_stored_and_its_spawn_refused(agent: Wire, data: bytes, reason: str) -> None:
    path, again, other = (agent.ask("send_obj_zip", file=("a.zip", each)) for each in (data, data, b"other"))
    assert path == again != other
    assert agent.spawn_named(f"file:{path}") == ""
    assert reason in agent.ask("last_error")
    assert agent.picture().shape == (32, 48, 3)


def test_only_paths_that_this_agent_was_given_can_be_spawned(wire: Connect) -> None:
    other, agent = wire(), wire()
    path = other.ask("send_obj_zip", file=("box.zip", boxes().to_zip()))
    for name in ("file:/etc/passwd", "file:../x.zip", "box", "file:", f"file:{path}"):
        assert agent.spawn_named(name) == ""


def test_a_fresh_scene_is_empty_and_lit_as_at_the_start(agent: Wire) -> None:
    agent.spawn(boxes())
    agent.ask("set_light_intensity", light="Main Light", intensity=9.0)
    agent.ask("set_clear_color", color=(0, 0, 0))
    agent.ask("change_scene", scene="object_view/scene")
    assert agent.ask("get_light_intensity", light="Main Light") == 1.25
    assert (agent.picture() == 255).all()


@pytest.mark.parametrize("hello", [struct.pack("<ii?", 0, 10, False), struct.pack("<ii?", 10, 100_000, False)])
def test_a_handshake_for_images_of_impossible_size_is_closed(worker: tuple[str, int], hello: bytes) -> None:
    with socket.create_connection(worker, timeout=240) as connection:
        connection.sendall(hello)
        assert is_closed(connection)


class _BrokenRenderer:
    info = EngineInfo("broken", "1")

    def run(self, *_args: object, **_options: object) -> None:
        raise RuntimeError("out of memory")


@contextmanager
def running_server(listener: Any = None, **limits: Any) -> Iterator[Server]:
    """A server in this process whose renderer fails."""
    listener = listener or socket.create_server(("127.0.0.1", 0))
    server = Server(listener, _BrokenRenderer(), Options(), Limits(**limits))  # type: ignore[arg-type]
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server
    finally:
        server.stop()
        thread.join(timeout=240)


def test_an_agent_for_whom_there_is_no_thread_is_let_go_and_the_next_one_is_served(
    wire: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = threading.Thread.start

    def start_but_the_first(thread: threading.Thread) -> None:
        if thread.name == "agent-0":
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", start_but_the_first)
    with running_server(agents=1) as server:
        with socket.create_connection(server.address, timeout=240) as connection:
            assert is_closed(connection)
        assert wire(server.address).agent == 1


@pytest.fixture
def broken(wire: Connect) -> Iterator[Wire]:
    """An agent of a server whose renderer fails."""
    with running_server() as server:
        yield wire(server.address)


@pytest.mark.parametrize("flags", [1, 4, 32, ALL_VIEWS])
def test_a_frame_that_cannot_be_rendered_is_sent_flat_and_marked(broken: Wire, flags: int) -> None:
    views, delta_time = broken.views(flags)
    assert math.isnan(delta_time)
    assert list(views) == [name for name, bit in VIEW_FLAGS.items() if flags & bit]
    if "main" in views:
        assert np.array(Image.open(io.BytesIO(views["main"]))).shape == (32, 48, 3)
    assert "out of memory" in broken.ask("last_error")


@pytest.mark.parametrize("flags", [0, 1, ALL_VIEWS])
def test_each_view_is_sent_after_the_one_before_is_drained(
    broken: Wire, monkeypatch: pytest.MonkeyPatch, flags: int
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

    monkeypatch.setattr(Link, "send", note_send)
    monkeypatch.setattr(Link, "drain", note_drain)
    broken.views(flags)
    views = flags.bit_count()
    assert done[1::2] == ["drained"] * max(views - 1, 0)
    for number, piece in enumerate(done[::2], start=1):
        rest = 4 if number >= views else 0  # deltaTime goes with the last view
        assert len(piece) == (4 + int.from_bytes(piece[:4], "little") if views else 0) + rest


@pytest.mark.parametrize(
    ("command", "values", "answer"),
    [
        pytest.param("spawn_object", SPAWN, "", id="an empty text"),
        pytest.param("send_obj_zip", {"file": ("x.zip", b"")}, "", id="no path"),
        pytest.param("load_scenario", {"scenario": {"objects": [{}, {}, {}]}}, ("", "", ""), id="empty ids"),
        pytest.param("set_position", {"position": (0, 0, 1)}, None, id="a status"),
    ],
)
def test_an_internal_error_is_answered_in_full_like_a_refusal(
    broken: Wire, monkeypatch: pytest.MonkeyPatch, command: str, values: dict[str, Any], answer: Any
) -> None:
    monkeypatch.setattr(Session, command, Mock(side_effect=MemoryError("none left")))
    if command == "load_scenario":
        assert broken.load(values["scenario"]) == answer
    elif answer is None:
        with pytest.raises(RendererError, match="none left"):
            broken.ask(command, **values)
    else:
        assert broken.ask(command, **values) == answer
    assert "none left" in broken.ask("last_error")
    assert broken.ask("get_position") == (0, 0, 0)


@pytest.mark.parametrize("letter", ["x", "\0", "€", "\U0001f600"])
def test_the_reason_of_a_refusal_is_shortened(broken: Wire, letter: str) -> None:
    with pytest.raises(RendererError, match="no scene"):
        broken.ask("change_scene", scene=letter * MAX_TEXT)
    assert len(broken.ask("last_error")) <= MAX_REASON
    assert broken.ask("get_position") == (0, 0, 0)


def test_a_large_frame_waits_until_there_is_memory_for_it_and_a_small_one_does_not(wire: Connect) -> None:
    with running_server(frames_total=1000, free_frame_size=16 * 32 * 48) as server:
        memory: MemoryBudget = server._shared.frames
        memory.take(1, timeout=0)
        agent = wire(server.address)
        agent.views(VIEW_FLAGS["main"])
        agent.send("frame", flags=ALL_VIEWS)
        agent.socket.settimeout(0.3)
        with pytest.raises(TimeoutError):
            agent.socket.recv(1)
        memory.give_back(1)
        agent.socket.settimeout(240)
        decode_frame(agent.read, flags=ALL_VIEWS)
        agent.views(ALL_VIEWS)  # the reservation has ended


def test_an_agent_that_cannot_be_accepted_does_not_end_the_worker(
    wire: Connect, caplog: pytest.LogCaptureFixture
) -> None:
    listener = Mock(wraps=socket.create_server(("127.0.0.1", 0)))
    listener.accept.side_effect = [OSError(24, "Too many open files"), DEFAULT]  # the first time, and then as usual
    with running_server(listener) as server:
        assert wire(server.address).ask("get_position") == (0, 0, 0)
    assert "cannot be accepted: [Errno 24]" in caplog.text


@pytest.mark.parametrize(
    ("sent", "logged"),
    [
        pytest.param(b"\x0c" + struct.pack("<i", 5) + b"x", "closed at send_obj_zip: timed out", id="stays silent"),
        pytest.param(bytes([0xAA]) * 100, "closed at 0xaa, malformed request", id="unknown command"),
        pytest.param(b"\x02" + struct.pack("<i", -5), "closed at change_scene, malformed", id="negative length"),
        pytest.param(b"\x0c" + struct.pack("<i", 2**31 - 1), "closed at send_obj_zip, malformed", id="huge length"),
        pytest.param(b"\x1d" + struct.pack("<i", 2) + b"{}", "closed at load_scenario", id="no length of a reply"),
        pytest.param(np.random.default_rng(5).integers(0x20, 0xDF, 1000, np.uint8).tobytes(), "closed at", id="noise"),
        pytest.param(COMMANDS["delete"].encode_request(), "", id="DELETE"),
    ],
)
def test_a_malformed_request_closes_its_agent_and_no_other_and_is_logged(
    wire: Connect, caplog: pytest.LogCaptureFixture, sent: bytes, logged: str
) -> None:
    limits = {"request_timeout": 3.0} if "timed out" in logged else {}  # of the good one, too
    with running_server(**limits) as server:
        good, bad = wire(server.address), wire(server.address)
        bad.socket.sendall(sent)
        assert is_closed(bad.socket)
        assert good.ask("get_position") == (0, 0, 0)
    assert (f"agent {bad.agent}: {logged}" in caplog.text) == bool(logged)


@pytest.mark.parametrize(
    ("command", "values", "reason"),
    [
        pytest.param("change_scene", {"scene": "moon/scene"}, "moon/scene", id="with a status"),
        pytest.param("get_light_color", {"light": "Sun"}, "Sun", id="instead of a value"),
        pytest.param("get_light_type", {"light": "Sun"}, "Sun", id="by a word of its own"),
        pytest.param("spawn_object", SPAWN | {"name": "yeti"}, "yeti", id="by an empty text"),
        pytest.param("load_scenario", {"scenario": {"objects": [{}]}}, "None", id="by empty ids"),
    ],
)
def test_every_refusal_is_logged_with_the_agent_the_command_and_the_reason(
    broken: Wire, caplog: pytest.LogCaptureFixture, command: str, values: dict[str, Any], reason: str
) -> None:
    with suppress(RendererError):
        broken.ask(command, **values)
    assert reason in broken.ask("last_error")
    messages = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert any(text.startswith(f"agent {broken.agent}: refused {command}: ") and reason in text for text in messages)


def test_too_many_agents_are_refused_until_one_leaves(wire: Connect, caplog: pytest.LogCaptureFixture) -> None:
    with running_server(agents=2) as server:
        first, _ = wire(server.address), wire(server.address)
        with pytest.raises((EOFError, ConnectionError)):
            wire(server.address)
        assert "refused, 2 agents are connected" in caplog.text
        assert first.ask("get_position") == (0, 0, 0)
        first.send("delete")
        assert is_closed(first.socket)
        with server._left:
            assert server._left.wait_for(lambda: len(server._agents) == 1, timeout=240)
        assert wire(server.address).ask("get_position") == (0, 0, 0)


def test_an_agent_idle_for_long_loses_its_place_to_a_new_one(wire: Connect) -> None:
    with running_server(agents=1, idle_timeout=0.0) as server:
        idle = wire(server.address)
        link, _ = server._agents[idle.agent]
        while link.idle_since is None:
            time.sleep(0.001)
        assert wire(server.address).ask("get_position") == (0, 0, 0)
        assert is_closed(idle.socket)
