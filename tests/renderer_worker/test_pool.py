"""A pool of real workers loses no view and shows no wrong one, even if a worker dies or hangs within a request."""

import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from functools import cache, partial
from importlib.metadata import version
from unittest.mock import Mock

import numpy as np
import pytest

from tests.served import reserved_port
from tests.wire import boxes, speckled
from tests.worker_process import SHARP, SHARP_SETTINGS, Worker, started
from trompe_server.renderers import RendererPool, SailenvTarget, TargetRenderer
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError, RendererLostError
from trompe_shared.geometry import Camera, Light, View

SIZE = (40, 56)
VIEWS = [View(Camera(0.3, 9 * k, k), Light(5 * k, 40, 0.5, 0.3)) for k in range(24)]
OURS = EngineInfo("pyrender", version("pyrender"))
Address = tuple[str, int]
Expected = Callable[[int], np.ndarray]
Nobody = Callable[[], Address]
Pool = partial(RendererPool, patience=120.0)
"""For workers that answer, or refuse at once: a busy machine may hold them up for longer than a user would wait."""


@pytest.fixture
def nobody() -> Iterator[Nobody]:
    """Makes addresses where nothing listens."""
    with ExitStack() as stack:
        yield lambda: ("127.0.0.1", stack.enter_context(reserved_port()))


@pytest.fixture(scope="module")
def expected(worker: Address) -> Expected:
    """Images by one undisturbed worker of the box speckled with a seed."""

    @cache
    def images(seed: int) -> np.ndarray:
        with closing(SailenvTarget(*worker)) as target:
            return target.render(speckled(seed), VIEWS, size=SIZE)

    return images


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("when", [1, pytest.param(15, marks=pytest.mark.thorough)])
def test_a_worker_lost_in_the_middle_costs_no_view_and_no_picture_is_wrong(
    own_worker: Worker, worker: Address, expected: Expected, number: signal.Signals, when: int
) -> None:
    shown = 0

    def on_frame() -> None:
        nonlocal shown
        shown += 1
        if shown == when:
            own_worker.process.send_signal(number)

    with closing(RendererPool([own_worker.address, worker], suspicion=0.3, patience=10.0)) as pool:
        pool.render(speckled(1), VIEWS, size=SIZE)
        images = pool.render(speckled(2), VIEWS, size=SIZE, on_frame=on_frame)
        again = pool.render(speckled(3), VIEWS, size=SIZE)
    assert shown == len(VIEWS)
    assert (images == expected(2)).all()
    assert (again == expected(3)).all()


def test_many_requests_at_a_time_each_get_their_own_texture_while_a_worker_dies(
    own_worker: Worker, worker: Address, expected: Expected
) -> None:
    wanted = {seed: expected(seed) for seed in range(4)}
    begun = threading.Event()

    def ask(seed: int) -> None:
        for _ in range(3):
            images = pool.render(speckled(seed), VIEWS, size=SIZE, on_frame=begun.set)
            assert (images == wanted[seed]).all()

    with closing(Pool([own_worker.address, worker])) as pool, ThreadPoolExecutor(len(wanted)) as threads:
        asked = [threads.submit(ask, seed) for seed in wanted]
        assert begun.wait(240)
        own_worker.process.kill()
        for each in asked:
            each.result()


def test_dead_addresses_are_passed_over_and_a_pool_of_these_alone_says_how_to_start_a_worker(
    worker: Address, expected: Expected, nobody: Nobody
) -> None:
    with closing(Pool([nobody(), worker, nobody()])) as pool:
        for seed in (1, 2):
            assert (pool.render(speckled(seed), VIEWS, size=SIZE) == expected(seed)).all()
    pool = RendererPool([nobody(), nobody()])
    with closing(pool), pytest.raises(RendererLostError, match="trompe render --host"):
        pool.render(boxes(), VIEWS, size=SIZE)
    with pytest.raises(RendererError, match="at least one"):
        RendererPool([])


def test_a_refusal_is_final_and_takes_no_worker_out_of_the_pool(
    worker: Address, second_worker: Address, expected: Expected
) -> None:
    too_far = [View(Camera(1e9, 0, 0))] * 10
    with closing(Pool([worker, second_worker])) as pool:
        with pytest.raises(RendererError, match="position") as refusal:
            pool.render(speckled(1), [*VIEWS, *too_far], size=SIZE)
        assert not isinstance(refusal.value, RendererLostError)
        assert (pool.render(speckled(1), VIEWS, size=SIZE) == expected(1)).all()


def test_a_worker_that_comes_back_is_used_again(own_worker: Worker, expected: Expected, nobody: Nobody) -> None:
    with closing(RendererPool([own_worker.address, nobody()], suspicion=0.3, patience=10.0, rest=0.1)) as pool:
        own_worker.process.send_signal(signal.SIGSTOP)
        with pytest.raises(RendererLostError):
            pool.render(speckled(1), VIEWS, size=SIZE)
        own_worker.process.send_signal(signal.SIGCONT)
        assert (pool.render(speckled(1), VIEWS, size=SIZE) == expected(1)).all()


def test_an_interrupted_request_ends_at_once_and_the_pool_goes_on(
    worker: Address, second_worker: Address, expected: Expected
) -> None:
    with closing(Pool([worker, second_worker])) as pool:
        with pytest.raises(KeyboardInterrupt):
            pool.render(speckled(1), VIEWS, size=SIZE, on_frame=Mock(side_effect=KeyboardInterrupt))
        assert not any(thread.name.startswith("render at") for thread in threading.enumerate())
        assert (pool.render(speckled(2), VIEWS, size=SIZE) == expected(2)).all()


# Engines


def test_a_worker_with_another_engine_is_left_out(
    worker: Address, expected: Expected, nobody: Nobody, caplog: pytest.LogCaptureFixture
) -> None:
    with started(*SHARP) as running:
        other = running.address
        for addresses in ([worker, other], [other, worker]):
            with closing(Pool(addresses, engine=OURS)) as pool:
                assert (pool.render(speckled(1), VIEWS, size=SIZE) == expected(1)).all()
        assert f"{other[1]}: its engine is {OURS} ({SHARP_SETTINGS}), but {OURS} was asked for" in caplog.text
        with closing(Pool([nobody(), other, worker])) as pool:
            assert pool.engine.settings == SHARP_SETTINGS
            assert (pool.render(speckled(1), VIEWS, size=SIZE) != expected(1)).any()
        pool = RendererPool([other, nobody()], engine=OURS)
        told = rf"No renderer with pyrender.*engine is .*{SHARP_SETTINGS}"
        with closing(pool), pytest.raises(RendererLostError, match=told):
            pool.render(speckled(1), VIEWS, size=SIZE)


def test_a_worker_with_another_engine_after_its_restart_is_left_out(worker: Address, expected: Expected) -> None:
    """Its first pictures are right; the restarted one would give others."""

    def shown(target: TargetRenderer) -> np.ndarray:
        return target.render(speckled(1), VIEWS[:4], size=SIZE)

    with reserved_port() as port, ExitStack() as stack:
        with started("--port", str(port)) as mine:
            targets: list[TargetRenderer] = [Pool([mine.address], rest=0.1), SailenvTarget(*mine.address)]
            for target in targets:
                stack.enter_context(closing(target))
                assert (shown(target) == expected(1)[:4]).all()
        with started("--port", str(port), *SHARP):
            for target in 2 * targets:
                with pytest.raises(RendererLostError, match=rf"{SHARP_SETTINGS}\), but pyrender \S+ was asked for"):
                    shown(target)
        with started("--port", str(port)):
            for target in targets:
                assert (shown(target) == expected(1)[:4]).all()


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
