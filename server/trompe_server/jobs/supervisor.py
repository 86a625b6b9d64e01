"""Looks after the children of ``trompe serve``, renderers and workers: starts them, again and again, and stops them."""

import logging
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import TracebackType
from typing import Final, Self

from trompe_server.errors import ServiceError
from trompe_server.jobs.renderers import Address, Renderers
from trompe_server.jobs.worker import READY
from trompe_server.settings import Settings
from trompe_shared.api import RendererInfo
from trompe_shared.errors import RendererError

__all__ = ["Child", "Supervisor"]

logger = logging.getLogger(__name__)

BACKOFF: Final = (0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
"""Seconds to wait before a child that died is started again, by how often in a row it died soon."""
STEADY: Final = 30.0
"""A child that ran for so many seconds starts again with the shortest wait."""
STOP_PATIENCE: Final = 10.0
NICE: Final = 10
"""How far the children stand back for the API, which shall answer at once while they compute on all cores."""
GIVE_UP: Final = 3
"""A child that died so often before it was ever ready will not come up."""
ASKED_AT_ONCE: Final = 16
"""Renderers that are asked at a time whether they are there: one that is not takes a second to say nothing."""


class Child:
    """One supervised process. ``command`` is asked for its arguments at each start.

    ``ready`` matches the line that it prints once it is up; its other lines are ours to pass on. ``environment`` is
    what it is told besides our own.
    """

    def __init__(
        self,
        name: str,
        command: Callable[[], list[str]],
        ready: re.Pattern[str],
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.name, self._command, self._ready = name, command, ready
        self._environment = os.environ | (environment or {})
        self.match: re.Match[str] | None = None
        self.failures = 0
        self._process: subprocess.Popen[str] | None = None
        self._stopping = threading.Event()
        self._up = threading.Event()
        self._thread = threading.Thread(target=self._look_after, name=f"supervise-{name}", daemon=True)

    @property
    def up(self) -> bool:
        """Whether the process runs and has said that it is ready."""
        return self._up.is_set()

    def start(self) -> None:
        """Start the process, and again whenever it dies, until ``stop``."""
        self._thread.start()

    def wait_ready(self, deadline: float) -> re.Match[str]:
        """The match of the ready line. Raises ``ServiceError`` at ``deadline`` (monotonic) or when it keeps dying."""
        while not self._up.wait(0.1):
            if time.monotonic() > deadline or (self.match is None and self.failures >= GIVE_UP):
                raise ServiceError(
                    f"The {self.name} does not come up (it died {self.failures} times); its last words are above. "
                    "`trompe doctor` looks for the cause."
                )
        assert self.match is not None
        return self.match

    def stop(self) -> None:
        """End the process: SIGTERM, and SIGKILL where that does not help."""
        self._stopping.set()
        process = self._process
        if process is not None and process.poll() is None:
            process.terminate()
            try:
                process.wait(STOP_PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()
        if self._thread.ident is not None:
            self._thread.join()

    def _look_after(self) -> None:
        while not self._stopping.is_set():
            started = time.monotonic()
            status = self._run_once()
            if self._stopping.is_set():
                return
            self.failures = 1 if time.monotonic() - started > STEADY else self.failures + 1
            wait = BACKOFF[min(self.failures, len(BACKOFF)) - 1]
            logger.warning("the %s ended (status %s) and is started again in %.1f s", self.name, status, wait)
            self._stopping.wait(wait)

    def _run_once(self) -> int:
        """Run the process to its end and return its exit status; its standard output is read all the while.

        It has a process group of its own, so that Ctrl-C reaches us alone and we end it in order.
        """
        command = [sys.executable, "-m", "trompe_server.jobs.leash", *self._command()]
        pipe = subprocess.PIPE
        with subprocess.Popen(
            command, stdin=pipe, stdout=pipe, text=True, process_group=0, env=self._environment
        ) as process:
            self._process = process
            os.setpriority(os.PRIO_PROCESS, process.pid, os.getpriority(os.PRIO_PROCESS, 0) + NICE)
            if self._stopping.is_set():
                process.terminate()
            assert process.stdout is not None
            for line in process.stdout:
                self._hear(line.rstrip())
            status = process.wait()
        self._up.clear()
        return status

    def _hear(self, line: str) -> None:
        match = self._ready.search(line)
        if match:
            self.match = match
            self._up.set()
        elif line:
            logger.info("%s: %s", self.name, line)


class Supervisor:
    """The children of ``trompe serve``; a context manager. A renderer keeps its port when it is started again.

    Renderers ``elsewhere`` are used and asked whether they are there, but others look after them.
    """

    def __init__(self, settings: Settings, elsewhere: Renderers) -> None:
        self._settings, self._elsewhere = settings, elsewhere
        self._ports = [0] * settings.renderers
        listening = re.compile(r"^trompe renderer listening on (\S+):(\d+)$")
        self.renderers = [
            Child("renderer worker", partial(self._render, number), listening) for number in range(settings.renderers)
        ]
        ready = re.compile(f"^{re.escape(READY)}$")
        environment = worker_environment(settings)
        self.workers = [Child("attack worker", self._work, ready, environment) for _ in range(settings.workers)]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def start(self, *, timeout: float = 90.0) -> None:
        """Start all; return once they are up. Raises ``ServiceError`` where one is not up in ``timeout`` seconds."""
        deadline = time.monotonic() + timeout
        for renderer in self.renderers:
            renderer.start()
        self._ports = [int(renderer.wait_ready(deadline)[2]) for renderer in self.renderers]
        for worker in self.workers:
            worker.start()
        for worker in self.workers:
            worker.wait_ready(deadline)

    def stop(self) -> None:
        """End all, the attack workers first."""
        for children in (self.workers, self.renderers):
            with ThreadPoolExecutor(max(1, len(children))) as pool:
                list(pool.map(Child.stop, children))

    def missing(self) -> list[str]:
        """What is not up right now, in words; empty when all is well."""
        words = [f"the {child.name} is not up" for child in (*self.workers, *self.renderers) if not child.up]
        if not words and not all(_accepts("127.0.0.1", port) for port in self._ports):
            words.append("a renderer worker does not answer")
        if not self._ports and self._elsewhere != Renderers() and not any(info.alive for info in self.renderer_infos()):
            words.append("none of the renderer workers elsewhere answers")
        return words

    def renderer_infos(self) -> list[RendererInfo]:
        """The renderer workers, and which of them accept connections."""
        with ThreadPoolExecutor(ASKED_AT_ONCE) as pool:
            return list(pool.map(_info, [*(("127.0.0.1", port) for port in self._ports), *self._addresses_elsewhere()]))

    def _addresses_elsewhere(self) -> list[Address]:
        """None where no name of theirs can be resolved."""
        try:
            return self._elsewhere.addresses()
        except RendererError:
            return []

    def _render(self, number: int) -> list[str]:
        return ["render", "--host", "127.0.0.1", "--port", str(self._ports[number])]

    def _work(self) -> list[str]:
        listed = [*(("127.0.0.1", port) for port in self._ports), *self._elsewhere.listed]
        renderers = [word for host, port in listed for word in ("--renderer", f"{host}:{port}")]
        names = [word for name, port in self._elsewhere.dns for word in ("--renderers-dns", f"{name}:{port}")]
        return ["worker", *renderers, *names]


def worker_environment(settings: Settings) -> dict[str, str]:
    """What attack workers of one machine are told: the settings, and how many threads each may use."""
    threads = max(1, len(os.sched_getaffinity(0)) // max(1, settings.workers))
    return {
        "TROMPE_DATA": str(settings.data.absolute()),
        "TROMPE_DATABASE": settings.database_url,
        "TROMPE_STORE": settings.store_url,
        "TROMPE_DEVICE": settings.device,
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", str(threads)),
    }


def _info(address: Address) -> RendererInfo:
    host, port = address
    return RendererInfo(address=f"{host}:{port}", alive=_accepts(host, port))


def _accepts(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=1.0).close()
    except OSError:
        return False
    return True
