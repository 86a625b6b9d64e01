"""Limits of time, size and number; fair turns; the end of a worker by a signal, a crash or the loss of OpenGL."""

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.served import repeating, reserved_port, wait_until
from tests.wire import ORIGIN, Wire, boxes
from tests.worker_process import Worker, started
from trompe_renderer.engines.render_thread import FairQueue, RenderThread
from trompe_renderer.protocol.limits import MIB, Limits, MemoryBudget
from trompe_renderer.protocol.link import Link
from trompe_renderer.protocol.session import Session
from trompe_renderer.protocol.upload import ModelCache
from trompe_renderer.world.snapshot import Snapshot
from trompe_server.service.supervisor import LISTENING
from trompe_shared.addresses import host_and_port
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import ProtocolError, RendererError, RendererLostError
from trompe_shared.geometry import Camera, View
from trompe_shared.sailenv import MAX_VIEWS, REGISTER, decode_frame, take_status
from trompe_shared.sailenv_client import SailenvTarget

Connect = Callable[..., Wire]
Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    """Both ends of a connection: the agent's, the worker's."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        agents = socket.create_connection(listener.getsockname())
        workers, _ = listener.accept()
    with agents, workers:
        yield agents, workers


def link_of(pair: Pair, memory: MemoryBudget | None = None, **limits: Any) -> Link:
    return Link(pair[1], memory or MemoryBudget(1024 * MIB), Limits(**limits))


def test_a_request_that_arrives_byte_by_byte_is_cut_off_in_time(pair: Pair) -> None:
    link = link_of(pair, request_timeout=0.3)
    pair[0].sendall(b"!")
    link.wait()
    started = time.monotonic()
    with repeating(lambda: pair[0].sendall(b"."), pause=0.05), pytest.raises(TimeoutError):
        link.read(1000)
    assert time.monotonic() - started < 30  # all of it would take 50


def test_an_agent_that_takes_no_reply_is_given_up(pair: Pair) -> None:
    link = link_of(pair, request_timeout=0.2)
    assert pair[1].getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)  # no piece waits for an acknowledgement
    with pytest.raises(TimeoutError):
        link.send(bytes(64 * MIB))


def test_a_link_is_drained_when_nothing_is_left_to_send(pair: Pair) -> None:
    agents, workers = pair
    workers.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2**20)
    workers.setblocking(False)
    sent = 0
    with suppress(BlockingIOError):
        while True:
            sent += workers.send(bytes(2**16))
    with pytest.raises(TimeoutError):
        link_of(pair, request_timeout=0.2).drain()
    reader = threading.Thread(target=lambda: [agents.recv(2**16) for _ in range(sent // 2**12)])
    agents.settimeout(120)
    reader.start()
    link_of(pair).drain()
    workers.close()
    reader.join()


def test_an_agent_may_be_silent_for_longer_than_any_request_and_a_request_has_a_largest_size(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("trompe_renderer.protocol.link.time", SimpleNamespace(monotonic=lambda: now))
    link = link_of(pair, request_timeout=60, request_size=1000)

    def speak_later() -> None:
        nonlocal now
        now += 1000.0
        pair[0].sendall(bytes(2000))

    timer = threading.Timer(0.1, speak_later)
    timer.start()
    link.wait()
    link.read(600)
    link.wait()
    link.read(600)
    with pytest.raises(ProtocolError):
        link.read(600)
    timer.join()


def test_uploads_of_all_agents_together_have_a_largest_size(pair: Pair) -> None:
    memory = MemoryBudget(3 * MIB)
    link = link_of(pair, memory, request_timeout=0.2)
    memory.take(2 * MIB, timeout=0.0)
    pair[0].sendall(b"!")
    link.wait()
    with pytest.raises(TimeoutError, match="memory"):
        link.read(2 * MIB)
    memory.give_back(2 * MIB)
    writer = threading.Thread(target=pair[0].sendall, args=(bytes(2 * MIB),))
    writer.start()
    link = link_of(pair, memory)
    link.wait()
    assert len(link.read(2 * MIB)) == 2 * MIB
    link.close()
    memory.take(3 * MIB, timeout=0.0)
    writer.join()


def test_an_agent_without_a_handshake_loses_its_place(pair: Pair) -> None:
    link = link_of(pair, register_timeout=0.1)
    with pytest.raises(TimeoutError):
        REGISTER.decode_fields(link.read)


def unread(agent: Wire) -> int:
    """Bytes from an agent that its worker has not read yet."""
    ends = [f":{end[1]:04X}" for end in (agent.socket.getpeername(), agent.socket.getsockname())]
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()]
    (queues,) = (row[4] for row in rows if [row[1][-5:], row[2][-5:]] == ends)
    return int(queues.partition(":")[2], 16)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_a_stopped_worker_finishes_its_reply(
    own_worker: Worker, wire: Connect, number: signal.Signals, status: int
) -> None:
    agent, idle = wire(own_worker.address, size=(512, 512)), wire(own_worker.address)
    agent.spawn(boxes())
    agent.look(Camera(0.3, 0, 0))
    expected = agent.views(1)[0]
    agent.send("frame", flags=1)
    wait_until(lambda: not unread(agent), pause=0.0)
    for _ in range(3):  # Ctrl-C and a supervisor may both send it
        own_worker.process.send_signal(number)
    assert decode_frame(agent.read, flags=1)[0] == expected
    assert own_worker.process.wait(120) == status
    assert idle.socket.recv(1) == b""
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(own_worker.address)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_a_starting_worker_stops_at_once(number: signal.Signals, status: int) -> None:
    """The signal comes while OpenGL is loaded: the worker listens already and serves not yet.

    On a busy machine the signal may come too late, so there are some tries.
    """

    def said(port: int) -> str:
        """What the worker prints until it has ended."""
        command = [sys.executable, "-m", "trompe_renderer", "--port", str(port)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            while process.poll() is None:
                with suppress(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port)):
                    break
            process.send_signal(number)
            assert process.wait(120) == status
            assert process.stdout is not None
            return process.stdout.read()

    with reserved_port() as port:
        assert any(said(port) == "" for _ in range(5))


def test_a_worker_on_an_ipv6_address_prints_it_for_the_supervisor_and_for_clients() -> None:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("NOT TESTED: this machine has no IPv6")
    command = [sys.executable, "-m", "trompe_renderer", "--host", "::1", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        ready = re.match(r"trompe renderer listening on (\[::1\]:\d+), (.+)\n", line := process.stdout.readline())
        assert ready, line
        with closing(SailenvTarget(*host_and_port(ready[1]))) as target:
            assert str(target.engine) == ready[2]
            assert LISTENING.findall(line) == [str(target.address[1])]
        process.kill()


def test_a_batch_ends_with_a_reason_when_the_worker_stops(own_worker: Worker, wire: Connect) -> None:
    agent = wire(own_worker.address, size=(512, 512))
    agent.spawn(boxes())
    agent.send("render_views", views=[[]] * MAX_VIEWS)

    def take_views(count: int) -> None:
        for _ in range(count):
            take_status(agent.read, "a view")
            agent.read(512 * 512 * 3)

    take_views(1)
    own_worker.process.send_signal(signal.SIGTERM)
    with pytest.raises(RendererError, match="about to stop"):
        take_views(MAX_VIEWS)
    assert agent.socket.recv(1) == b""


def test_a_crash_ends_the_worker_with_its_signal_and_a_line_in_the_log(own_worker: Worker, tmp_path: Path) -> None:
    own_worker.process.send_signal(signal.SIGSEGV)
    assert own_worker.process.wait(120) == -signal.SIGSEGV
    assert "Fatal Python error: Segmentation fault" in (tmp_path / "worker.log").read_text()


def test_a_worker_whose_engine_always_fails_tells_the_reason_and_ends(tmp_path: Path) -> None:
    log = tmp_path / "worker.log"
    with log.open("w") as file, started("--engine", "tests.renderer_worker.noisy_engine:Failing", log=file) as worker:
        with closing(SailenvTarget(*worker.address)) as target, pytest.raises(RendererLostError, match="no shader"):
            target.render(boxes(), [View(Camera(1.0, 0.0, 0.0))], size=(8, 8))
        assert worker.process.wait(120) == os.EX_TEMPFAIL
    assert "The engine is lost" in log.read_text()


ENGINE = EngineInfo("test", "1")


class _Engine:
    """Fails on request, and takes as many seconds for a picture as its ambient light is red: of a clock of its own."""

    def __init__(self) -> None:
        self.info, self.broken, self.now = ENGINE, False, 0.0
        self.failure: type[BaseException] = RuntimeError
        self.sleep: Callable[[float], None] = time.sleep

    def render(self, world: Snapshot, *, width: int, height: int) -> Any:
        if world.instances:
            raise self.failure("out of memory")
        if self.broken:
            raise self.failure("context lost")
        self.now += world.ambient[0]
        return np.zeros((height, width, 3), np.uint8)


def draw(thread: RenderThread, *, fails: bool = False, seconds: float = 0.0, agent: object = Session) -> Any:
    """A picture in the future."""
    world = Snapshot((1,) if fails else (), np.eye(4), (), (seconds, 0.0, 0.0), (0.0, 0.0, 0.0))  # type: ignore[arg-type]
    return thread.run(lambda engine: engine.render(world, width=4, height=4), agent=agent)


@pytest.mark.parametrize("failure", [RuntimeError, SystemExit])
def test_an_engine_counts_as_lost_when_not_even_an_empty_picture_can_be_drawn(failure: type[BaseException]) -> None:
    engine, lost = _Engine(), list[str]()
    engine.failure = failure
    thread = RenderThread(lambda: engine, lost=lost.append)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="out of memory"):
            draw(thread, fails=True).result()
        assert draw(thread).result().shape == (4, 4, 3)
    assert lost == []
    engine.broken = True
    with pytest.raises(RendererLostError, match=r"out of memory.*context lost"):
        draw(thread, fails=True).result()
    thread.run(lambda _: None, agent=Session).result()  # begins after the end of the turn before
    assert "context lost" in lost[0]


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> _Engine:
    """An engine whose clock is that of its thread."""
    made = _Engine()
    clock = SimpleNamespace(monotonic=lambda: made.now, sleep=lambda seconds: made.sleep(seconds))
    monkeypatch.setattr("trompe_renderer.engines.render_thread.time", clock)
    return made


def test_an_engine_counts_as_lost_when_a_picture_takes_for_ever(engine: _Engine) -> None:
    """The watch looks once within each picture, when its time has passed."""
    lost, look, looked = list[str](), threading.Semaphore(0), threading.Semaphore(0)

    def sleep(_: float) -> None:
        looked.release()
        look.acquire()

    def note(reason: str) -> None:
        lost.append(reason)
        looked.release()

    def take(seconds: float, _: Any) -> None:
        engine.now += seconds
        look.release()
        assert looked.acquire(timeout=120)

    engine.sleep = sleep
    thread = RenderThread(lambda: engine, lost=note, turn_limit=2.0)
    assert looked.acquire(timeout=120)
    for seconds in (0.8, 0.8, 0.8, 0.8, 3.0):
        assert lost == []
        thread.run(partial(take, seconds), agent=Session).result()
    assert lost == ["a picture takes more than 2 s"]


def sessions(count: int, limits: Limits | None = None) -> list[Session]:
    cache = ModelCache(limits or Limits())
    return [Session(cache, ENGINE) for _ in range(count)]


def test_the_next_turn_goes_to_the_agent_with_the_least_time_used() -> None:
    queue, (large, small, late) = FairQueue(), sessions(3)

    def turns(count: int) -> list[Any]:
        served = []
        for _ in range(count):
            served.append(queue.next()[0])
            queue.charge(served[-1], 2.0 if served[-1] is large else 0.5)
        return served

    for agent in (large, large, small, small, small):
        queue.join(agent, int)
    assert turns(4) == [large, small, small, small]
    for agent in (small, small, late, late, late):  # time away earns no credit
        queue.join(agent, int)
    assert turns(6) == [late, small, late, large, small, late]


def test_large_pictures_do_not_delay_small_ones(engine: _Engine) -> None:
    thread, (large, small, other) = RenderThread(lambda: engine), sessions(3)
    order: list[str] = []
    all_asked = threading.Event()
    asked: list[Any] = [thread.run(lambda _: all_asked.wait(120), agent=other)]
    for agent, name, seconds in ((large, "large", 0.1),) * 2 + ((small, "small", 0.01),) * 2:
        asked.append(draw(thread, seconds=seconds, agent=agent))
        asked[-1].add_done_callback(lambda _, name=name: order.append(name))
    all_asked.set()
    for each in asked:
        each.result()
    assert order == ["large", "small", "small", "large"]


def test_large_requests_for_memory_are_not_overtaken_by_small_ones() -> None:
    memory, order = MemoryBudget(100), list[int]()

    def use(count: int) -> None:
        with memory.reserved(count):
            order.append(count)

    with ThreadPoolExecutor(3) as threads, memory.reserved(30):
        threads.submit(use, 1000)
        wait_until(memory._queue.locked)  # it is the first
        threads.submit(use, 20)
        threads.submit(use, 20)
        time.sleep(0.05)
        assert order == []
    assert order == [1000, 20, 20]
    memory.take(100, timeout=0)


def test_the_textures_of_all_spawned_objects_have_a_largest_size() -> None:
    (session,) = sessions(1, Limits(textures=3000))
    (path,) = session.send_obj_zip(file=("box.zip", boxes().to_zip()))
    for _ in range(5):  # all share their textures
        session.spawn_object(name=f"file:{path}", **ORIGIN)
    session.repaint_object(instance=1, textures=[("front_albedo.png", (20, 20, bytes(1200)))])
    with pytest.raises(RendererError, match="Despawn"):
        session.repaint_object(instance=2, textures=[("front_albedo.png", (25, 25, bytes(1875)))])
    session.despawn_object(instance=1)
    for _ in range(2):  # the new texture takes the place of the old one
        session.repaint_object(instance=2, textures=[("front_albedo.png", (25, 25, bytes(1875)))])
