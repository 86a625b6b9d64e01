"""Long runs: many agents at once, many frames, many uploads.

``--log-cli-level=INFO`` shows the figures, ``--junit-xml=FILE`` stores them as properties of the test.
The slow runs last TROMPE_SOAK_SECONDS (600) with 8 agents, and 10,000 frames and 1,000 uploads.
"""

import logging
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np
import pytest

from tests.wire import Wire, boxes, speckled
from tests.worker_process import Worker
from trompe_server.renderers import SailenvTarget
from trompe_shared.geometry import Camera, Light, View

AGENTS = 8
SIZE = (64, 64)
VIEWS = [View(Camera(0.3, 30 * k, 5 * k), Light(20 * k, 40, 0.5, 0.3)) for k in range(12)]
SLOW = [pytest.mark.slow, pytest.mark.timeout(7200)]

log = logging.getLogger(__name__)


@pytest.mark.parametrize(
    "seconds",
    [
        pytest.param(3.0, id="for a moment"),
        pytest.param(float(os.environ.get("TROMPE_SOAK_SECONDS", "600")), id="for long", marks=SLOW),
    ],
)
def test_agents_at_work_at_once_get_their_own_pictures_and_none_waits_for_long(
    seconds: float, own_worker: Worker, record_property: Callable[[str, object], None]
) -> None:
    worker, turns = own_worker, 3
    objects = [[speckled(agent, turn) for turn in range(turns)] for agent in range(AGENTS)]
    with closing(SailenvTarget(*worker.address)) as target:
        expected = [[target.render(obj, VIEWS, size=SIZE) for obj in mine] for mine in objects]
    waits: list[list[float]] = [[] for _ in range(AGENTS)]
    wrong: list[tuple[int, int]] = []
    until = time.monotonic() + seconds

    def go_on() -> bool:
        """Until the time is over, or a slow machine has had enough requests to compare."""
        return time.monotonic() < until or sum(map(len, waits)) < 50 * AGENTS

    def work(agent: int) -> None:
        random = np.random.default_rng(agent)
        with closing(SailenvTarget(*worker.address)) as target:
            while go_on():
                turn, first = (int(number) for number in random.integers((turns, len(VIEWS))))
                views = slice(first, first + int(random.integers(1, 4)))
                started = time.monotonic()
                images = target.render(objects[agent][turn], VIEWS[views], size=SIZE)
                waits[agent].append((time.monotonic() - started) / len(images))
                if not (images == expected[agent][turn][views]).all():
                    wrong.append((agent, turn))

    with ThreadPoolExecutor(AGENTS) as threads:
        list(threads.map(work, range(AGENTS)))
    middle, late = (float(np.percentile(np.concatenate(waits), share)) for share in (50, 99))
    counts = [len(mine) for mine in waits]
    for name, value in (("requests", sum(counts)), ("median_ms", 1000 * middle), ("p99_ms", 1000 * late)):
        record_property(name, round(value, 1))
    log.info(
        "%d agents, %.0f s: %d requests, %d to %d an agent; a picture takes %.1f ms (median), %.1f ms (p99)",
        *(AGENTS, seconds, sum(counts), min(counts), max(counts), 1000 * middle, 1000 * late),
    )
    assert wrong == []
    assert min(counts) > 0.5 * max(counts), "turns are not fair"
    assert late < 30.0


@pytest.mark.parametrize(
    ("frames", "uploads"),
    [pytest.param(300, 40, id="some"), pytest.param(10_000, 1_000, id="many", marks=SLOW)],
)
def test_memory_stays_flat(frames: int, uploads: int, own_worker: Worker, wire: Callable[..., Wire]) -> None:
    agent = wire(own_worker.address)
    random = np.random.default_rng(0)

    def upload(count: int) -> None:
        for _ in range(count):
            front = random.integers(0, 256, (64, 64, 3), dtype=np.uint8)
            half = (random.uniform(0.05, 0.1), 0.06, 0.04)  # another mesh each time
            agent.ask("despawn_object", instance=int(agent.spawn(boxes(((0, 0, 0), half), textures={"front": front}))))

    def draw(count: int) -> None:
        agent.spawn(boxes())
        for number in range(count):
            agent.ask("set_position", position=(0, 0, 0.3 + number % 7 / 50))
            agent.views(1)

    def work(frames: int, uploads: int) -> None:
        for _ in range(10):
            upload(uploads // 10)
            draw(frames // 10)
            agent.ask("change_scene", scene="object_view/scene")

    work(frames // 2 if frames < 1000 else 2000, uploads // 2 if uploads < 100 else 200)
    before = own_worker.memory
    work(frames, uploads)
    after = own_worker.memory
    log.info("%d frames, %d uploads: memory %.1f to %.1f MiB", frames, uploads, before / 2**20, after / 2**20)
    assert after < before + 24 * 2**20
