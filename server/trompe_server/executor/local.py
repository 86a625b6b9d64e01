"""Attempts in processes of this machine, by the standard library."""

import logging
import multiprocessing
import os
import socket
import threading
import time
from collections.abc import Mapping
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Final

from trompe_server.executor.metrics import count
from trompe_server.executor.port import Ended, fits, left_in, too_much
from trompe_server.executor.process import READY, Setup, ending, fork
from trompe_server.queue.claims import Claim
from trompe_server.queue.workers import Worker
from trompe_server.settings import Settings
from trompe_server.system.memory import GIB
from trompe_shared.api import Needs

logger = logging.getLogger(__name__)

LONGEST_WAIT: Final = 30.0
"""Seconds between two starts of a process that dies before it is ready."""
BURIAL: Final = 10.0
"""Longest wait for the end of a killed process, seconds."""


class LocalExecutor:
    """An ``Executor`` of ``setup.settings.workers`` processes, which end with this one. A dead one is replaced.

    They share the cores, the memory and, with a CUDA device, one GPU.
    """

    def __init__(self, setup: Setup) -> None:
        settings = setup.settings
        gpu = float(settings.device.startswith("cuda"))
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB
        self._room = Needs(cpu=settings.workers, gpu=gpu, memory=memory)
        self._device = settings.device
        host, environment = socket.gethostname(), _environment(settings)
        self._slots = [_Slot(f"{host}-{number}", setup, environment) for number in range(settings.workers)]

    def place(self, needs: Needs) -> str | None:
        free = next((slot for slot in self._slots if slot.ready and slot.claim is None), None)
        left = left_in(self._room, (slot.claim for slot in self._slots if slot.claim is not None))
        return free.name if free is not None and fits(needs, left) else None

    def submit(self, claim: Claim) -> None:
        next(slot for slot in self._slots if slot.name == claim.job.worker).run(claim)

    def cancel(self, claim: Claim) -> None:
        for slot in self._slots:
            if slot.claim == claim:
                slot.kill()
                slot.restart()

    def ended(self, timeout: float) -> list[Ended]:
        for slot in self._slots:
            slot.restart_if_due()
        heard = wait([slot.connection for slot in self._slots if not slot.resting], timeout)
        return [end for slot in self._slots if slot.connection in heard and (end := slot.listen()) is not None]

    def workers(self) -> list[Worker]:
        host = socket.gethostname()
        return [Worker(slot.name, host, self._device, slot.fault) for slot in self._slots]

    def unmet(self, waiting: Mapping[Needs, int]) -> dict[Needs, str]:
        return {needs: too_much(needs, [self._room]) for needs in waiting if not fits(needs, self._room)}

    def close(self) -> None:
        for slot in self._slots:
            slot.kill(patience=0.0)


class _Slot:
    """A process and its attempt."""

    def __init__(self, name: str, setup: Setup, environment: Mapping[str, str]) -> None:
        self.name, self._setup, self._environment = name, setup, environment
        self.fault: str | None = None
        self._failures = 0
        self.start()

    def start(self) -> None:
        """Start the process without waiting for the fork server. ``ready`` once it takes attempts."""
        self.connection, theirs = multiprocessing.Pipe()
        self.claim: Claim | None = None
        self.ready, self._restart = False, 0.0
        self._process: BaseProcess | None = None
        self._starting = threading.Thread(target=self._start, args=(theirs,), daemon=True)
        self._starting.start()

    def _start(self, theirs: Connection) -> None:
        try:
            self._process = fork(theirs, self._environment, self._setup)
        except (EOFError, OSError) as error:  # ``listen`` will hear it
            logger.error("the fork server of the attack workers died (%s)", error)
        finally:
            theirs.close()

    def run(self, claim: Claim) -> None:
        self.claim = claim
        try:
            self.connection.send(claim)
        except OSError:  # it died just now, as ``listen`` will hear
            logger.warning("worker %s died before attempt %d of job %s", self.name, claim.attempt, claim.job.id)

    def kill(self, *, patience: float | None = None) -> None:
        """End the process at once. One that has not started in time ends itself, since its connection is closed.

        patience: longest time to wait for its start, seconds; by default any, as the fork server imports torch.
        """
        self._starting.join(patience)
        if self._process is not None:
            self._process.kill()
            self._process.join(BURIAL)  # the fork server tells its end, unless that hangs
        self.connection.close()

    @property
    def resting(self) -> bool:
        """Whether there is no process: it did not get ready, and starts again later."""
        return self._restart > 0

    def restart_if_due(self) -> None:
        """Start the process again after its rest."""
        if self.resting and time.monotonic() > self._restart:
            self.restart()

    def restart(self) -> None:
        """Start the process again, after a rest if that is not possible now."""
        try:
            self.start()
        except OSError as error:  # no file descriptor is left
            logger.warning("worker %s cannot start: %s", self.name, error)
            self._rest(f"{self.name} cannot start ({error})")

    def listen(self) -> Ended | None:
        """Read what the process said; replace a dead one. Returns an attempt that ended."""
        try:
            said = self.connection.recv()
        except (EOFError, OSError):
            return self._bury()
        if said == READY and not self.ready:
            self.ready, self.fault, self._failures = True, None, 0
            return None
        if isinstance(said, tuple):
            count(said)
            return None
        claim, self.claim = self.claim, None
        assert claim is not None
        return Ended(claim, said)

    def _bury(self) -> Ended | None:
        """Replace the dead process, after a while if it was never ready."""
        self.kill()
        reason = f"{self.name} died ({ending(None if self._process is None else self._process.exitcode)})"
        logger.warning("%s", reason)
        claim = self.claim
        if self.ready:
            self.restart()
        else:
            self._rest(f"{reason} before it was ready")
        return None if claim is None else Ended(claim, reason)

    def _rest(self, reason: str) -> None:
        self.ready, self.claim = False, None
        self._failures += 1
        self.fault = f"{reason}, {self._failures} times; its messages are in the service's log"
        self._restart = time.monotonic() + min(2.0 ** (self._failures - 1), LONGEST_WAIT)


def _environment(settings: Settings) -> dict[str, str]:
    """Variables added to the environment of the processes."""
    threads = max(1, len(os.sched_getaffinity(0)) // settings.workers)
    return {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", str(threads))}
