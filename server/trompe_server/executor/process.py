"""What runs in the processes of an executor, and how they are forked."""

import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Final

from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.settings import Settings
from trompe_server.system.threads import threads

READY: Final = "ready"
_FORKING: Final = threading.Lock()


@dataclass(frozen=True)
class Setup:
    """What a process needs to run attempts."""

    settings: Settings
    renderers: RendererAddresses


def fork(connection: Connection, environment: Mapping[str, str], setup: Setup) -> BaseProcess:
    """Fork a process that runs ``run_attempts`` from a fork server, which has imported torch and runs nothing.

    It takes milliseconds, and all share the server's memory. They end with this process. ``environment`` is added to
    theirs. Raises ``EOFError`` or ``OSError`` if the fork server died; the next call starts another.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["trompe_server.executor.preload"])
    process = context.Process(target=run_attempts, args=(connection, environment, setup), daemon=True)
    found = {"PYTHONPATH": os.pathsep.join(sys.path), "PYTHONSAFEPATH": "1"}  # the modules that we see
    with _FORKING, _added({**found, "TROMPE_PIPELINE": setup.settings.pipeline, **environment}):
        process.start()
    return process


def run_attempts(connection: Connection, environment: Mapping[str, str], setup: Setup) -> None:
    """Answer ``READY``, then run each claim from ``connection`` and answer why it was lost, until it closes.

    Before the answer comes a message of ``Work`` for each finished phase.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.environ.update(environment)
    from trompe_server.executor.attempts import Attempts

    def say(message: object) -> None:
        with suppress(OSError):  # the executor closed, as ``recv`` will tell
            connection.send(message)

    attempts = Attempts(setup.settings, setup.renderers, count_work=say)
    if torch := sys.modules.get("torch"):  # the fork server has imported it with its own number of threads
        torch.set_num_threads(threads())
    say(READY)
    while True:
        try:
            claim = connection.recv()
        except EOFError:
            os._exit(0)
        say(attempts.run(claim))


def ending(status: int | None) -> str:
    """How a process ended, by its exit status."""
    if status is None:
        return "it could not start"
    return f"signal {-status}" if status < 0 else f"status {status}"


@contextmanager
def _added(variables: Mapping[str, str]) -> Iterator[None]:
    """Add variables to the environment of processes started in the block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    multiprocessing.connection.wait([parent.sentinel])
    os._exit(1)
