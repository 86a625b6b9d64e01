"""Dispatches jobs for a service: in ``trompe serve``, or alone as ``trompe worker``."""

import signal
import tempfile
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import Final

import click
import prometheus_client
from sqlalchemy.exc import SQLAlchemyError

from trompe_server.errors import ServiceError
from trompe_server.executor.dispatcher import Dispatcher, dispatcher_name
from trompe_server.executor.local import LocalExecutor
from trompe_server.executor.metrics import WORK
from trompe_server.executor.port import Executor
from trompe_server.executor.process import Setup
from trompe_server.queue.claims import Claims
from trompe_server.queue.leases import mark_store
from trompe_server.queue.retention import Retention
from trompe_server.queue.store import JobStore
from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.settings import Settings
from trompe_server.storage.database import DatabaseDownError
from trompe_server.storage.folders import open_folder

READY: Final = "trompe worker ready"
"""Line printed by ``trompe worker`` once it dispatches jobs or waits for the lease."""


def prepare_data(settings: Settings) -> None:
    """Create the data folder, and create or upgrade the database. Raises ``ServiceError``."""
    try:
        settings.data.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=settings.data).close()
        with closing(JobStore(settings.database_url)) as store:
            store.migrate()
    except (OSError, SQLAlchemyError, DatabaseDownError) as error:
        raise ServiceError(
            f"The data folder {settings.data} or the database cannot be written ({error}). Choose another folder with "
            "--data or TROMPE_DATA, another database with --database or TROMPE_DATABASE."
        ) from error


def open_executor(settings: Settings, renderers: RendererAddresses, *, mark: str) -> Executor:
    """Start the processes of this machine, or connect to the cluster. ``mark``: name of the dispatcher with the lease.

    Raises ``ServiceError`` if the store or the cluster cannot be used.
    """
    mark_store(open_folder(settings.store_url), mark)
    setup = Setup(settings, renderers)
    if settings.executor == "local":
        return LocalExecutor(setup)
    from trompe_server.executor.ray_cluster import RayExecutor

    return RayExecutor(setup, mark=mark)


@contextmanager
def dispatching(settings: Settings, renderers: RendererAddresses) -> Iterator[Dispatcher]:
    """Dispatch jobs and delete old ones during the block. ``renderers`` share the images of each job."""
    store = JobStore(settings.database_url)
    retention = Retention(store, open_folder(settings.store_url), days=settings.retention_days)
    threading.Thread(target=retention.run_forever, daemon=True).start()
    with dispatcher_name(settings.data) as name:
        dispatcher = Dispatcher(
            Claims(store.engine),
            partial(open_executor, settings, renderers, mark=name),
            name=name,
            silence=settings.silence,
            stall_timeout=settings.stall_timeout,
        )
        with dispatcher.running():
            yield dispatcher


def run_worker(settings: Settings, renderers: RendererAddresses) -> None:
    """Dispatch jobs until SIGTERM or SIGINT. Prints ``READY`` once it does, or waits for the lease.

    Raises ``ServiceError`` if there is nothing to run them.
    """
    if settings.executor == "local" and not settings.workers:
        raise ServiceError("`trompe worker` needs a process to run jobs: --workers 1 or more (TROMPE_WORKERS).")
    prepare_data(settings)
    if settings.metrics_port:
        _serve_metrics(settings)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with dispatching(settings, renderers):
        click.echo(READY)
        stop.wait()


def _serve_metrics(settings: Settings) -> None:
    try:
        prometheus_client.start_http_server(settings.metrics_port, registry=WORK)
    except OSError as error:
        raise ServiceError(
            f"Cannot serve metrics on port {settings.metrics_port} ({error}). Choose another TROMPE_METRICS_PORT."
        ) from error
