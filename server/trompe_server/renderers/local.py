"""A renderer worker as a child process, for notebooks, scripts and suites that run without a service."""

import contextlib
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from typing import IO, Final

from trompe_shared.errors import RendererError
from trompe_shared.sailenv_client import SailenvTarget

COMMAND: Final = (sys.executable, "-m", "trompe_server.system.child", "render", "--port", "0")


@contextlib.contextmanager
def local_renderer(command: Sequence[str] = COMMAND) -> Iterator[SailenvTarget]:
    """Run a renderer worker on a free port; it ends with the block, and with this process.

    command: starts another worker. It must print ``listening on HOST:PORT`` in a line and end when its standard input
    closes.

    Raises ``RendererError`` with the worker's last words if it does not start.
    """
    pipe = subprocess.PIPE
    with (
        tempfile.TemporaryFile("w+") as log,
        subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=log, text=True) as process,
    ):
        try:
            assert process.stdout is not None
            lines = (re.search(r"listening on ([\d.]+):(\d+)", line) for line in process.stdout)
            ready = next(filter(None, lines), None)
            if ready is None:
                raise RendererError(f"The renderer worker did not start. {_last_words(process, log)}")
            with contextlib.closing(SailenvTarget(ready[1], int(ready[2]))) as target:
                yield target
        finally:
            process.terminate()


def _last_words(process: "subprocess.Popen[str]", log: IO[str]) -> str:
    """The last line of an ended worker's log."""
    process.wait()
    log.seek(0)
    lines = log.read().strip().splitlines()
    return lines[-1].removeprefix("Error: ") if lines else "`trompe doctor` prints the reason."
