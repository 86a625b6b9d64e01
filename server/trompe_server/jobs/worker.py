"""The worker process: takes one job after the other from the queue and runs it. The only process that imports torch."""

import logging
import os
import signal
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Final

from sqlalchemy.exc import SQLAlchemyError

from trompe_server.artifacts import open_folder
from trompe_server.database import DatabaseDownError
from trompe_server.errors import ServiceError
from trompe_server.jobs.desk import JobDesk, LostJobError
from trompe_server.jobs.heart import Heart
from trompe_server.jobs.identity import worker_name
from trompe_server.jobs.opener import JobOpener, load
from trompe_server.jobs.renderers import Renderers
from trompe_server.jobs.retention import Retention
from trompe_server.jobs.roll import WorkerRoll
from trompe_server.jobs.runner import JobRunner
from trompe_server.jobs.store import JobStore
from trompe_server.log import about_job
from trompe_server.memory import keep_freed_memory
from trompe_server.settings import Settings
from trompe_server.threads import prepare_threads

__all__ = ["READY", "prepare_data", "run_worker"]

logger = logging.getLogger(__name__)

READY: Final = "trompe worker ready"
"""The line that a worker prints once it takes jobs."""

STALL_EXIT: Final = 75
POLLING_INTERVAL: Final = 0.25
"""Seconds between two looks for a job when there was none."""
LEAVE_PATIENCE: Final = 5.0
"""Seconds that a worker which stops has to hand its job back."""


def prepare_data(settings: Settings) -> None:
    """Make the data folder and the database, or bring them up to date. Raises ``ServiceError`` where that fails."""
    store = JobStore(settings.database_url)
    try:
        settings.data.mkdir(parents=True, exist_ok=True)
        store.migrate()
    except (OSError, SQLAlchemyError, DatabaseDownError) as error:
        raise ServiceError(
            f"The data folder {settings.data} or the database cannot be written ({error}); choose another folder with "
            "--data or TROMPE_DATA, another database with --database or TROMPE_DATABASE."
        ) from error
    finally:
        store.close()


def run_worker(settings: Settings, renderers: Renderers, *, announce: Callable[[str], None]) -> None:
    """Work until SIGTERM or SIGINT, with ``renderers``, which share each job's images.

    ``announce`` is given the line READY once the worker takes jobs.
    """
    keep_freed_memory()
    prepare_threads()
    prepare_data(settings)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with worker_name(settings.data / "workers") as name:
        _work(settings, renderers, name, stop, announce)


def _work(
    settings: Settings, renderers: Renderers, name: str, stop: threading.Event, announce: Callable[[str], None]
) -> None:
    """Sign in, take jobs in one thread and write heartbeats in another; this one looks after both."""
    store = JobStore(settings.database_url)
    files = open_folder(settings.store_url)
    opener = JobOpener(settings, files, renderers)
    runner = JobRunner(JobDesk(store.engine, name), opener.open, opener.tidy)
    roll = WorkerRoll(store.engine, name, device=settings.device)
    runner.patiently(roll.arrive)
    heart = Heart(roll, runner, opener.meter, silence=settings.silence)
    retention = Retention(store, files, days=settings.retention_days)
    for work in (heart.run, retention.run_forever, partial(_take_jobs, runner, settings, stop)):
        threading.Thread(target=work, daemon=True).start()
    announce(READY)
    logger.info("worker %s takes jobs for %s", name, " and ".join(needs_of(settings.device)))
    while not stop.wait(1.0):
        _end_if_stalled(runner, settings.stall_timeout)
    _leave(runner, roll)


def needs_of(device: str) -> tuple[str, ...]:
    """What jobs can need that a worker on this device has."""
    return ("any", "cuda" if device.startswith("cuda") else "cpu")


def _take_jobs(runner: JobRunner, settings: Settings, stop: threading.Event) -> None:
    needs = needs_of(settings.device)
    _preload(settings.pipeline)
    while not stop.is_set():
        try:
            claim = runner.patiently(lambda: runner.desk.claim(needs))
            if claim is None:
                stop.wait(POLLING_INTERVAL)
                continue
            with about_job(claim.job.id):
                runner.run(claim)
        except Exception:
            if not stop.is_set():
                logger.exception("the queue could not be asked; trying again")
                stop.wait(4 * POLLING_INTERVAL)


def _preload(pipeline: str) -> None:
    """Import torch and all that ahead of the first job. Where that fails, each job says so."""
    try:
        load(pipeline)
    except Exception:
        logger.exception("%s cannot be imported; every job will fail", pipeline)


def _end_if_stalled(runner: JobRunner, timeout: float) -> None:
    """End this process when its job stands still: the job counts as lost, and goes on in the next worker."""
    claim = runner.current
    if claim is not None and time.monotonic() - runner.touched > timeout:
        logger.error("job %s made no progress for %.0f s; its worker ends and is started again", claim.job.id, timeout)
        os._exit(STALL_EXIT)


def _leave(runner: JobRunner, roll: WorkerRoll) -> None:
    """Stop in good order: the running job goes back without harm, its phase is run again by the next worker.

    The phase itself cannot be interrupted, so the process ends without waiting for its thread; nor does it wait for a
    database that is down: then the job counts as lost.
    """
    threading.Timer(LEAVE_PATIENCE, os._exit, args=(0,)).start()
    runner.stopped.set()
    claim = runner.current
    try:
        if claim is not None:
            runner.desk.give_back(claim)
        roll.leave()
    except (DatabaseDownError, LostJobError) as error:
        logger.warning("the worker leaves without a word: %s", error)
    logging.shutdown()
    os._exit(0)
