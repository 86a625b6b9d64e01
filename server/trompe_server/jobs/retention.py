"""Deletes what is old: jobs that ended long ago, their artifacts, and calibrations that nobody made or used since."""

import logging
import time
from typing import Final

from trompe_server.artifacts import Folder, job_artifacts
from trompe_server.errors import ConflictError, NotFoundError
from trompe_server.jobs.roll import take_lease
from trompe_server.jobs.store import JobStore

__all__ = ["Retention"]

logger = logging.getLogger(__name__)

DAY: Final = 86_400.0
INTERVAL: Final = 3600.0
"""Seconds between two runs, by whichever worker is first; less where jobs are kept for less than four of them."""


class Retention:
    """Keeps ``days`` days of ended jobs in ``store`` and ``files``; 0 keeps all."""

    def __init__(self, store: JobStore, files: Folder, *, days: float) -> None:
        self._store, self._files, self._kept = store, files, days * DAY
        self.interval = max(1.0, min(INTERVAL, self._kept / 4))

    def run_forever(self) -> None:
        """Clear up again and again, where this is asked for and no other process does it."""
        while self._kept:
            try:
                if take_lease(self._store.engine, "retention", seconds=self.interval * 0.9):
                    self.run()
            except Exception:
                logger.exception("old jobs could not be deleted; trying again in %.0f s", self.interval)
            time.sleep(self.interval)

    def run(self) -> int:
        """Clear up now; how many jobs were deleted. Files go first, so that none is left of which nobody knows."""
        deleted = 0
        while jobs := self._store.ended_before(self._kept):
            for job in jobs:
                job_artifacts(self._files, job).delete()
                try:
                    self._store.delete(job)
                except (NotFoundError, ConflictError):
                    logger.info("job %s was deleted by somebody else", job)
            deleted += len(jobs)
        self._delete_calibrations()
        logger.info("retention deleted %d jobs", deleted)
        return deleted

    def _delete_calibrations(self) -> None:
        folder = self._files.within("library").within("calibrations")
        for name in folder.names():
            if time.time() - folder.touched(name) > self._kept:
                folder.delete(name)
