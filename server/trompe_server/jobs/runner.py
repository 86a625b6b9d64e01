"""How a worker runs one job, phase by phase, under any engine that can call a step and remember what it returned."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from sqlalchemy.exc import SQLAlchemyError

from trompe_server.jobs.store import JobStore
from trompe_server.pipeline import PhaseReport, Pipeline
from trompe_shared.api import Job, JobState, Progress
from trompe_shared.errors import RendererError, TrompeError

__all__ = ["JobRunner", "OpenedJob", "Outcome"]

logger = logging.getLogger(__name__)

Outcome = dict[str, Any]
"""What a step returns and the engine keeps: ``{"state", "error", "note"}``, or ``{}`` when the job goes on."""

Step = Callable[[str, Callable[[], Outcome]], Outcome]

PROGRESS_INTERVAL: Final = 0.25
"""Seconds between two writes of a job's progress."""


@dataclass(frozen=True)
class OpenedJob:
    """A job ready to run, and how to let go of what it holds (the connection to the renderer)."""

    pipeline: Pipeline
    close: Callable[[], None]


OpenJob = Callable[[Job], OpenedJob]
"""Opens a job; raises ``TrompeError`` for what the user can mend."""


class _Cancelled(BaseException):
    """Unwinds a phase of a cancelled job; not an ``Exception``, so that no phase swallows it."""


@dataclass
class JobRunner:
    """Runs jobs of ``store`` one at a time. ``current`` is the one that runs, ``touched`` when it last moved."""

    store: JobStore
    open_job: OpenJob
    current: str | None = None
    touched: float = field(default_factory=time.monotonic)

    def run(self, job_id: str, step: Step) -> str:
        """Run a job to its end, or go on with it; each phase is one ``step``. Never raises for what the job does."""
        job = self.store.begin(job_id)
        if job is None:
            return self.store.get(job_id).state
        self.current, self.touched = job_id, time.monotonic()
        try:
            outcome = _guarded(job_id, lambda: self._run_phases(job, step))
            self.store.finish(job_id, JobState(outcome["state"]), error=outcome.get("error"), note=outcome.get("note"))
        finally:
            self.current = None
        return str(outcome["state"])

    def _run_phases(self, job: Job, step: Step) -> Outcome:
        phases = _Phases(job, self)
        try:
            for name in phases.names():
                outcome = step(name, lambda name=name: phases.run(name))  # type: ignore[misc]
                if outcome:
                    return outcome
            return {"state": JobState.succeeded.value}
        finally:
            phases.close()

    def report(self, job_id: str) -> Callable[[Progress], None]:
        """A callback that writes progress now and then, and unwinds the phase when the job was cancelled."""
        written = 0.0

        def on_progress(progress: Progress) -> None:
            nonlocal written
            self.touched = time.monotonic()
            if self.touched - written < PROGRESS_INTERVAL:
                return
            written = self.touched
            try:
                cancelled = self.store.advance(job_id, progress)
            except SQLAlchemyError:
                logger.warning("the progress of job %s could not be written; it runs on", job_id, exc_info=True)
                return
            if cancelled:
                raise _Cancelled

        return on_progress


class _Phases:
    """The phases of one job in this process. The pipeline is opened anew when the renderer was lost."""

    def __init__(self, job: Job, runner: JobRunner) -> None:
        self._job, self._runner = job, runner
        self._opened: OpenedJob | None = None

    def names(self) -> list[str]:
        return self._open().pipeline.phases()

    def run(self, phase: str) -> Outcome:
        """Run one phase; what it did is written to the store, and its outcome returned for the engine to keep."""
        return _guarded(self._job.id, lambda: self._run(phase))

    def close(self) -> None:
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def _run(self, phase: str) -> Outcome:
        if self._runner.store.cancel_requested(self._job.id):
            raise _Cancelled
        report = self._run_again_without_renderer(phase)
        cancelled = self._runner.store.advance(self._job.id, report.progress, public=report.public)
        self._runner.touched = time.monotonic()
        if report.state is not None:
            return {"state": report.state.value, "note": report.note}
        if cancelled:
            raise _Cancelled
        return {}

    def _run_again_without_renderer(self, phase: str) -> PhaseReport:
        """Run a phase, and once more when the renderer went away: it is started again by whoever looks after it."""
        on_progress = self._runner.report(self._job.id)
        try:
            return self._open().pipeline.run(phase, on_progress)
        except RendererError:
            logger.warning("phase %s of job %s lost the renderer and is run again", phase, self._job.id, exc_info=True)
            self.close()
            return self._open().pipeline.run(phase, on_progress)

    def _open(self) -> OpenedJob:
        if self._opened is None:
            self._opened = self._runner.open_job(self._job)
        return self._opened


def _guarded(job_id: str, action: Callable[[], Outcome]) -> Outcome:
    """What ``action`` returns, or the outcome that its failure or the job's cancellation means."""
    try:
        return action()
    except _Cancelled:
        return {"state": JobState.cancelled.value, "note": "cancelled"}
    except TrompeError as error:
        return {"state": JobState.failed.value, "error": str(error)}
    except Exception as error:
        logger.exception("job %s failed", job_id)
        message = f"{type(error).__name__}: {error}".strip().splitlines()[0][:500]
        return {"state": JobState.failed.value, "error": f"An unexpected error ended the job: {message}"}
