"""The job engine: a small protocol, and DBOS Transact behind it.

DBOS is used through its public calls only. Its traps, and what is done about them: ``application_version`` is a
constant (the default hashes the code, and any edit would strand pending jobs); the serialiser is JSON (the default is
pickle); each job has a priority (one without overtakes all); one executor id belongs to one process (a lock file).
"""

import json
import logging
from pathlib import Path
from typing import Any, Final, Protocol

import sqlalchemy as sa
from dbos import DBOS, DBOSClient, DBOSConfig, EnqueueOptions
from dbos import Serializer as DbosSerializer

from trompe_server.jobs.runner import JobRunner

__all__ = ["DbosQueue", "DbosWorker", "JobQueue", "migrate_engine"]

APPLICATION: Final = "trompe"
VERSION: Final = "1"
EXECUTOR: Final = "embedded"
QUEUE: Final = "attacks"
WORKFLOW: Final = "attack"
NORMAL_PRIORITY: Final = 100
POLLING_INTERVAL: Final = 0.2


class JobQueue(Protocol):
    """Where the API puts jobs and takes them out."""

    def enqueue(self, connection: sa.Connection, job: str) -> None:
        """Queue a job within the transaction of ``connection``."""
        ...

    def forget(self, job: str) -> None:
        """Take a job that was cancelled before it started out of the queue."""
        ...

    def close(self) -> None:
        """Let go of the database."""
        ...


class JsonSerializer(DbosSerializer):
    """Keeps what the engine stores to JSON, so that whoever writes to the database cannot run code in a worker."""

    def serialize(self, data: Any) -> str:
        """``data`` as JSON; an exception is kept as its text."""
        return json.dumps(data, default=repr)

    def deserialize(self, serialized_data: str) -> Any:
        """What ``serialize`` was given."""
        return json.loads(serialized_data)

    def name(self) -> str:
        """The name that is stored beside the data."""
        return "trompe_json"


def migrate_engine(database: Path) -> None:
    """Make or update the engine's tables; before any worker starts."""
    _quiet()
    DBOS.migrate(_url(database))


class DbosQueue:
    """The API's side of DBOS: no workflow code, no threads."""

    def __init__(self, database: Path) -> None:
        _quiet()
        self._client = DBOSClient(
            system_database_url=_url(database), serializer=JsonSerializer(), application_name=APPLICATION
        )

    def enqueue(self, connection: sa.Connection, job: str) -> None:
        """Queue a job within the transaction of ``connection``."""
        options: EnqueueOptions = {
            "workflow_name": WORKFLOW,
            "queue_name": QUEUE,
            "workflow_id": job,
            "app_version": VERSION,
            "priority": NORMAL_PRIORITY,
        }
        self._client.enqueue_in_transaction(connection, options, job)

    def forget(self, job: str) -> None:
        """Take a job that was cancelled before it started out of the queue."""
        self._client.cancel_workflow(job)

    def close(self) -> None:
        """Let go of the database."""
        self._client.destroy()


class DbosWorker:
    """The worker's side of DBOS: takes jobs from the queue, one at a time, and goes on with those cut off."""

    def __init__(self, database: Path, runner: JobRunner) -> None:
        _quiet()
        config: DBOSConfig = {
            "name": APPLICATION,
            "system_database_url": _url(database),
            "application_version": VERSION,
            "executor_id": EXECUTOR,
            "serializer": JsonSerializer(),
            "run_migrations": False,
            "log_level": "WARNING",
            "enable_otlp": False,
        }
        DBOS(config=config)
        DBOS.workflow(name=WORKFLOW, max_recovery_attempts=None)(_workflow(runner))

    def start(self) -> None:
        """Begin to take jobs, in threads of the engine."""
        DBOS.launch()
        DBOS.register_queue(
            QUEUE, worker_concurrency=1, polling_interval_sec=POLLING_INTERVAL, on_conflict="always_update"
        )


def _workflow(runner: JobRunner) -> Any:
    def attack(job: str) -> str:
        return runner.run(job, lambda name, phase: DBOS.run_step({"name": name}, phase))

    return attack


class _NoCancelTraceback(logging.Filter):
    """Drops what DBOS logs as an error when a job is cancelled: it is none."""

    def filter(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        return "Cancelled" not in type(error).__name__ and "was cancelled" not in record.getMessage()


def _quiet() -> None:
    log = logging.getLogger("dbos")
    log.setLevel(logging.WARNING)
    if not any(isinstance(known, _NoCancelTraceback) for known in log.filters):
        log.addFilter(_NoCancelTraceback())


def _url(database: Path) -> str:
    return f"sqlite:///{database}"
