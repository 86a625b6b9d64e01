"""A worker's heartbeat, and what is done at each beat: notice a job that was lost, look after the dead."""

import logging
import time
from typing import Final

from trompe_server.jobs.roll import WorkerRoll
from trompe_server.jobs.runner import JobRunner
from trompe_server.meter import Meter

__all__ = ["Heart"]

logger = logging.getLogger(__name__)

INTERVAL: Final = 5.0
"""Seconds between two beats; fewer where the silence after which one counts as dead is short."""


class Heart:
    """Beats for the worker of ``roll`` while ``runner`` runs its jobs.

    It calls others dead only after it could itself be heard for as long as they were silent: after an outage of the
    database everyone is silent, and must have the time to be heard again.
    """

    def __init__(self, roll: WorkerRoll, runner: JobRunner, meter: Meter, *, silence: float) -> None:
        self._roll, self._runner, self._meter = roll, runner, meter
        self._silence = silence
        self._interval = min(INTERVAL, silence / 4)
        self._heard_since = self._last = time.monotonic()

    def run(self) -> None:
        """Beat until the process ends."""
        while True:
            try:
                self.beat()
            except Exception as error:
                self._heard_since = time.monotonic()
                logger.warning("a heartbeat failed: %s", error)
            time.sleep(self._interval)

    def beat(self) -> None:
        """One heartbeat."""
        claim, done = self._runner.current, self._meter.take()
        try:
            self._roll.beat(claim.job.id if claim else None, done)
        except BaseException:
            self._meter.add(**done)
            raise
        if time.monotonic() - self._last > self._silence / 2:
            self._heard_since = time.monotonic()  # this process was frozen, its machine asleep, the database held up
        self._last = time.monotonic()
        if claim is not None and not self._runner.desk.holds(claim) and self._runner.current is claim:
            self._runner.lost.set()
        if time.monotonic() - self._heard_since > self._silence:
            for job in self._roll.reap(self._silence):
                logger.warning("job %s was taken from a worker that fell silent", job)
