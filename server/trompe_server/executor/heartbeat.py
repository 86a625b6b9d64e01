"""A worker's heartbeat. Each beat also checks the running claim and requeues the jobs of dead workers."""

import logging
import time
from collections.abc import Callable
from typing import Final

from trompe_server.executor.runner import JobRunner
from trompe_server.queue.workers import WorkerRegistry

__all__ = ["Heartbeat"]

logger = logging.getLogger(__name__)

INTERVAL: Final = 5.0
"""Longest time between two beats, seconds."""


class Heartbeat:
    """Heartbeat of the worker in ``registry``, whose jobs ``runner`` runs.

    It declares others dead only after it has itself been heard for ``silence`` seconds: after an outage of the database
    nobody has been heard, and everybody needs time to send a heartbeat. ``clock`` is monotonic, in seconds.
    """

    def __init__(
        self,
        registry: WorkerRegistry,
        runner: JobRunner,
        *,
        silence: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._registry, self._runner, self._clock = registry, runner, clock
        self._silence = silence
        self._interval = min(INTERVAL, silence / 4)
        self._heard_since = self._last = clock()

    def run(self) -> None:
        """Beat until the process ends."""
        while True:
            try:
                self.beat()
            except Exception as error:
                self._heard_since = self._clock()
                logger.warning("a heartbeat failed: %s", error)
            time.sleep(self._interval)

    def beat(self) -> None:
        """One heartbeat."""
        claim = self._runner.current
        self._registry.beat(claim.job.id if claim else None)
        if self._clock() - self._last > self._silence / 2:
            self._heard_since = self._clock()  # the process was frozen, the machine asleep or the database locked
        self._last = self._clock()
        if claim is not None and not self._runner.claims.holds(claim) and self._runner.current is claim:
            self._runner.lost.set()
        if self._clock() - self._heard_since > self._silence:
            for job in self._registry.reap(self._silence):
                logger.warning("job %s was requeued: its worker sent no heartbeat", job)
