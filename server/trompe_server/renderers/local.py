"""A renderer worker as a child process, for notebooks, scripts and suites that run without a service."""

import contextlib
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from typing import IO, Final

from trompe_shared.errors import RendererError
from trompe_shared.sailenv_client import SailenvTarget

COMMAND: Final = (sys.executable, "-m", "trompe_shared.child", "render", "--port", "0")
INTERVAL: Final = 0.05
"""Seconds between two looks for the address of a worker that starts."""


@contextlib.contextmanager
def local_renderer(command: Sequence[str] = COMMAND) -> Iterator[SailenvTarget]:
    """Run a renderer worker on a free port; it ends with the block, and with this process.

    command: starts another worker. It must print ``listening on HOST:PORT`` in a line and end when its standard input
    closes.

    Raises ``RendererError`` with the worker's last words if it does not start.
    """
    with (
        tempfile.TemporaryFile() as said,  # a file, not a pipe: an engine may print for each picture
        tempfile.TemporaryFile() as log,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=said, stderr=log) as process,
    ):
        try:
            with contextlib.closing(SailenvTarget(*_address(process, said, log))) as target:
                yield target
        finally:
            process.terminate()


def _address(process: "subprocess.Popen[bytes]", said: IO[bytes], log: IO[bytes]) -> tuple[str, int]:
    """The worker's address, once it has printed it."""
    while True:
        ended = process.poll() is not None
        if ready := re.search(r"listening on ([\d.]+):(\d+)\D", _text(said)):
            return ready[1], int(ready[2])
        if ended:
            *_, words = "`trompe doctor` prints the reason.", *_text(log).strip().splitlines()
            raise RendererError(f"The renderer worker did not start. {words.removeprefix('Error: ')}")
        time.sleep(INTERVAL)


def _text(file: IO[bytes]) -> str:
    """All of a file that another process writes, whose position stays."""
    return os.pread(file.fileno(), os.fstat(file.fileno()).st_size, 0).decode(errors="replace")
