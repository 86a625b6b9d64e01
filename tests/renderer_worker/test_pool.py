"""A pool of real workers loses no view and shows no wrong one, whatever happens to a worker in the middle of it all."""

import signal
import socket
import threading
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from trompe_server.target import RendererPool, SailenvTarget
from trompe_shared.errors import RendererError, RendererLostError
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D

SIZE = (40, 56)
VIEWS = [View(Camera(0.3, 9 * k, k), Light(5 * k, 40, 0.5, 0.3)) for k in range(24)]
Boxes = Callable[..., Object3D]
Start = Callable[[], Any]


def painted(box: Object3D, seed: int) -> Object3D:
    random = np.random.default_rng(seed)
    return box.with_textures({name: random.integers(0, 256, (16, 16, 3), dtype=np.uint8) for name in box.textures})


def nobody() -> tuple[str, int]:
    """An address where nothing listens."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        host, port = listener.getsockname()
    return host, port


@pytest.fixture(scope="module")
def expected(worker: tuple[str, int], make_boxes: Boxes) -> Callable[[int], np.ndarray]:
    """What one undisturbed worker shows of the box painted with a seed."""
    shown: dict[int, np.ndarray] = {}

    def images(seed: int) -> np.ndarray:
        if seed not in shown:
            with closing(SailenvTarget(*worker)) as target:
                shown[seed] = target.render(painted(make_boxes(), seed), VIEWS, size=SIZE)
        return shown[seed]

    return images


@pytest.mark.parametrize("how", ["killed with its supervisor", "stopped", "crashed"])
@pytest.mark.parametrize("when", [1, 15])
def test_a_worker_lost_in_the_middle_costs_no_view_and_no_picture_is_wrong(
    own_worker: Start,
    worker: tuple[str, int],
    make_boxes: Boxes,
    expected: Callable[[int], np.ndarray],
    how: str,
    when: int,
) -> None:
    victim = own_worker()
    ends: dict[str, Callable[[], None]] = {
        "killed with its supervisor": victim.end,
        "stopped": lambda: victim.send(signal.SIGSTOP),
        "crashed": lambda: victim.send(signal.SIGSEGV),
    }
    shown = 0

    def on_frame() -> None:
        nonlocal shown
        shown += 1
        if shown == when:
            ends[how]()

    with closing(RendererPool([victim.address, worker], suspicion=0.3, patience=1.0)) as pool:
        pool.render(painted(make_boxes(), 1), VIEWS, size=SIZE)
        images = pool.render(painted(make_boxes(), 2), VIEWS, size=SIZE, on_frame=on_frame)
        again = pool.render(painted(make_boxes(), 3), VIEWS, size=SIZE)
    assert shown == len(VIEWS)
    assert (images == expected(2)).all()
    assert (again == expected(3)).all()


def test_many_requests_at_a_time_each_get_their_own_texture_while_a_worker_dies(
    own_worker: Start, worker: tuple[str, int], make_boxes: Boxes, expected: Callable[[int], np.ndarray]
) -> None:
    victim, box = own_worker(), make_boxes()
    wanted = {seed: expected(seed) for seed in range(4)}
    found: dict[int, list[bool]] = {seed: [] for seed in wanted}

    def ask(seed: int) -> None:
        for _ in range(3):
            found[seed].append(bool((pool.render(painted(box, seed), VIEWS, size=SIZE) == wanted[seed]).all()))

    with closing(RendererPool([victim.address, worker])) as pool:
        threads = [threading.Thread(target=ask, args=(seed,)) for seed in wanted]
        for thread in threads:
            thread.start()
        time.sleep(0.5)
        victim.end()
        for thread in threads:
            thread.join()
    assert found == {seed: [True] * 3 for seed in wanted}


def test_a_worker_that_crashes_is_there_again_and_goes_on_with_the_next_view(
    own_worker: Start, make_boxes: Boxes, expected: Callable[[int], np.ndarray]
) -> None:
    worker = own_worker()
    shown = 0

    def on_frame() -> None:
        nonlocal shown
        shown += 1
        if shown in {3, 20}:
            worker.send(signal.SIGSEGV)

    first = worker.serving
    with closing(SailenvTarget(*worker.address)) as target:
        images = target.render(painted(make_boxes(), 2), VIEWS, size=SIZE, on_frame=on_frame)
    assert shown == len(VIEWS)
    assert (images == expected(2)).all()
    assert worker.serving != first
    assert worker.process.poll() is None


def test_a_dead_address_in_the_pool_is_passed_over(
    worker: tuple[str, int], make_boxes: Boxes, expected: Callable[[int], np.ndarray]
) -> None:
    with closing(RendererPool([nobody(), worker, nobody()])) as pool:
        for seed in (1, 2):
            assert (pool.render(painted(make_boxes(), seed), VIEWS, size=SIZE) == expected(seed)).all()


def test_a_pool_without_a_living_worker_says_how_to_start_one(make_boxes: Boxes) -> None:
    with (
        closing(RendererPool([nobody(), nobody()])) as pool,
        pytest.raises(RendererLostError, match="trompe render --host"),
    ):
        pool.render(make_boxes(), VIEWS, size=SIZE)
    with pytest.raises(RendererError, match="at least one"):
        RendererPool([])


def test_a_refusal_is_not_asked_again_elsewhere_and_takes_no_worker_out_of_the_pool(
    worker: tuple[str, int], second_worker: tuple[str, int], make_boxes: Boxes, expected: Callable[[int], np.ndarray]
) -> None:
    too_far = [View(Camera(1e9, 0, 0))] * 10
    with closing(RendererPool([worker, second_worker])) as pool:
        with pytest.raises(RendererError, match="position") as refusal:
            pool.render(painted(make_boxes(), 1), [*VIEWS, *too_far], size=SIZE)
        assert not isinstance(refusal.value, RendererLostError)
        assert (pool.render(painted(make_boxes(), 1), VIEWS, size=SIZE) == expected(1)).all()


def test_a_worker_that_comes_back_is_used_again(
    own_worker: Start,
    make_boxes: Boxes,
    expected: Callable[[int], np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("trompe_server.target.pool.REST", 0.1)
    worker = own_worker()
    with closing(RendererPool([worker.address, nobody()], suspicion=0.3, patience=1.0)) as pool:
        worker.send(signal.SIGSTOP)
        with pytest.raises(RendererLostError):
            pool.render(painted(make_boxes(), 1), VIEWS, size=SIZE)
        worker.send(signal.SIGCONT)
        assert (pool.render(painted(make_boxes(), 1), VIEWS, size=SIZE) == expected(1)).all()


def test_an_interrupted_request_ends_at_once_and_the_pool_goes_on(
    worker: tuple[str, int], second_worker: tuple[str, int], make_boxes: Boxes, expected: Callable[[int], np.ndarray]
) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    before = threading.active_count()
    with closing(RendererPool([worker, second_worker])) as pool:
        with pytest.raises(KeyboardInterrupt):
            pool.render(painted(make_boxes(), 1), VIEWS, size=SIZE, on_frame=interrupt)
        assert threading.active_count() == before
        assert (pool.render(painted(make_boxes(), 2), VIEWS, size=SIZE) == expected(2)).all()


def test_the_least_busy_worker_is_asked_first() -> None:
    pool = RendererPool([("a", 1), ("b", 2), ("b", 2)])
    assert len(pool) == 2
    first = pool.best([], desperate=False)
    assert first is not None
    pool.count(first, 3)
    second = pool.best([], desperate=False)
    assert second is not None
    assert second is not first
    pool.count(second, 4)
    assert pool.best([], desperate=False) is first
    assert pool.best([first], desperate=False) is second
    assert pool.best([first, second], desperate=True) is None
