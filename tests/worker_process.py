"""Renderer worker processes for tests, and what a process of any kind holds."""

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

import pytest

SHARP, SHARP_SETTINGS = ("--set", "msaa=1"), "msaa=1"
FLAT, FLAT_SETTINGS = ("--set", "shadows=no"), "shadows=False"
"""Words that start a worker with other pictures, and the settings it tells."""

READY = re.compile(r"trompe renderer listening on (127\.0\.0\.1):(\d+), (.+)\n")


def memory(pid: int, kind: str = "VmRSS") -> int:
    """Bytes of memory that a process holds, or of another ``kind`` in its status: VmHWM is its peak."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    return 1024 * int(re.search(rf"{kind}:\s+(\d+)", status)[1])  # type: ignore[index]


@dataclass(frozen=True)
class Worker:
    """A renderer worker on a free port."""

    process: "subprocess.Popen[str]"
    address: tuple[str, int]

    @property
    def memory(self) -> int:
        """Resident bytes."""
        return memory(self.process.pid)

    @property
    def open(self) -> tuple[int, int]:
        """Numbers of threads and of file descriptors."""
        threads, files = (len(list(Path(f"/proc/{self.process.pid}/{name}").iterdir())) for name in ("task", "fd"))
        return threads, files


@contextmanager
def started(
    *options: str, code: str | None = None, log: IO[str] | None = None, folder: Path | None = None
) -> Iterator[Worker]:
    """A worker for the time of a ``with``: ``trompe render`` with ``options``, or Python ``code`` in its place.

    ``log`` receives its standard error. It runs in ``folder``.
    """
    program = ["-m", "trompe_renderer", "--port", "0", *options] if code is None else ["-c", code]
    command, pipe = [sys.executable, *program], subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=log, text=True, cwd=folder) as process:
        try:
            assert process.stdout is not None
            ready = READY.fullmatch(process.stdout.readline())
            assert ready, "the worker did not start"
            yield Worker(process, (ready[1], int(ready[2])))
        finally:
            process.kill()


def shared_worker(*options: str, code: str | None = None, scope: Literal["session", "module"] = "session") -> Any:
    """A fixture: the address of a worker, ``started`` with these arguments, that the tests of a scope share."""

    @pytest.fixture(scope=scope)
    def address() -> Iterator[tuple[str, int]]:
        with started(*options, code=code) as running:
            yield running.address

    return address
