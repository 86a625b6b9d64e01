"""Runs one attempt of a job phase by phase. Each finished phase is recorded: the next attempt continues after it."""

import logging
import random
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from typing import Final, TypeVar

from trompe_server.errors import NotFoundError
from trompe_server.executor.metrics import Work
from trompe_server.job.protocol import DamagedFileError, PhasedJob, PhaseReport, number_after
from trompe_server.queue.claims import Claim, Claims, Ending, LostJobError
from trompe_server.storage.database import DatabaseDownError
from trompe_shared.api import JobState, Progress
from trompe_shared.errors import RendererError, TrompeError

logger = logging.getLogger(__name__)

T = TypeVar("T")

MAX_DAMAGES: Final = 2
"""Times a phase may find its input damaged and have it made again."""


OpenJob = Callable[[Claim], AbstractContextManager[PhasedJob]]
"""Opens a job, and releases its connection to the renderers. Raises ``TrompeError`` for errors the user can fix."""
TidyJob = Callable[[Claim, list[str]], None]
"""Deletes all files of an ended job except the named ones."""
CountWork = Callable[[Work], None]
"""Takes what a finished phase did."""


class _Cancelled(BaseException):
    """The job was cancelled. Not an ``Exception``, so that no phase catches it."""


class _Lost(BaseException):
    """The job has a newer attempt or has ended."""


@dataclass
class JobRunner:
    """Runs jobs one at a time. Progress is written every ``progress_interval`` seconds at most."""

    claims: Claims
    open_job: OpenJob
    tidy_job: TidyJob = lambda _claim, _kept: None
    count_work: CountWork = lambda _work: None
    progress_interval: float = 1.0
    retry_waits: tuple[float, float] = (0.1, 2.0)
    """Shortest and longest wait before a call of the database is repeated, seconds."""

    def run(self, claim: Claim) -> JobState | None:
        """Run a job, or continue it. Returns its final state, or ``None`` if the attempt was lost.

        Never raises for errors of the job.
        """
        try:
            ending = self._ending(claim)
            kept = self.patiently(lambda: self.claims.finish(claim, ending))
            self._tidy(claim, kept)
            return ending.state
        except (_Lost, LostJobError, NotFoundError) as error:
            logger.warning("job %s was lost: %s", claim.job.id, error)
            public = self.patiently(lambda: self.claims.ended_artifacts(claim))
            if public is not None:  # another attempt has ended the job, and tidied before this one wrote its files
                self._tidy(claim, public)
            return None

    def patiently(self, action: Callable[[], T]) -> T:
        """Call ``action`` until the database can be reached.

        ``action`` must be idempotent: its answer can be lost after the database has committed it.
        """
        wait, longest = self.retry_waits
        while True:
            try:
                return action()
            except DatabaseDownError as error:
                logger.warning("%s Retrying.", error)
            time.sleep(wait * random.uniform(0.5, 1.0))
            wait = min(wait * 2, longest)

    def _tidy(self, claim: Claim, kept: list[str]) -> None:
        try:
            self.tidy_job(claim, kept)
        except Exception:
            logger.warning("cannot delete the working files of job %s", claim.job.id, exc_info=True)

    def _ending(self, claim: Claim) -> Ending:
        phases = _Phases(claim, self)
        try:
            return phases.run_all()
        except _Cancelled:
            return Ending(JobState.cancelled, note="cancelled")
        except (LostJobError, DatabaseDownError):
            raise
        except TrompeError as error:
            return Ending(JobState.failed, error=str(error))
        except Exception as error:
            logger.exception("job %s failed", claim.job.id)
            message = f"{type(error).__name__}: {error}".strip().splitlines()[0][:500]
            return Ending(JobState.failed, error=f"An unexpected error ended the job: {message}")
        finally:
            phases.close()


def _ahead(report: PhaseReport, remaining: Sequence[str]) -> PhaseReport:
    """The report of a finished phase as it is shown until the next one reports: under the name of the next one."""
    if not remaining:
        return report
    kind = remaining[0].partition("-")[0]
    return replace(report, progress=report.progress.model_copy(update={"phase": kind}))


class _Phases:
    """The phases of one job in this process. The job is reopened after the renderer was lost."""

    def __init__(self, claim: Claim, runner: JobRunner) -> None:
        self._claim, self._runner = claim, runner
        self._job: PhasedJob | None = None
        self._opened = ExitStack()
        self._written = 0.0

    def run_all(self) -> Ending:
        """Run the remaining phases. After a phase finds damaged files, the phase before runs again."""
        names, number = self._open().phases(), self._claim.done
        damages = [0] * len(names)
        while number < len(names):
            try:
                report = self._run(names[number])
            except DamagedFileError as error:
                damages[number] += 1
                if number == 0 or damages[number] > MAX_DAMAGES:
                    raise
                logger.warning("job %s repeats the previous phase: %s", self._claim.job.id, error)
                number -= 1
                continue
            if report.state is not None:
                return Ending(report.state, note=report.note, progress=report.progress, public=report.public)
            number = number_after(report, number, names)
            self._record(_ahead(report, names[number:]), done=number)
        return Ending(JobState.succeeded)

    def close(self) -> None:
        """Release the connection to the renderers."""
        self._job = None
        self._opened.close()

    def _run(self, phase: str) -> PhaseReport:
        """Run a phase, once more if the renderer was lost: its supervisor restarts it."""
        try:
            return self._run_once(phase)
        except RendererError:
            logger.warning("phase %s of job %s lost the renderer and runs again", phase, self._claim.job.id)
            self.close()
            return self._run_once(phase)

    def _run_once(self, phase: str) -> PhaseReport:
        job, started = self._open(), time.perf_counter()
        report = job.run(phase, self._on_progress)
        kind = phase.partition("-")[0]  # of attack-003: attack
        self._runner.count_work((kind, time.perf_counter() - started, report.counts))
        return report

    def _record(self, report: PhaseReport, *, done: int) -> None:
        """Record a finished phase. The next one starts only after that."""
        claims = self._runner.claims
        cancelled = self._runner.patiently(
            lambda: claims.advance(self._claim, report.progress, done=done, public=report.public)
        )
        self._written = time.monotonic()
        if cancelled:
            raise _Cancelled

    def _on_progress(self, progress: Progress) -> None:
        """Write progress, and unwind the phase if the job was cancelled or lost."""
        if time.monotonic() - self._written < self._runner.progress_interval:
            return
        self._written = time.monotonic()
        try:
            cancelled = self._runner.claims.advance(self._claim, progress)
        except DatabaseDownError as error:
            logger.warning("cannot write the progress of job %s, which continues: %s", self._claim.job.id, error)
            return
        except LostJobError as error:
            raise _Lost(str(error)) from error
        if cancelled:
            raise _Cancelled

    def _open(self) -> PhasedJob:
        if self._job is None:
            self._job = self._opened.enter_context(self._runner.open_job(self._claim))
        return self._job
