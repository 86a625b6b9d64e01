"""How a worker runs one job: phase by phase, each noted when it is done, so that another worker can go on after it."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, TypeVar

from trompe_server.database import DatabaseDownError, patiently
from trompe_server.errors import NotFoundError
from trompe_server.jobs.desk import Claim, Ending, JobDesk, LostJobError
from trompe_server.pipeline import DamagedFileError, PhaseReport, Pipeline
from trompe_shared.api import JobState, Progress
from trompe_shared.errors import RendererError, TrompeError

__all__ = ["JobRunner", "OpenedJob"]

logger = logging.getLogger(__name__)

T = TypeVar("T")

PROGRESS_INTERVAL: Final = 1.0
"""Seconds between two writes of a job's progress."""
DAMAGES: Final = 2
"""So often a phase may find what it needs damaged and have it made again."""


@dataclass(frozen=True)
class OpenedJob:
    """A job ready to run, and how to let go of what it holds (the connection to the renderer)."""

    pipeline: Pipeline
    close: Callable[[], None]


OpenJob = Callable[[Claim], OpenedJob]
"""Opens a job; raises ``TrompeError`` for what the user can mend."""
TidyJob = Callable[[Claim, list[str]], None]
"""Removes what a job that has ended needs no more: all files but the ones named."""


class _Stop(BaseException):
    """Unwinds a phase; not an ``Exception``, so that no phase swallows it."""


class _Cancelled(_Stop):
    """The job shall be cancelled."""


class _Lost(_Stop):
    """The job is another worker's by now."""


@dataclass
class JobRunner:
    """Runs jobs one at a time. ``current`` is the one that runs, ``touched`` when it last moved (monotonic).

    Setting ``lost`` makes the running job unwind at its next step; ``stopped`` ends waiting for a database that is
    down.
    """

    desk: JobDesk
    open_job: OpenJob
    tidy_job: TidyJob = lambda _claim, _kept: None
    current: Claim | None = None
    touched: float = field(default_factory=time.monotonic)
    lost: threading.Event = field(default_factory=threading.Event)
    stopped: threading.Event = field(default_factory=threading.Event)

    def run(self, claim: Claim) -> JobState | None:
        """Run a job to its end, or go on with it; its state, or ``None`` where it was lost to another worker.

        Never raises for what the job does.
        """
        self.lost.clear()
        self.current, self.touched = claim, time.monotonic()
        try:
            ending = self._ending(claim)
            kept = self.patiently(lambda: self.desk.finish(claim, ending))
            self._tidy(claim, kept)
            return ending.state
        except (_Lost, LostJobError, NotFoundError) as error:
            logger.warning("job %s goes on elsewhere: %s", claim.job.id, error)
            self._tidy_after(claim)
            return None
        finally:
            self.current = None

    def patiently(self, action: Callable[[], T]) -> T:
        """Do what asks the database, again and again while it is down."""
        return patiently(action, stopped=self.stopped.is_set)

    def _tidy_after(self, claim: Claim) -> None:
        """Remove what this attempt wrote after another one had ended the job, which has tidied before."""
        kept = self.patiently(lambda: self.desk.left(claim))
        if kept is not None:
            self._tidy(claim, kept)

    def _tidy(self, claim: Claim, kept: list[str]) -> None:
        try:
            self.tidy_job(claim, kept)
        except Exception:
            logger.warning("what job %s needs no more could not be removed", claim.job.id, exc_info=True)

    def _ending(self, claim: Claim) -> Ending:
        """How the job ends; its failures are an ending, too."""
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


class _Phases:
    """The phases of one job in this process. The pipeline is opened anew when the renderer was lost."""

    def __init__(self, claim: Claim, runner: JobRunner) -> None:
        self._claim, self._runner = claim, runner
        self._opened: OpenedJob | None = None
        self._eta = _Eta(claim.job.progress.fraction)
        self._written = 0.0

    def run_all(self) -> Ending:
        """Run the phases that are left. One that finds damaged files has them made again by the phases before it."""
        names, number = self._open().pipeline.phases(), self._claim.done
        damages: Counter[int] = Counter()
        while number < len(names):
            try:
                report = self._run(names[number])
            except DamagedFileError as error:
                damages[number] += 1
                if number == 0 or damages[number] > DAMAGES:
                    raise
                logger.warning("job %s goes one phase back: %s", self._claim.job.id, error)
                number -= 1
                continue
            if report.state is not None:
                return Ending(report.state, note=report.note, progress=report.progress, public=report.public)
            number += 1
            self._note(report, done=number)
        return Ending(JobState.succeeded)

    def close(self) -> None:
        """Let go of the renderer."""
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def _run(self, phase: str) -> PhaseReport:
        """Run a phase, and once more when the renderer went away: it is started again by whoever looks after it."""
        try:
            return self._open().pipeline.run(phase, self._on_progress)
        except RendererError:
            logger.warning("phase %s of job %s lost the renderer and is run again", phase, self._claim.job.id)
            self.close()
            return self._open().pipeline.run(phase, self._on_progress)

    def _note(self, report: PhaseReport, *, done: int) -> None:
        """Write that a phase is done; until that is written the next one does not begin."""
        progress, desk = self._eta.told(report.progress), self._runner.desk
        cancelled = self._runner.patiently(lambda: desk.advance(self._claim, progress, done=done, public=report.public))
        self._runner.touched = self._written = time.monotonic()
        if cancelled:
            raise _Cancelled

    def _on_progress(self, progress: Progress) -> None:
        """Write progress now and then, and unwind the phase when the job was cancelled or lost."""
        self._runner.touched = time.monotonic()
        if self._runner.lost.is_set():
            raise _Lost("it was taken away")
        if self._runner.touched - self._written < PROGRESS_INTERVAL:
            return
        self._written = self._runner.touched
        try:
            cancelled = self._runner.desk.advance(self._claim, self._eta.told(progress))
        except DatabaseDownError as error:
            logger.warning("the progress of job %s could not be written, and it runs on: %s", self._claim.job.id, error)
            return
        except LostJobError as error:
            raise _Lost(str(error)) from error
        if cancelled:
            raise _Cancelled

    def _open(self) -> OpenedJob:
        if self._opened is None:
            self._opened = self._runner.open_job(self._claim)
        return self._opened


class _Eta:
    """Tells how long a job still takes, as if it went on as fast as in this attempt so far."""

    def __init__(self, fraction: float) -> None:
        self._fraction, self._began = fraction, time.monotonic()

    def told(self, progress: Progress) -> Progress:
        """``progress`` with the seconds until the job's end, as soon as there is something to go by."""
        gained, left = progress.fraction - self._fraction, 1.0 - progress.fraction
        if gained <= 0.01:
            return progress
        return progress.model_copy(update={"eta_seconds": round((time.monotonic() - self._began) * left / gained, 1)})
