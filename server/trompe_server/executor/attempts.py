"""Attempts of jobs in this process, one after the other."""

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from trompe_server.executor.opener import JobOpener, load
from trompe_server.executor.runner import CountWork, JobRunner
from trompe_server.queue.claims import Claim, Claims
from trompe_server.queue.leases import DISPATCHER, lease_holder, shares_store
from trompe_server.queue.store import JobStore
from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.settings import Settings
from trompe_server.storage.database import DatabaseDownError, connect
from trompe_server.storage.folders import open_folder
from trompe_server.system.log import about_job, log_to_stderr
from trompe_server.system.memory import keep_freed_memory
from trompe_server.system.threads import prepare_threads
from trompe_shared.addresses import without_password
from trompe_shared.errors import TrompeError

logger = logging.getLogger(__name__)


class Attempts:
    """Runs attempts with ``settings`` and ``renderers``. ``count_work`` takes what each finished phase did."""

    def __init__(self, settings: Settings, renderers: RendererAddresses, count_work: CountWork) -> None:
        log_to_stderr()
        prepare(settings.pipeline)
        opener = JobOpener(settings, open_folder(settings.store_url), renderers)
        self._claims = Claims(JobStore(settings.database_url).engine)
        self._runner = JobRunner(self._claims, opener.open, opener.tidy, count_work)
        self._interval = settings.silence / 4

    def run(self, claim: Claim) -> str | None:
        """Run an attempt. Returns why it was lost, or ``None`` if the record has its end."""
        try:
            with about_job(claim.job.id), self._heartbeats(claim):
                self._runner.run(claim)
        except Exception as error:
            logger.exception("attempt %d of job %s was lost", claim.attempt, claim.job.id)
            return f"{type(error).__name__}: {error}"
        return None

    @contextmanager
    def _heartbeats(self, claim: Claim) -> Iterator[None]:
        """Tell the record periodically that this process is not frozen."""
        over = threading.Event()

        def beat() -> None:
            while True:
                with suppress(DatabaseDownError):
                    self._claims.beat(claim)
                if over.wait(self._interval):
                    return

        threading.Thread(target=beat, daemon=True).start()
        try:
            yield
        finally:
            over.set()


def prepare(pipeline: str) -> None:
    """Prepare this process for attempts, and import torch before the first one. If that fails, each job reports it."""
    keep_freed_memory()
    prepare_threads()
    try:
        load(pipeline)
    except Exception:
        logger.exception("%s cannot be imported; every job will fail", pipeline)


def fault_here(settings: Settings, mark: str) -> str | None:
    """What this machine lacks of a shared service: the database or the store of the dispatcher ``mark``."""
    try:
        settings.data.mkdir(parents=True, exist_ok=True)
        if not _is_dispatcher(settings, mark):
            place = connect(settings.database_url).url.render_as_string(hide_password=True)
            return f"it sees another database at {place}; all nodes must reach the same one (PostgreSQL)"
        if not shares_store(open_folder(settings.store_url), mark):
            url = without_password(settings.store_url)
            return f"it does not see the store {url}; mount it there, or use an object store"
    except (OSError, TrompeError) as error:
        return f"it cannot use the database or the store ({error})"
    return None


def _is_dispatcher(settings: Settings, mark: str) -> bool:
    engine = connect(settings.database_url)
    file = engine.url.database if engine.dialect.name == "sqlite" else None
    try:
        return (file is None or Path(file).exists()) and lease_holder(engine, DISPATCHER) == mark
    finally:
        engine.dispose()
