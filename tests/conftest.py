"""What tests of several packages share: a real renderer worker, and objects made from a few numbers."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager

import numpy as np
import pytest
import torch
from hypothesis import settings
from numpy.typing import ArrayLike, NDArray
from pretend_device import register

from trompe_server.target import SailenvTarget
from trompe_shared.object3d import Object3D, encode_png, load_object, object_from_files
from trompe_shared.shipped import shipped_objects

Surface = tuple[ArrayLike, ArrayLike, NDArray[np.uint8]]
"""Corners (F, 3, 3) in metres, their texture coordinates (F, 3, 2), and the texture (H, W, 3) they are painted with."""

INSTALLABLE = re.compile("install|NOT TESTED")
"""What the reason says of a test that is skipped for want of something that could be installed."""


settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


def pytest_configure() -> None:
    """Let Ctrl-C reach what tests start, also where a shell ran us in the background and had it ignored.

    Torch must know of a device before it computes its first gradient.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    share_the_cores(int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 1)))
    register()


def share_the_cores(processes: int) -> None:
    """Of several test processes, each has its share of the threads, and so have those that it starts."""
    if processes > 1:
        threads = max(1, len(os.sched_getaffinity(0)) // processes)
        os.environ.setdefault("OMP_NUM_THREADS", str(threads))
        torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """With TROMPE_REQUIRE_ALL nothing is skipped that could be run here: it fails, saying what to install."""
    report = yield
    if report.skipped and "TROMPE_REQUIRE_ALL" in os.environ and INSTALLABLE.search(str(report.longrepr)):
        report.outcome = "failed"
        report.longrepr = f"{report.longrepr} (TROMPE_REQUIRE_ALL is set)"
    return report


def start_worker(*options: str) -> tuple[subprocess.Popen[str], str]:
    """A worker process on a free port and the one line that says it is ready."""
    process = subprocess.Popen(
        [sys.executable, "-m", "trompe_renderer", "--port", "0", *options], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    return process, process.stdout.readline()


@contextmanager
def _running_worker(*options: str) -> Iterator[tuple[str, int]]:
    process, line = start_worker(*options)
    try:
        ready = re.fullmatch(r"trompe renderer listening on (127\.0\.0\.1):(\d+)\n", line)
        assert ready, line
        yield ready[1], int(ready[2])
    finally:
        process.kill()
        process.communicate()


@pytest.fixture(scope="session")
def running_worker() -> Callable[..., AbstractContextManager[tuple[str, int]]]:
    """Runs a worker with the options given, for the time of a ``with``; gives its address."""
    return _running_worker


@pytest.fixture(scope="session")
def worker() -> Iterator[tuple[str, int]]:
    """The address of the worker that all tests share."""
    with _running_worker() as address:
        yield address


@pytest.fixture
def target(worker: tuple[str, int]) -> Iterator[SailenvTarget]:
    target = SailenvTarget(*worker, timeout=60)
    yield target
    target.close()


@pytest.fixture(scope="session")
def mug() -> Object3D:
    return load_object(shipped_objects()["mug"].read())


@pytest.fixture(scope="session")
def make_object() -> Callable[..., Object3D]:
    """Makes an object of ``Surface``s, each a material of its own (m0, m1, ... painted with m0.png, m1.png, ...)."""
    return _object_of


def _object_of(*surfaces: Surface) -> Object3D:
    lines: list[str] = []
    corners_so_far = 0
    files: dict[str, bytes] = {}
    for number, (corners, uvs, texture) in enumerate(surfaces):
        points, coordinates = np.reshape(corners, (-1, 3)), np.reshape(uvs, (-1, 2))
        lines += ["v {!r} {!r} {!r}".format(*map(float, row)) for row in points]
        lines += ["vt {!r} {!r}".format(*map(float, row)) for row in coordinates]
        lines.append(f"usemtl m{number}")
        for first in range(corners_so_far + 1, corners_so_far + len(points) + 1, 3):
            lines.append("f " + " ".join(f"{k}/{k}" for k in range(first, first + 3)))
        corners_so_far += len(points)
        files[f"m{number}.png"] = encode_png(texture)
    table = {f"m{number}": {"albedo": f"m{number}.png"} for number in range(len(surfaces))}
    mesh = "\n".join(lines).encode()
    return object_from_files({"made.obj": mesh, "made_mat_def.json": json.dumps(table).encode()} | files)


@pytest.fixture(scope="session")
def make_quad() -> Callable[..., Surface]:
    """Makes a square that faces a camera at azimuth 0, the texture upright on it."""
    return _quad


def _quad(texture: NDArray[np.uint8], *, half: float = 0.1, z: float = 0.0, repeat: float = 1.0) -> Surface:
    """Half side in metres; the texture is repeated ``repeat`` times each way."""
    square = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    uvs = repeat * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    rows = [0, 1, 2, 0, 2, 3]
    return square[rows].reshape(-1, 3, 3), uvs[rows].reshape(-1, 3, 2), texture
