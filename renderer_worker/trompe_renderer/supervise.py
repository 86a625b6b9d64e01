"""Runs a worker in a process of its own and starts another when it crashes, as drivers of graphics cards may.

The listening socket belongs to the supervisor: its address stays, and agents that connect in between wait in line. The
worker holds the end of a pipe that tells it when the supervisor is gone.
"""

import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Final

from trompe_shared.errors import RendererError

__all__ = ["LOST", "listen", "supervise"]

BACKLOG: Final = 64
"""Agents that may wait in line."""

LOST: Final = 75
"""Exit status of a worker whose OpenGL is lost."""
BACKOFF: Final = (0.1, 0.5, 2.0, 10.0)
"""Seconds to wait before the next start, by how often in a row the worker crashed soon."""
STEADY: Final = 30.0
"""A worker that ran for so many seconds starts again with the shortest wait."""

log = logging.getLogger(__name__)


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens, on a free port for 0. Raises ``RendererError`` where that cannot be."""
    try:
        return socket.create_server((host, port), backlog=BACKLOG)
    except OSError as error:
        raise RendererError(f"Cannot listen on {host}:{port} ({error}). Choose another --host or --port.") from error


def supervise(work: Callable[[], int]) -> int:
    """Run ``work`` in a child process until it returns an exit status, anew after each crash; that status.

    SIGTERM and SIGINT are passed on to the child. To be called before threads are started or OpenGL is loaded, for it
    forks.
    """
    crashes, wanted = 0, _Signals()
    while True:
        started = time.monotonic()
        status = _run_once(work, wanted)
        if wanted.received == signal.SIGINT:
            return 128 + signal.SIGINT
        if wanted.received or (status >= 0 and status != LOST):
            return max(status, 0)
        crashes = 1 if time.monotonic() - started > STEADY else crashes + 1
        wait = BACKOFF[min(crashes, len(BACKOFF)) - 1]
        log.warning("the worker crashed (status %d) and is started again in %.1f s", status, wait)
        time.sleep(wait)


class _Signals:
    """Passes SIGTERM and SIGINT on to the child of the time."""

    def __init__(self) -> None:
        self.child: int | None = None
        self.received: int | None = None
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._pass_on)

    def _pass_on(self, number: int, _frame: FrameType | None) -> None:
        self.received = number
        if self.child is None:
            sys.exit(128 + number)
        os.kill(self.child, signal.SIGTERM)


def _run_once(work: Callable[[], int], wanted: _Signals) -> int:
    """The exit status of one child, negative for the signal that ended it."""
    sys.stdout.flush()
    leash, held = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(held)
        _be_the_child(work, leash)
    os.close(leash)
    wanted.child = child
    try:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    finally:
        wanted.child = None
        os.close(held)


def _be_the_child(work: Callable[[], int], leash: int) -> None:
    """Run ``work`` and end the process, whatever happens."""
    status = 1
    try:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN if number == signal.SIGINT else signal.SIG_DFL)
        threading.Thread(target=_end_with_supervisor, args=(leash,), daemon=True).start()
        status = work()
    except BaseException:
        log.exception("the worker cannot go on")
    finally:
        logging.shutdown()
        sys.stdout.flush()
        os._exit(status)


def _end_with_supervisor(leash: int) -> None:
    os.read(leash, 1)
    os._exit(1)
