"""Limits of time, size and number on the worker's side; its end in good order; its return after OpenGL is lost."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from trompe_renderer import link as link_module
from trompe_renderer.link import Link, Memory
from trompe_renderer.model import Library
from trompe_renderer.options import Quality
from trompe_renderer.render_thread import Renderer, _Line
from trompe_renderer.scenery import Scenery
from trompe_renderer.session import Session
from trompe_renderer.supervise import LOST
from trompe_shared.errors import ProtocolError, RendererError
from trompe_shared.object3d import Object3D
from trompe_shared.sailenv import COMMANDS, MAX_VIEWS, REGISTER, decode_frame, take_status

Start = Callable[[], Any]
Boxes = Callable[..., Object3D]


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Both ends of a connection."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ours = socket.create_connection(listener.getsockname())
        theirs, _ = listener.accept()
    yield ours, theirs
    ours.close()
    theirs.close()


@pytest.fixture
def connect(wire_to: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    """Connects a bare client to the worker at an address."""
    opened: list[Any] = []

    def connect(*where: Any, **options: Any) -> Any:
        opened.append(wire_to(*where, **options))
        return opened[-1]

    yield connect
    for agent in opened:
        agent.socket.close()


def test_a_request_that_comes_drop_by_drop_is_cut_off_in_time(pair: Any) -> None:
    ours, theirs = pair
    link = Link(theirs, Memory(), timeout=0.5)
    ours.sendall(b"!")
    link.wait()
    stop = threading.Event()

    def drip() -> None:
        while not stop.wait(0.05):
            ours.sendall(b".")

    thread = threading.Thread(target=drip)
    thread.start()
    started = time.monotonic()
    with pytest.raises(TimeoutError):
        link.read(1000)
    assert time.monotonic() - started < 2
    stop.set()
    thread.join()


def test_an_agent_that_takes_no_reply_is_given_up(pair: Any) -> None:
    _, theirs = pair
    link = Link(theirs, Memory(), timeout=0.3)
    with pytest.raises(TimeoutError):
        link.send(bytes(64 * 2**20))


def test_no_piece_of_a_reply_waits_until_the_one_before_is_acknowledged(pair: Any) -> None:
    Link(pair[1], Memory())
    assert pair[1].getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_a_link_is_drained_when_nothing_is_left_to_send(pair: Any) -> None:
    ours, theirs = pair
    theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2**20)
    theirs.setblocking(False)
    sent = 0
    with suppress(BlockingIOError):
        while True:
            sent += theirs.send(bytes(2**16))
    with pytest.raises(TimeoutError):
        Link(theirs, Memory(), timeout=0.2).drain()
    reader = threading.Thread(target=lambda: [ours.recv(2**16) for _ in range(sent // 2**12)])
    ours.settimeout(1)
    reader.start()
    Link(theirs, Memory(), timeout=30).drain()
    theirs.close()
    reader.join()


def test_an_idle_agent_may_be_silent_for_longer_than_any_request(pair: Any) -> None:
    ours, theirs = pair
    link = Link(theirs, Memory(), timeout=0.1)
    timer = threading.Timer(0.5, ours.sendall, [b"x"])
    timer.start()
    link.wait()
    assert link.read(1) == b"x"
    timer.join()


def test_a_request_has_a_largest_size_however_many_fields_it_has(pair: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = pair
    monkeypatch.setattr(link_module, "MAX_REQUEST", 1000)
    link = Link(theirs, Memory())
    ours.sendall(bytes(2000))
    link.wait()
    link.read(600)
    link.wait()
    link.read(600)
    with pytest.raises(ProtocolError):
        link.read(600)


def test_uploads_of_all_agents_together_have_a_largest_size(pair: Any) -> None:
    ours, theirs = pair
    memory = Memory(3 * 2**20)
    link = Link(theirs, memory, timeout=0.3)
    memory.take(2 * 2**20, timeout=0.0)
    ours.sendall(b"!")
    link.wait()
    with pytest.raises(TimeoutError, match="memory"):
        link.read(2 * 2**20)
    memory.give_back(2 * 2**20)
    writer = threading.Thread(target=ours.sendall, args=(bytes(2 * 2**20),))
    writer.start()
    link = Link(theirs, memory, timeout=10)
    link.wait()
    assert len(link.read(2 * 2**20)) == 2 * 2**20
    link.close()
    memory.take(3 * 2**20, timeout=0.0)
    writer.join()


def test_an_agent_that_never_shakes_hands_loses_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_module, "REGISTER_TIMEOUT", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as listener, socket.create_connection(listener.getsockname()):
        link = Link(listener.accept()[0], Memory())
        with pytest.raises(TimeoutError):
            REGISTER.decode_fields(link.read)
        link.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_worker_that_is_told_to_stop_finishes_the_reply_it_is_at(
    own_worker: Start, connect: Callable[..., Any], make_boxes: Boxes, number: signal.Signals
) -> None:
    worker = own_worker()
    agent, idle = connect(worker.address, size=(512, 512)), connect(worker.address)
    agent.spawn(make_boxes())
    agent.ask("set_position", position=(0, 0, 0.3))
    agent.ask("set_rotation", rotation=(180, 0, 180))
    expected = agent.views(1)[0]
    agent.socket.sendall(COMMANDS["frame"].encode_request(flags=1))
    time.sleep(0.05)
    for _ in range(3):  # told more than once, as by Ctrl-C and a supervisor
        os.kill(worker.process.pid, number)
    assert decode_frame(agent.read, flags=1, compressed=False)[0] == expected
    assert worker.process.wait(20) == (130 if number == signal.SIGINT else 0)
    assert idle.socket.recv(1) == b""
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(worker.address)


def test_a_batch_ends_with_a_reason_when_the_worker_stops(
    own_worker: Start, connect: Callable[..., Any], make_boxes: Boxes
) -> None:
    worker = own_worker()
    agent = connect(worker.address, size=(512, 512))
    agent.spawn(make_boxes())
    agent.socket.sendall(COMMANDS["render_views"].encode_request(views=[[]] * MAX_VIEWS))
    take_status(agent.read, "a view")
    agent.read(512 * 512 * 3)
    worker.process.send_signal(signal.SIGTERM)

    def take_all() -> None:
        for _ in range(MAX_VIEWS):
            take_status(agent.read, "a view")
            agent.read(512 * 512 * 3)

    with pytest.raises(RendererError, match="about to stop"):
        take_all()
    assert agent.socket.recv(1) == b""


def test_a_worker_ends_when_its_supervisor_is_killed(own_worker: Start) -> None:
    worker = own_worker()
    serving = worker.serving
    worker.process.kill()
    deadline = time.monotonic() + 10
    while os.path.exists(f"/proc/{serving}") and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not os.path.exists(f"/proc/{serving}")


def test_after_a_crash_the_same_address_serves_again(own_worker: Start, connect: Callable[..., Any]) -> None:
    worker = own_worker()
    for number in (signal.SIGSEGV, signal.SIGKILL):
        serving = worker.serving
        os.kill(serving, number)
        agent = connect(worker.address)  # waits in line until the next one is there
        assert agent.picture().shape == (32, 48, 3)
        assert worker.serving != serving


@pytest.mark.parametrize(
    ("ends", "status", "runs"),
    [
        pytest.param("sys.exit(0)", 0, 1, id="done"),
        pytest.param("sys.exit(1)", 1, 1, id="cannot start"),
        pytest.param("crash() if first() else sys.exit(0)", 0, 2, id="crashed once"),
        pytest.param(f"sys.exit({LOST}) if first() else sys.exit(3)", 3, 2, id="lost OpenGL once"),
        pytest.param("1 / 0", 1, 1, id="error"),
    ],
)
def test_a_crash_starts_the_work_anew_and_an_end_ends_it(tmp_path: Any, ends: str, status: int, runs: int) -> None:
    script = f"""
import os, pathlib, signal, sys
from trompe_renderer.session import Session
from trompe_renderer.supervise import supervise

log = pathlib.Path({str(tmp_path)!r}) / "log"
first = lambda: log.read_text() == "."
crash = lambda: os.kill(os.getpid(), signal.SIGSEGV)

def work():
    with log.open("a") as out:
        out.write(".")
    try:
        {ends}
    except SystemExit as end:
        return end.code

sys.exit(supervise(work))
"""
    done = subprocess.run([sys.executable, "-c", script], timeout=30, check=False, capture_output=True)
    assert done.returncode == status
    assert (tmp_path / "log").read_text() == "." * runs


SMALL: dict[str, Any] = {"width": 4, "height": 4, "whose": Session}
"""A picture for anybody."""


class _Engine:
    """Fails as it is told to."""

    def __init__(self, broken: list[bool]) -> None:
        self._broken = broken

    def render(self, scenery: Scenery, *, width: int, height: int) -> Any:
        if scenery.placements:
            raise RuntimeError("out of memory")
        time.sleep(scenery.ambient[0])
        return np.zeros((height, width, 3), np.uint8)

    def check(self) -> None:
        if self._broken:
            raise RuntimeError("context lost")


def scene(*, placements: tuple[Any, ...] = (), seconds: float = 0.0) -> Scenery:
    return Scenery(placements, np.eye(4), (), (seconds, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_opengl_counts_as_lost_when_not_even_an_empty_picture_can_be_drawn() -> None:
    broken: list[bool] = []
    lost: list[str] = []
    renderer = Renderer(Quality(), engine=lambda _: _Engine(broken), lost=lost.append)  # type: ignore[arg-type, return-value]
    for _ in range(2):
        with pytest.raises(RuntimeError, match="out of memory"):
            renderer.render(scene(placements=(1,)), **SMALL)
        assert renderer.render(scene(), **SMALL).shape == (4, 4, 3)
    assert lost == []
    broken.append(True)
    with pytest.raises(RuntimeError, match="out of memory"):
        renderer.render(scene(placements=(1,)), **SMALL)
    assert "context lost" in lost[0]


def test_opengl_counts_as_lost_when_a_picture_takes_for_ever() -> None:
    lost = threading.Event()
    renderer = Renderer(
        Quality(),
        engine=lambda _: _Engine([]),  # type: ignore[arg-type, return-value]
        lost=lambda reason: lost.set(),
        turn_limit=0.2,
    )
    for _ in range(5):
        renderer.render(scene(seconds=0.1), **SMALL)
    assert not lost.is_set()
    renderer.render(scene(seconds=1.0), **SMALL)
    assert lost.is_set()


def test_the_next_turn_is_of_whom_the_turns_took_least_and_of_those_of_whoever_came_first() -> None:
    line, (large, small, late) = _Line(), (Session(Library()) for _ in range(3))

    def turns(count: int, seconds: dict[Any, float]) -> list[Any]:
        served = []
        for _ in range(count):
            served.append(line.next()[0])
            line.charge(served[-1], seconds[served[-1]])
        return served

    seconds = {large: 2.0, small: 0.5, late: 0.5}
    for whose in (large, large, small, small, small):
        line.join(whose, int)
    assert turns(4, seconds) == [large, small, small, small]
    for whose in (small, small, late, late, late):  # who comes late has no claim for the time before
        line.join(whose, int)
    assert turns(6, seconds) == [late, small, late, large, small, late]


def test_who_asks_for_large_pictures_does_not_make_those_wait_who_ask_for_small_ones() -> None:
    renderer = Renderer(Quality(), engine=lambda _: _Engine([]))  # type: ignore[arg-type, return-value]
    agents = {name: Session(Library()) for name in ("large", "small")}
    order: list[str] = []

    def ask(name: str, seconds: float) -> Any:
        drawn = renderer.start(scene(seconds=seconds), width=4, height=4, whose=agents[name])
        drawn.add_done_callback(lambda _: order.append(name))
        return drawn

    asked = [ask(name, seconds) for name, seconds in (("large", 0.3), ("large", 0.3), ("small", 0.01), ("small", 0.01))]
    for drawn in asked:
        drawn.result()
    assert order == ["large", "small", "small", "large"]


def test_who_wants_much_memory_is_not_passed_over_for_those_who_want_little() -> None:
    memory, order = Memory(100), []

    def use(count: int) -> None:
        with memory.lent(count):
            order.append(count)
            time.sleep(0.05)

    with memory.lent(30):
        threads = [threading.Thread(target=use, args=(count,)) for count in (1000, 20, 20)]
        for thread in threads:
            thread.start()
            time.sleep(0.1)
        assert order == []
    for thread in threads:
        thread.join()
    assert order == [1000, 20, 20]
    memory.take(100, timeout=0)


def test_the_textures_of_all_that_is_spawned_have_a_largest_size(
    make_boxes: Boxes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trompe_renderer.world.MAX_SHOWN_BYTES", 3000)
    session = Session(Library())
    place = {"position": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0), "scale": (1.0, 1.0, 1.0)}
    (path,) = session.send_obj_zip(file=("box.zip", make_boxes().to_zip()))
    for _ in range(5):  # all have the same textures
        session.spawn_object(name=f"file:{path}", **place)
    session.repaint_object(instance=1, textures=[("front_albedo.png", (20, 20, bytes(1200)))])
    with pytest.raises(RendererError, match="despawn"):
        session.repaint_object(instance=2, textures=[("front_albedo.png", (25, 25, bytes(1875)))])
    session.despawn_object(instance=1)
    session.repaint_object(instance=2, textures=[("front_albedo.png", (25, 25, bytes(1875)))])
