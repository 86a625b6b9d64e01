"""Logging to standard error, as text or as JSON (TROMPE_LOG=json); every record names the current job."""

import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Final

PLAIN: Final = "%(asctime)s %(levelname)s %(name)s%(about)s: %(message)s"
CHATTY: Final = ("httpx", "PIL", "OpenGL", "botocore", "s3fs", "fsspec")
_STANDARD: Final = set(vars(logging.makeLogRecord({}))) | {"message", "asctime", "job", "about"}

_job: str | None = None


@contextmanager
def about_job(job: str) -> Iterator[None]:
    """Name ``job`` in every record that this process logs in the block, from any thread."""
    global _job
    before, _job = _job, job
    try:
        yield
    finally:
        _job = before


def log_to_stderr() -> None:
    """Log to standard error in the format of TROMPE_LOG."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Json() if os.environ.get("TROMPE_LOG") == "json" else logging.Formatter(PLAIN))
    handler.addFilter(_name_job)
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    for chatty in CHATTY:
        logging.getLogger(chatty).setLevel(logging.WARNING)


def _name_job(record: logging.LogRecord) -> bool:
    job = getattr(record, "job", _job)
    vars(record).update(job=job, about=f" [job {job}]" if job else "")
    return True


class _Json(logging.Formatter):
    """One JSON object per record: time, level, logger, message, process, job and the fields of ``extra``."""

    def format(self, record: logging.LogRecord) -> str:
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            "process": record.process,
            "job": vars(record)["job"],
        }
        line |= {name: value for name, value in vars(record).items() if name not in _STANDARD}
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps({name: value for name, value in line.items() if value is not None}, default=str)
