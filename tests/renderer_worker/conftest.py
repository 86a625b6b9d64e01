"""Worker processes of several kinds, and bare clients that are closed after each test."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from tests.wire import Wire
from tests.worker_process import Worker, shared_worker, started

Address = tuple[str, int]


@pytest.fixture
def wire(worker: Address) -> Iterator[Callable[..., Wire]]:
    """Connects clients, by default to the worker that all tests share."""
    with ExitStack() as opened:
        yield lambda address=worker, **options: opened.enter_context(closing(Wire(address, **options)))


@pytest.fixture
def agent(wire: Callable[..., Wire]) -> Wire:
    return wire()


second_worker = shared_worker()
shadowless_worker = shared_worker("--set", "shadows=no")
ticking_worker = shared_worker("--time-step", "0.5", "--depth-range", "0.8")
"""Half a second passes in its world from frame to frame."""


@pytest.fixture
def own_worker(tmp_path: Path) -> Iterator[Worker]:
    """A worker that the test may harm; its standard error goes to worker.log."""
    with (tmp_path / "worker.log").open("w") as log, started(log=log) as worker:
        yield worker


_WITHOUT_EXTENSIONS = """
from trompe_renderer.command import render
from trompe_renderer.protocol.session import Session
from trompe_shared import sailenv

del Session.get_light_type, sailenv._BY_CODE[0xE1], sailenv._BY_CODE[0xE2]
render(["--port", "0"])
"""
plain_worker = shared_worker(code=_WITHOUT_EXTENSIONS)
"""A worker without our extensions but ``last_error``."""
