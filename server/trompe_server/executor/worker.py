"""The worker process: claims jobs from the queue and runs them. The only process that imports torch."""

import logging
import os
import signal
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Final

import prometheus_client
from sqlalchemy.exc import SQLAlchemyError

from trompe_server.errors import ServiceError
from trompe_server.executor.heartbeat import Heartbeat
from trompe_server.executor.opener import JobOpener, load
from trompe_server.executor.runner import JobRunner
from trompe_server.executor.worker_name import worker_name
from trompe_server.queue.claims import Claims, LostJobError
from trompe_server.queue.retention import Retention
from trompe_server.queue.store import JobStore
from trompe_server.queue.workers import WorkerRegistry
from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.settings import Settings
from trompe_server.storage.database import DatabaseDownError
from trompe_server.storage.folders import open_folder
from trompe_server.system.log import about_job
from trompe_server.system.memory import keep_freed_memory
from trompe_server.system.threads import prepare_threads

__all__ = ["READY", "prepare_data", "run_worker"]

logger = logging.getLogger(__name__)

READY: Final = "trompe worker ready"
"""Line printed by a worker once it takes jobs."""

STALL_EXIT: Final = 75
POLLING_INTERVAL: Final = 0.25
"""Seconds between two looks into an empty queue."""
LEAVE_PATIENCE: Final = 5.0
"""Seconds a stopping worker has to give its job back."""


def prepare_data(settings: Settings) -> None:
    """Create the data folder, and create or upgrade the database. Raises ``ServiceError``."""
    store = JobStore(settings.database_url)
    try:
        settings.data.mkdir(parents=True, exist_ok=True)
        store.migrate()
    except (OSError, SQLAlchemyError, DatabaseDownError) as error:
        raise ServiceError(
            f"The data folder {settings.data} or the database cannot be written ({error}). Choose another folder with "
            "--data or TROMPE_DATA, another database with --database or TROMPE_DATABASE."
        ) from error
    finally:
        store.close()


def run_worker(settings: Settings, renderers: RendererAddresses, *, announce: Callable[[str], None]) -> None:
    """Run jobs until SIGTERM or SIGINT. ``renderers`` share the images of each job.

    Calls ``announce`` with ``READY`` once the worker takes jobs.
    """
    keep_freed_memory()
    prepare_threads()
    prepare_data(settings)
    if settings.metrics_port:
        prometheus_client.start_http_server(settings.metrics_port)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with worker_name(settings.data / "workers") as name:
        _work(settings, renderers, name, stop, announce)


def _work(
    settings: Settings, renderers: RendererAddresses, name: str, stop: threading.Event, announce: Callable[[str], None]
) -> None:
    """Run heartbeat, retention and jobs in a thread each; this thread watches for stalls and the stop."""
    store = JobStore(settings.database_url)
    files = open_folder(settings.store_url)
    opener = JobOpener(settings, files, renderers)
    runner = JobRunner(Claims(store.engine, name), opener.open, opener.tidy)
    registry = WorkerRegistry(store.engine, name, device=settings.device)
    runner.patiently(registry.register)
    heartbeat = Heartbeat(registry, runner, silence=settings.silence)
    retention = Retention(store, files, days=settings.retention_days)
    for work in (heartbeat.run, retention.run_forever, partial(_run_jobs, runner, settings, stop)):
        threading.Thread(target=work, daemon=True).start()
    announce(READY)
    logger.info("worker %s takes jobs for %s", name, " and ".join(needs_of(settings.device)))
    while not stop.wait(1.0):
        _end_if_stalled(runner, settings.stall_timeout)
    _leave(runner, registry)


def needs_of(device: str) -> tuple[str, ...]:
    """Needs of jobs that a worker on ``device`` can run."""
    return ("any", "cuda" if device.startswith("cuda") else "cpu")


def _run_jobs(runner: JobRunner, settings: Settings, stop: threading.Event) -> None:
    needs = needs_of(settings.device)
    _preload(settings.pipeline)
    while not stop.is_set():
        try:
            claim = runner.patiently(lambda: runner.claims.claim(needs))
            if claim is None:
                stop.wait(POLLING_INTERVAL)
                continue
            with about_job(claim.job.id):
                runner.run(claim)
        except Exception:
            if not stop.is_set():
                logger.exception("cannot ask the queue; retrying")
                stop.wait(4 * POLLING_INTERVAL)


def _preload(pipeline: str) -> None:
    """Import torch before the first job. If that fails, each job reports it."""
    try:
        load(pipeline)
    except Exception:
        logger.exception("%s cannot be imported; every job will fail", pipeline)


def _end_if_stalled(runner: JobRunner, timeout: float) -> None:
    """End this process if its job makes no progress: the job counts as lost, and the next worker continues it."""
    claim = runner.current
    if claim is not None and time.monotonic() - runner.touched > timeout:
        logger.error("job %s made no progress for %.0f s; restarting its worker", claim.job.id, timeout)
        os._exit(STALL_EXIT)


def _leave(runner: JobRunner, registry: WorkerRegistry) -> None:
    """Stop in order: the running job goes back to the queue, and the next worker repeats its phase.

    A phase cannot be interrupted, so the process ends without waiting for its thread. It does not wait for an
    unreachable database either: then the job counts as lost.
    """
    threading.Timer(LEAVE_PATIENCE, os._exit, args=(0,)).start()
    runner.stopped.set()
    claim = runner.current
    try:
        if claim is not None:
            runner.claims.give_back(claim)
        registry.unregister()
    except (DatabaseDownError, LostJobError) as error:
        logger.warning("the worker stops without giving its job back: %s", error)
    logging.shutdown()
    os._exit(0)
