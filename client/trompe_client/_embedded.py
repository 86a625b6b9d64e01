"""The service for the time of one command: ``trompe serve`` in a process of its own."""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Final

from trompe_client._errors import EmbeddedServerError, ServerUnreachable, Unauthorized

__all__ = ["embedded_server"]

SERVE: Final = (sys.executable, "-m", "trompe_client.cli", "serve", "--port", "0", "--data")
READY: Final = re.compile(r"^trompe serving on (http://\S+)", re.MULTILINE)
HAS_TOKENS: Final = (
    "The service of this command's own works on data that have tokens (TROMPE_DATA, TROMPE_DATABASE); "
    "`trompe token create NAME` makes another."
)
TAIL_LINES: Final = 20
STOP_SECONDS: Final = 20.0


@contextmanager
def embedded_server(*, command: Sequence[str] = SERVE, start_seconds: float = 180.0) -> Iterator[str]:
    """The URL of a service of our own, up for the time of the block.

    Its data lie in ``$TROMPE_DATA``, else in a temporary folder that goes with it. Raises ``EmbeddedServerError`` with
    the end of its log when it does not come up within ``start_seconds``, or dies. ``Unauthorized`` that is raised in
    the block says that the data have tokens.
    """
    with tempfile.TemporaryDirectory(prefix="trompe-") as scratch, _signals_unwind():
        log = Path(scratch, "serve.log")
        data = os.environ.get("TROMPE_DATA") or str(Path(scratch, "data"))
        process = _start([*command, data], log)
        try:
            yield _wait_for_url(process, log, start_seconds)
        except ServerUnreachable as error:
            raise EmbeddedServerError(f"The embedded service is gone. {error}\n{_tail(log)}") from error
        except Unauthorized as error:
            detail = f"{error.problem.detail or ''} {HAS_TOKENS}".strip()
            raise Unauthorized(error.problem.model_copy(update={"detail": detail})) from error
        finally:
            _stop(process)


def _start(command: Sequence[str], log: Path) -> "subprocess.Popen[bytes]":
    """Start the service in its own session, so that Ctrl-C reaches us alone and we can cancel the job first."""
    environment = dict(os.environ, PYTHONUNBUFFERED="1")
    with log.open("wb") as output:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )


def _wait_for_url(process: "subprocess.Popen[bytes]", log: Path, seconds: float) -> str:
    deadline = time.monotonic() + seconds
    while True:
        status = process.poll()  # before the log is read, so that a dead process's last words are in it
        match = READY.search(log.read_text("utf-8", "replace"))
        if status is not None:
            raise EmbeddedServerError(f"The embedded service ended at its start (exit code {status}).\n{_tail(log)}")
        if match:
            return match[1]
        if time.monotonic() > deadline:
            raise EmbeddedServerError(f"The embedded service did not come up within {seconds:.0f} s.\n{_tail(log)}")
        time.sleep(0.1)


def _stop(process: "subprocess.Popen[bytes]") -> None:
    """Ask it to stop; after ``STOP_SECONDS``, or if it is dead, end what is left of its session."""
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(STOP_SECONDS)
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _tail(log: Path) -> str:
    lines = log.read_text("utf-8", "replace").splitlines()[-TAIL_LINES:]
    return "\n".join(f"  | {line}" for line in lines) or "  | (it said nothing)"


@contextmanager
def _signals_unwind() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the command through its ``finally`` blocks, so that no service is left behind."""

    def leave(number: int, _frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    before = {number: signal.signal(number, leave) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
