"""Deletes jobs with their files: one on request, and old ones after a number of days."""

import logging
import secrets
import time
from typing import Final

from trompe_server.errors import ConflictError, NotFoundError, ServiceError
from trompe_server.queue.leases import RETENTION, take_lease
from trompe_server.queue.store import JobStore
from trompe_server.storage.folders import Folder, job_artifacts

logger = logging.getLogger(__name__)

DAY: Final = 86_400.0
BATCH: Final = 100
"""Jobs looked up at once."""
INTERVAL: Final = 3600.0
"""Longest time between two runs, seconds. Shorter if jobs are kept for less than four hours."""


def delete_job(store: JobStore, files: Folder, job: str) -> None:
    """Delete an ended job: its files first, then its row, so that no file is left without a row.

    Raises ``NotFoundError``, ``ConflictError`` for a job that has not ended, and ``ServiceError`` if the files cannot
    be deleted; the row stays then, and deleting again works later.
    """
    store.check_ended(job)
    job_artifacts(files, job).delete()
    store.delete(job)


class Retention:
    """Deletes jobs that ended more than ``days`` days ago, and calibrations unused since; 0 keeps everything."""

    def __init__(self, store: JobStore, files: Folder, *, days: float) -> None:
        self._store, self._files, self._kept = store, files, days * DAY
        self._name = secrets.token_hex(4)
        self.interval = max(1.0, min(INTERVAL, self._kept / 4))

    def run_forever(self) -> None:
        """Run periodically, unless another process holds the lease."""
        while self._kept:
            try:
                if take_lease(self._store.engine, RETENTION, holder=self._name, seconds=self.interval * 0.9):
                    self.run()
            except Exception:
                logger.exception("cannot delete old jobs; retry in %.0f s", self.interval)
            time.sleep(self.interval)

    def run(self) -> int:
        """Run once. Returns the number of deleted jobs."""
        deleted, kept = 0, set[str]()
        while jobs := [job for job in self._store.ended_before(self._kept, limit=BATCH + len(kept)) if job not in kept]:
            for job in jobs:
                try:
                    delete_job(self._store, self._files, job)
                    deleted += 1
                except (NotFoundError, ConflictError):
                    logger.info("job %s was deleted by another process", job)
                except ServiceError as error:
                    logger.warning("job %s stays until the next run: %s", job, error)
                    kept.add(job)
        calibrations = self._files.within("library").within("calibrations")
        for name in calibrations.names():
            if time.time() - calibrations.touched(name) > self._kept:
                calibrations.delete(name)
        logger.info("retention deleted %d jobs", deleted)
        return deleted
