"""An embedded service for one command: ``trompe serve`` as a child process."""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Final

from trompe_client._errors import EmbeddedServerError, ServerUnreachable, Unauthorized

SERVE: Final = (sys.executable, "-m", "trompe_shared.child", "serve", "--port", "0", "--data")
READY: Final = re.compile(r"^trompe serving on (http://\S+)", re.MULTILINE)
HAS_TOKENS: Final = (
    "The embedded service uses data with tokens (TROMPE_DATA, TROMPE_DATABASE); `trompe token create NAME` makes "
    "another token."
)
ALL_NETWORKS: Final = '["*"]'
"""The service is the user's own: it may load any network by name."""
TAIL_LINES: Final = 20
STOP_SECONDS: Final = 20.0


@contextmanager
def embedded_server(*, command: Sequence[str] = SERVE, start_seconds: float = 180.0) -> Iterator[str]:
    """URL of a service that runs for the block. Its data folder is ``$TROMPE_DATA``, else a temporary one.

    Raises ``EmbeddedServerError`` with the end of its log if it does not start within ``start_seconds``, or dies.
    ``Unauthorized`` raised in the block gets a remedy.
    """
    with tempfile.TemporaryDirectory(prefix="trompe-") as scratch, _signals_unwind():
        log = Path(scratch, "serve.log")
        data = os.environ.get("TROMPE_DATA") or str(Path(scratch, "data"))
        process = _start([*command, data], log)
        try:
            url = _wait_for_url(process, log, start_seconds)
            with _told_of_the_end(process, log):
                yield url
        except ServerUnreachable as error:
            raise EmbeddedServerError(f"The embedded service does not answer.\n{_tail(log)}") from error
        except Unauthorized as error:
            detail = f"{error.problem.detail or ''} {HAS_TOKENS}".strip()
            raise Unauthorized(error.problem.model_copy(update={"detail": detail})) from error
        finally:
            _stop(process)


def _start(command: Sequence[str], log: Path) -> "subprocess.Popen[bytes]":
    """Start the service in its own session, so that Ctrl-C does not reach it and the job can be cancelled first.

    It ends with this process, by its standard input.
    """
    environment = {"TROMPE_NETWORKS": ALL_NETWORKS} | os.environ | {"PYTHONUNBUFFERED": "1"}
    with log.open("wb") as output:
        return subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )


def _wait_for_url(process: "subprocess.Popen[bytes]", log: Path, seconds: float) -> str:
    deadline = time.monotonic() + seconds
    while True:
        ended = process.poll() is not None  # before the log is read, which is then complete
        match = READY.search(log.read_text("utf-8", "replace"))
        if ended:
            raise EmbeddedServerError(f"The embedded service failed to start ({_code(process)}).\n{_tail(log)}")
        if match:
            return match[1]
        if time.monotonic() > deadline:
            raise EmbeddedServerError(f"The embedded service did not start within {seconds:.0f} s.\n{_tail(log)}")
        time.sleep(0.1)


@contextmanager
def _told_of_the_end(process: "subprocess.Popen[bytes]", log: Path) -> Iterator[None]:
    """Raise ``EmbeddedServerError`` in the block as soon as the service ends, whatever it waits for."""

    def look(*_: object) -> None:
        if process.poll() is not None:
            raise EmbeddedServerError(f"The embedded service has ended ({_code(process)}).\n{_tail(log)}")

    with _handled({signal.SIGCHLD: look}):
        look()
        yield


def _code(process: "subprocess.Popen[bytes]") -> str:
    status = process.returncode
    return f"exit code {status}" if status >= 0 else f"by {signal.Signals(-status).name}"


def _stop(process: "subprocess.Popen[bytes]") -> None:
    """Terminate it; after ``STOP_SECONDS`` kill its session."""
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(STOP_SECONDS)
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert process.stdin is not None
    process.stdin.close()


def _tail(log: Path) -> str:
    lines = log.read_text("utf-8", "replace").splitlines()[-TAIL_LINES:]
    return "\n".join(f"  | {line}" for line in lines) or "  | (no output)"


@contextmanager
def _signals_unwind() -> Iterator[None]:
    """Turn SIGTERM and SIGHUP into ``SystemExit``, so that ``finally`` blocks stop the service."""

    def leave(number: int, _frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    with _handled({signal.SIGTERM: leave, signal.SIGHUP: leave}):
        yield


@contextmanager
def _handled(handlers: Mapping[signal.Signals, Callable[[int, FrameType | None], None]]) -> Iterator[None]:
    """Handle signals so within the block."""
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
