"""Supervisor of the renderer workers of ``trompe serve``: starts, restarts and stops them."""

import logging
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Final

from trompe_server.errors import ServiceError
from trompe_server.renderers.discovery import MAX_PROBES, Address, RendererAddresses
from trompe_server.settings import Settings
from trompe_shared.api import RendererInfo
from trompe_shared.errors import RendererError
from trompe_shared.sailenv_client import engine_at

logger = logging.getLogger(__name__)

BACKOFF: Final = (0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
"""Seconds before a dead child is restarted, by its number of early deaths in a row."""
STEADY: Final = 30.0
"""Seconds a child must run for its death not to count as early."""
STOP_PATIENCE: Final = 10.0
NICE: Final = 10
"""Added niceness of the children, so that the API answers at once while they compute on all cores."""
GIVE_UP: Final = 3
"""Deaths before the first ready line after which the start has failed."""
PROBE_PATIENCE: Final = 1.0
"""Seconds a probed renderer has to answer."""


class Child:
    """One supervised process. ``command`` returns its arguments at each start.

    ``ready`` matches the line it prints once it is up; its other lines are logged.
    """

    def __init__(self, name: str, command: Callable[[], list[str]], ready: re.Pattern[str]) -> None:
        self.name, self._command, self._ready = name, command, ready
        self.match: re.Match[str] | None = None
        self.failures = 0
        self._process: subprocess.Popen[str] | None = None
        self._stopping = threading.Event()
        self._up = threading.Event()
        self._thread = threading.Thread(target=self._supervise, name=f"supervise-{name}", daemon=True)

    @property
    def up(self) -> bool:
        """Whether the process runs and is ready."""
        return self._up.is_set()

    def start(self) -> None:
        """Start the process, and restart it whenever it dies, until ``stop``."""
        self._thread.start()

    def wait_ready(self, deadline: float) -> re.Match[str]:
        """Wait for the ready line and return its match.

        Raises ``ServiceError`` at ``deadline`` (monotonic), or earlier if the process keeps dying.
        """
        while not self._up.wait(0.1):
            if time.monotonic() > deadline or (self.match is None and self.failures >= GIVE_UP):
                raise ServiceError(
                    f"The {self.name} does not start (it died {self.failures} times); see its messages above. "
                    "`trompe doctor` looks for the cause."
                )
        assert self.match is not None
        return self.match

    def stop(self) -> None:
        """End the process by SIGTERM, then by SIGKILL."""
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

    def _supervise(self) -> None:
        while not self._stopping.is_set():
            started = time.monotonic()
            status = self._run_once()
            if self._stopping.is_set():
                return
            self.failures = 1 if time.monotonic() - started > STEADY else self.failures + 1
            wait = BACKOFF[min(self.failures, len(BACKOFF)) - 1]
            logger.warning("the %s ended (status %s); restart in %.1f s", self.name, status, wait)
            self._stopping.wait(wait)

    def _run_once(self) -> int:
        """Run the process to its end, read its standard output, and return its exit status.

        It has its own process group: Ctrl-C reaches only us, and we end it in order.
        """
        command = [sys.executable, "-m", "trompe_server.system.child", *self._command()]
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, process_group=0) as process:
            self._process = process
            os.setpriority(os.PRIO_PROCESS, process.pid, os.getpriority(os.PRIO_PROCESS, 0) + NICE)
            if self._stopping.is_set():
                process.terminate()
            assert process.stdout is not None
            for line in process.stdout:
                self._read(line.rstrip())
            status = process.wait()
        self._up.clear()
        return status

    def _read(self, line: str) -> None:
        match = self._ready.search(line)
        if match:
            self.match = match
            self._up.set()
        elif line:
            logger.info("%s: %s", self.name, line)


class Supervisor:
    """The renderers of ``trompe serve``, which ``close`` ends. A restarted one keeps its port.

    RendererAddresses ``elsewhere`` are used and probed, but not supervised.
    """

    def __init__(self, settings: Settings, elsewhere: RendererAddresses) -> None:
        self._settings, self._elsewhere = settings, elsewhere
        self._ports = [0] * settings.renderers
        listening = re.compile(r"^trompe renderer listening on (\S+):(\d+)\b")
        self.renderers = [
            Child("renderer worker", partial(self._render, number), listening) for number in range(settings.renderers)
        ]

    def start(self, *, timeout: float = 90.0) -> None:
        """Start all children and wait until they are ready. Raises ``ServiceError`` after ``timeout`` seconds."""
        deadline = time.monotonic() + timeout
        for renderer in self.renderers:
            renderer.start()
        self._ports = [int(renderer.wait_ready(deadline)[2]) for renderer in self.renderers]

    def close(self) -> None:
        """End all children."""
        with ThreadPoolExecutor(max(1, len(self.renderers))) as pool:
            list(pool.map(Child.stop, self.renderers))

    def missing(self) -> list[str]:
        """Faults of the renderers right now, in words; empty if they are ready."""
        words = [f"the {child.name} is not running" for child in self.renderers if not child.up]
        if not words and not all(_accepts("127.0.0.1", port) for port in self._ports):
            words.append("a renderer worker does not answer")
        elsewhere = not self._ports and self._elsewhere != RendererAddresses()
        if elsewhere and not any(info.alive for info in self.renderer_infos()):
            words.append("no renderer worker elsewhere answers")
        return words

    def renderer_infos(self) -> list[RendererInfo]:
        """The renderer workers with their engines, ``alive`` if they accept connections."""
        with ThreadPoolExecutor(MAX_PROBES) as pool:
            return list(pool.map(_info, [*(("127.0.0.1", port) for port in self._ports), *self._addresses_elsewhere()]))

    def _addresses_elsewhere(self) -> list[Address]:
        """Addresses of the renderers elsewhere; empty if no name resolves."""
        try:
            return self._elsewhere.addresses()
        except RendererError:
            return []

    @property
    def addresses(self) -> RendererAddresses:
        """The renderers here and elsewhere."""
        here = tuple(("127.0.0.1", port) for port in self._ports)
        return RendererAddresses((*here, *self._elsewhere.listed), self._elsewhere.dns)

    def _render(self, number: int) -> list[str]:
        return ["render", "--host", "127.0.0.1", "--port", str(self._ports[number]), *self._settings.engine_flags]


def _info(address: Address) -> RendererInfo:
    host, port = address
    engine = engine_at(host, port, timeout=PROBE_PATIENCE)
    alive = engine is not None or _accepts(host, port)
    told = {"engine": engine.name, "version": engine.version, "settings": engine.settings} if engine else {}
    return RendererInfo(address=f"{host}:{port}", alive=alive, **told)


def _accepts(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=PROBE_PATIENCE).close()
    except OSError:
        return False
    return True
