"""The worker process: takes one job after the other from the queue and runs it. The only process that imports torch."""

import importlib
import itertools
import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

from sqlalchemy.exc import SQLAlchemyError

from trompe_server.artifacts import LocalArtifacts
from trompe_server.errors import ServiceError
from trompe_server.files import exclusive
from trompe_server.jobs.engine import DbosWorker, migrate_engine
from trompe_server.jobs.runner import JobRunner, OpenedJob
from trompe_server.jobs.store import JobStore
from trompe_server.library import Library
from trompe_server.memory import keep_freed_memory
from trompe_server.settings import Settings
from trompe_shared.api import Job
from trompe_shared.errors import RendererError

Address = tuple[str, int]

__all__ = ["READY", "prepare_data", "run_worker", "wait_for_renderer"]

logger = logging.getLogger(__name__)

READY: Final = "trompe worker ready"
"""The line that a worker prints once it takes jobs."""

STALL_EXIT: Final = 75


def prepare_data(settings: Settings) -> None:
    """Make the data folder and its database, or bring them up to date. Raises ``ServiceError`` where that fails."""
    store = JobStore(settings.database)
    try:
        settings.data.mkdir(parents=True, exist_ok=True)
        store.migrate()
        migrate_engine(settings.database)
    except (OSError, SQLAlchemyError) as error:
        raise ServiceError(
            f"The data folder {settings.data} cannot be written ({error}); choose another with --data or TROMPE_DATA."
        ) from error
    finally:
        store.close()


def run_worker(settings: Settings, renderers: Sequence[Address], *, announce: Callable[[str], None]) -> None:
    """Work until SIGTERM or SIGINT, with the renderer workers at ``renderers``, which share each job's images.

    ``announce`` is given the line READY once the worker takes jobs.

    Raises ``ServiceError`` where another worker has the data folder.
    """
    prepare_environment()
    prepare_data(settings)
    with exclusive(settings.data / "worker.lock", f"Another worker runs on {settings.data}; one is enough."):
        stop = threading.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: stop.set())
        store = JobStore(settings.database)
        runner = JobRunner(store, _job_opener(settings, renderers))
        DbosWorker(settings.database, runner).start()
        announce(READY)
        _preload(settings.pipeline)
        while not stop.wait(1.0):
            _end_if_stalled(runner, settings.stall_timeout)
        _leave(runner)


def prepare_environment() -> None:
    """Thread counts for the libraries that are imported later (values that are set already stay), and memory."""
    keep_freed_memory()
    os.environ.setdefault("OMP_NUM_THREADS", str(len(os.sched_getaffinity(0))))
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def wait_for_renderer(renderers: Sequence[Address], *, seconds: float) -> None:
    """Return once one of ``renderers`` accepts connections. Raises ``RendererError`` after ``seconds``."""
    deadline = time.monotonic() + seconds
    for host, port in itertools.cycle(renderers):
        try:
            socket.create_connection((host, port), timeout=2.0).close()
            return
        except OSError as error:
            if time.monotonic() > deadline:
                raise RendererError(
                    f"No renderer answers at {host}:{port} ({error}). Start one with: trompe render "
                    f"--host {host} --port {port}; `trompe doctor` says whether this machine can render."
                ) from error
            time.sleep(0.3)


def _job_opener(settings: Settings, renderers: Sequence[Address]) -> Callable[[Job], OpenedJob]:
    library = Library(settings.library)

    def open_job(job: Job) -> OpenedJob:
        wait_for_renderer(renderers, seconds=settings.renderer_patience)
        from trompe_server.target import RendererPool, SailenvTarget

        target = SailenvTarget(*renderers[0]) if len(renderers) == 1 else RendererPool(renderers)
        try:
            artifacts = LocalArtifacts(settings.artifacts(job.id))
            pipeline = _named(settings.pipeline)(
                job.spec, library=library, artifacts=artifacts, target=target, device=settings.device
            )
        except BaseException:
            target.close()
            raise
        return OpenedJob(pipeline, target.close)

    return open_job


def _named(path: str) -> Any:
    """What ``module:name`` names. Imported late: it brings torch."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


def _preload(pipeline: str) -> None:
    """Import torch and all that ahead of the first job. Where that fails, each job says so."""
    try:
        _named(pipeline)
    except Exception:
        logger.exception("%s cannot be imported; every job will fail", pipeline)


def _end_if_stalled(runner: JobRunner, timeout: float) -> None:
    """End this process when its job stands still: the job counts as lost, and goes on in the next worker."""
    if runner.current is not None and time.monotonic() - runner.touched > timeout:
        logger.error(
            "job %s made no progress for %.0f s; its worker ends and is started again", runner.current, timeout
        )
        os._exit(STALL_EXIT)


def _leave(runner: JobRunner) -> None:
    """Stop in good order: the running job goes back without harm, its phase is run again by the next worker.

    The phase itself cannot be interrupted, so the process ends without waiting for its thread.
    """
    if runner.current is not None:
        runner.store.give_back(runner.current)
    logging.shutdown()
    os._exit(0)
