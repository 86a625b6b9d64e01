"""The task of an attempt on a Ray cluster: it holds the resources and waits for a process that ``Forks`` forks for it.

Imports nothing of Trompe, so that the process of a task starts fast. Setups and claims pass through it pickled.
"""

import os
from collections.abc import Callable, Mapping
from multiprocessing.connection import Client, Connection
from typing import Any, Final

GRANTED: Final = ("OMP_NUM_THREADS", "CUDA_VISIBLE_DEVICES")
"""Variables by which Ray tells a task its share of the node."""


class DiedError(Exception):
    """How a forked process died. ``Forks`` sends it as the last message."""


def run_task(forks: Any, setup: bytes, claim: bytes) -> str | None:
    """Run an attempt on the node of ``forks``. Returns why it was lost, or ``None`` if the record has its end."""
    import ray

    return run_forked(lambda: str(ray.get(forks.address.remote())), setup, claim)


def run_forked(address: Callable[[], str], setup: bytes, claim: bytes) -> str | None:
    """Run an attempt in a process forked at ``address()``, which stays for the next attempt of this task's process.

    Returns why it was lost, or ``None`` if the record has its end.
    """
    share = {name: os.environ[name] for name in GRANTED if name in os.environ}
    wanted = setup, tuple(share.items())
    forked = _kept.pop(wanted, None)
    while _kept:
        _kept.popitem()[1].close()  # it has other devices
    try:
        if forked is None or forked.poll():  # it died meanwhile
            forked = connect(address(), setup, share)
        said = _ask(forked, claim)
    except DiedError as died:
        return f"its process died ({died})"
    _kept[wanted] = forked
    return said


_kept: dict[Any, Connection] = {}
"""The process of the last attempt, by what it was forked for."""


def connect(address: str, setup: bytes, share: Mapping[str, str]) -> Connection:
    """A connection to a new process, which is ready. Raises ``DiedError``."""
    forked = Client(address, family="AF_UNIX")
    forked.send(share)
    _ask(forked, setup)
    return forked


def _ask(forked: Connection, pickled: bytes) -> str | None:
    try:
        forked.send_bytes(pickled)
        while isinstance(said := forked.recv(), tuple):
            pass  # what a phase did, which Ray nodes do not count
    except (EOFError, OSError) as error:
        raise DiedError(f"the actor of its node ended: {type(error).__name__}") from error
    if isinstance(said, DiedError):
        raise said
    return None if said is None else str(said)
