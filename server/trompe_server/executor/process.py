"""A process that runs attempts, whoever started it. Imports nothing heavy before it has prepared the environment."""

import functools
import multiprocessing
import multiprocessing.connection
import os
import pickle
import signal
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from trompe_server.executor.attempts import Attempts
    from trompe_server.queue.claims import Claim
    from trompe_server.renderers.discovery import RendererAddresses
    from trompe_server.settings import Settings

__all__ = ["READY", "Setup", "check_node", "run_attempts", "run_here"]

NICE: Final = 10
"""Added niceness, so that the API answers at once while attacks compute on all cores."""
READY: Final = "ready"


@dataclass(frozen=True)
class Setup:
    """What a process needs to run attempts: settings, addresses of renderers, and added environment variables."""

    settings: "Settings"
    renderers: "RendererAddresses"
    environment: tuple[tuple[str, str], ...] = ()


def run_attempts(connection: "Connection", environment: Mapping[str, str], pickled: bytes) -> None:
    """Run the claims received from ``connection`` until it closes; answer ``READY``, then each claim's reason to die.

    ``pickled``: a ``Setup``. It is read after the environment is set, which numpy and torch read at their import.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which ends us in order
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.nice(NICE)
    os.environ.update(environment)
    setup = pickle.loads(pickled)
    attempts = _attempts(setup)
    connection.send(READY)
    while True:
        try:
            claim = connection.recv()
        except EOFError:
            os._exit(0)
        connection.send(attempts.run(claim))


def run_here(setup: Setup, claim: "Claim") -> str | None:
    """Run one attempt in this process. Returns why it was lost, or ``None`` if the record has its end."""
    return _attempts(setup).run(claim)


def check_node(setup: Setup, mark: str) -> str | None:
    """Why attempts cannot run on this node, which must reach the store and the database; ``None`` if they can.

    ``mark``: name of the dispatcher that asks, in both. A sound node imports torch now.
    """
    from trompe_server.executor.attempts import fault_here

    fault = fault_here(setup.settings, mark)
    if fault is None:
        _attempts(setup)
    return fault


@functools.cache
def _attempts(setup: Setup) -> "Attempts":
    for name, value in setup.environment:
        os.environ.setdefault(name, value)
    from trompe_server.executor.attempts import Attempts

    return Attempts(setup.settings, setup.renderers)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    multiprocessing.connection.wait([parent.sentinel])
    os._exit(1)
