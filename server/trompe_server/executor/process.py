"""What runs in the processes of an executor."""

import functools
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Final

from trompe_server.queue.claims import Claim
from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.settings import Settings

if TYPE_CHECKING:
    from trompe_server.executor.attempts import Attempts

__all__ = ["READY", "Setup", "check_node", "run_attempts", "run_here"]

READY: Final = "ready"


@dataclass(frozen=True)
class Setup:
    """What a process needs to run attempts."""

    settings: Settings
    renderers: RendererAddresses


def run_attempts(connection: Connection, environment: Mapping[str, str], setup: Setup) -> None:
    """Answer ``READY``, then run each claim from ``connection`` and answer why it was lost, until it closes."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.environ.update(environment)
    attempts = _attempts(setup)
    connection.send(READY)
    while True:
        try:
            claim = connection.recv()
        except EOFError:
            os._exit(0)
        connection.send(attempts.run(claim))


def run_here(setup: Setup, claim: Claim) -> str | None:
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
    from trompe_server.executor.attempts import Attempts

    return Attempts(setup.settings, setup.renderers)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    multiprocessing.connection.wait([parent.sentinel])
    os._exit(1)
