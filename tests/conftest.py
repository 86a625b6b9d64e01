"""Fixtures shared by the packages: a renderer worker and an object; order, threads and skips of all tests."""

import os
import re
import signal
from collections import Counter
from collections.abc import Generator, Iterator

import pytest
import torch
from hypothesis import HealthCheck, settings

from tests.pretend_device import register
from tests.worker_process import shared_worker
from trompe_server.renderers import SailenvTarget
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import shipped_objects

LONGEST = (
    "service/test_workers.py",
    "pages/test_pages.py",
    "pages/test_orbit.py",
    "e2e/test_paper_objects.py",
    "e2e/test_service.py",
)
"""Files of more than a minute and a half."""

INSTALLABLE = re.compile("install|NOT TESTED")
"""Matches the reason of a test skipped because something is not installed."""


settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("repeated", settings.get_profile("untimed"), derandomize=True)
settings.load_profile("repeated")
"""The same examples in every run; ``--hypothesis-profile=untimed`` looks for others."""


def pytest_configure() -> None:
    """Restore Ctrl-C for child processes, which a background shell ignores, and register the pretend device.

    Torch must know a device before its first gradient.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    share_the_cores(int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 1)))
    register()


def pytest_xdist_auto_num_workers() -> int:
    """Two processes more than cores: many tests wait for other processes."""
    return len(os.sched_getaffinity(0)) + 2


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take longest first, then those with most tests: a long file that begins last works alone."""
    tests = Counter(item.path for item in items)
    items.sort(key=lambda item: (not item.path.as_posix().endswith(LONGEST), -tests[item.path], item.path))


def share_the_cores(processes: int) -> None:
    """Give each test process a share of the threads, and one as large to its children.

    OpenMP's threads spin while they wait: more of them than cores take several times the CPU time.
    """
    threads = max(1, len(os.sched_getaffinity(0)) // (processes + 1))
    os.environ.setdefault("OMP_NUM_THREADS", str(threads))
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test marked ``assets`` without them."""
    if item.get_closest_marker("assets") and "TROMPE_ASSETS" not in os.environ:
        pytest.skip("TROMPE_ASSETS names no folder of real objects and classifiers")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """With TROMPE_REQUIRE_ALL, fail instead of skipping a test that needs something installable."""
    report = yield
    if report.skipped and "TROMPE_REQUIRE_ALL" in os.environ and INSTALLABLE.search(str(report.longrepr)):
        report.outcome = "failed"
        report.longrepr = f"{report.longrepr} (TROMPE_REQUIRE_ALL is set)"
    return report


worker = shared_worker()


@pytest.fixture
def target(worker: tuple[str, int]) -> Iterator[SailenvTarget]:
    target = SailenvTarget(*worker, timeout=240)
    yield target
    target.close()


@pytest.fixture(scope="session")
def mug() -> Object3D:
    return load_object(shipped_objects()["mug"].read())


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without pictures, which take as long as a small attack."""
    monkeypatch.setattr("trompe_server.job.report.picture_files", lambda _: {})
