"""Supervisor of the renderer workers of ``trompe serve``: starts, restarts and stops them."""

import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import IO, Final

from trompe_server.errors import ServiceError
from trompe_server.renderers.discovery import MAX_PROBES, RendererAddresses
from trompe_server.renderers.pool import Address
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
LAST_WORDS: Final = 1.0
"""Seconds to read what an ended child has printed."""
NICE: Final = 10
"""Added niceness of the children, so that the API answers at once while they compute on all cores."""
GIVE_UP: Final = 3
"""Deaths before the first ready line after which the start has failed."""
PROBE_PATIENCE: Final = 1.0
"""Seconds a probed renderer has to answer."""

LISTENING: Final = re.compile(r"trompe renderer listening on \S+:(\d+)\b")
"""Said by a renderer worker once it is ready, maybe after words of its engine; its other lines are logged."""


class _Renderer:
    """One supervised renderer worker, with an engine by ``flags``. ``port``: its own once it was ready, first 0.

    silence: seconds without an answer after which it counts as hung and is replaced.
    """

    def __init__(self, flags: Sequence[str], *, silence: float) -> None:
        self._flags, self._silence, self.port, self._failures = flags, silence, 0, 0
        self._process: subprocess.Popen[str] | None = None
        self._stopping = threading.Event()
        self._up = threading.Event()
        self.silent = False
        """Whether the last probe got no answer."""
        self._thread = threading.Thread(target=self._supervise, name="supervise-renderer", daemon=True)

    @property
    def up(self) -> bool:
        """Whether the process runs and is ready."""
        return self._up.is_set()

    def start(self) -> None:
        """Start the process, and restart it whenever it dies, until ``stop``."""
        self._thread.start()

    def wait_ready(self, deadline: float) -> None:
        """Raise ``ServiceError`` if it is not up at ``deadline`` (monotonic), or earlier if the process keeps dying."""
        while not self._up.wait(0.1):
            if time.monotonic() > deadline or (not self.port and self._failures >= GIVE_UP):
                raise ServiceError(
                    f"The renderer worker does not start (it died {self._failures} times); see its messages above. "
                    "`trompe doctor` looks for the cause."
                )

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
            self._failures = 1 if time.monotonic() - started > STEADY else self._failures + 1
            wait = BACKOFF[min(self._failures, len(BACKOFF)) - 1]
            logger.warning("the renderer worker ended (status %s); restart in %.1f s", status, wait)
            self._stopping.wait(wait)

    def _run_once(self) -> int:
        """Run the process to its end and return its exit status.

        It has its own process group: Ctrl-C reaches only us, and we end it in order, with the processes of its engine.
        """
        place = ["--host", "127.0.0.1", "--port", str(self.port)]
        command = [sys.executable, "-m", "trompe_shared.child", "render", *place, *self._flags]
        pipe = subprocess.PIPE
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, errors="replace", process_group=0)
        self._process = process
        os.setpriority(os.PRIO_PROCESS, process.pid, os.getpriority(os.PRIO_PROCESS, 0) + NICE)
        if self._stopping.is_set():
            process.terminate()
        reader = threading.Thread(target=self._read, args=(process.stdout,), daemon=True)
        reader.start()
        status = self._ended(process)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        reader.join(LAST_WORDS)  # a process in a group of its own may still hold the output
        self._up.clear()
        self.silent = False
        assert process.stdin is not None
        process.stdin.close()
        return status

    def _ended(self, process: "subprocess.Popen[str]") -> int:
        """The exit status of the process; once ready it is asked now and then, and killed if it is silent for long."""
        heard, interval = time.monotonic(), self._silence / 6
        while True:
            with suppress(subprocess.TimeoutExpired):
                return process.wait(interval)
            self.silent = self.up and engine_at("127.0.0.1", self.port, timeout=interval) is None
            if not self.silent:
                heard = time.monotonic()
            elif time.monotonic() - heard > self._silence and process.poll() is None:
                logger.error("the renderer worker has not answered for %.0f s and is killed", time.monotonic() - heard)
                process.kill()

    def _read(self, output: IO[str]) -> None:
        with output:
            for line in output:
                if match := LISTENING.search(line):
                    self.port = int(match[1])
                    self._up.set()
                elif words := line.strip():
                    logger.info("renderer worker: %s", words)


class Supervisor:
    """The renderers of ``trompe serve``, which ``close`` ends. A restarted one keeps its port.

    RendererAddresses ``elsewhere`` are used and probed, but not supervised.
    """

    def __init__(self, settings: Settings, elsewhere: RendererAddresses) -> None:
        self._elsewhere = elsewhere
        flags, silence = settings.engine_flags, settings.silence
        self._renderers = [_Renderer(flags, silence=silence) for _ in range(settings.renderers)]

    def start(self, *, timeout: float = 90.0) -> None:
        """Start all children and wait until they are ready. Raises ``ServiceError`` after ``timeout`` seconds."""
        deadline = time.monotonic() + timeout
        for renderer in self._renderers:
            renderer.start()
        for renderer in self._renderers:
            renderer.wait_ready(deadline)

    def close(self) -> None:
        with ThreadPoolExecutor(max(1, len(self._renderers))) as pool:
            list(pool.map(_Renderer.stop, self._renderers))

    def missing(self) -> list[str]:
        """Faults of the renderers right now, in words; empty if they are ready."""
        words = ["the renderer worker is not running" for renderer in self._renderers if not renderer.up]
        if not words and any(renderer.silent for renderer in self._renderers):
            words.append("a renderer worker does not answer")
        elsewhere = not self._renderers and self._elsewhere != RendererAddresses()
        if elsewhere and not any(info.alive for info in self.renderer_infos()):
            words.append("no renderer worker elsewhere answers")
        return words

    def renderer_infos(self) -> list[RendererInfo]:
        """The renderer workers with their engines, ``alive`` if they accept connections and are not hung."""
        addresses = self._here()
        hung = {("127.0.0.1", renderer.port) for renderer in self._renderers if renderer.silent}
        with suppress(RendererError):  # none of the names resolves
            addresses += self._elsewhere.addresses()
        with ThreadPoolExecutor(MAX_PROBES) as pool:
            return list(pool.map(lambda address: _info(address, hung=address in hung), addresses))

    def _here(self) -> list[Address]:
        return [("127.0.0.1", renderer.port) for renderer in self._renderers]

    @property
    def addresses(self) -> RendererAddresses:
        """The renderers here and elsewhere."""
        return RendererAddresses((*self._here(), *self._elsewhere.listed), self._elsewhere.dns)


def _info(address: Address, *, hung: bool) -> RendererInfo:
    host, port = address
    engine = engine_at(host, port, timeout=PROBE_PATIENCE)
    alive = engine is not None or (not hung and _accepts(host, port))
    told = {"engine": engine.name, "version": engine.version, "settings": engine.settings} if engine else {}
    return RendererInfo(address=f"{host}:{port}", alive=alive, **told)


def _accepts(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=PROBE_PATIENCE).close()
    except OSError:
        return False
    return True
