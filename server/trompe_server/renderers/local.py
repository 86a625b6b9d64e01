"""A renderer worker as a child process, for notebooks, scripts and suites that run without a service."""

import contextlib
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from typing import Final

from trompe_shared.errors import RendererError
from trompe_shared.sailenv_client import SailenvTarget

__all__ = ["local_renderer"]

COMMAND: Final = (sys.executable, "-m", "trompe_server.system.child", "render", "--port", "0")


@contextlib.contextmanager
def local_renderer(command: Sequence[str] = COMMAND) -> Iterator[SailenvTarget]:
    """Run a renderer worker on a free port; it ends with the block, and with this process.

    command: starts another worker. It must print ``listening on HOST:PORT`` as its first line and end when its standard
    input closes.

    Raises ``RendererError`` if the worker does not start.
    """
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        try:
            assert process.stdout is not None
            ready = re.search(r"listening on ([\d.]+):(\d+)", process.stdout.readline())
            if ready is None:
                raise RendererError("The renderer worker did not start; `trompe doctor` prints the reason.")
            with contextlib.closing(SailenvTarget(ready[1], int(ready[2]))) as target:
                yield target
        finally:
            process.terminate()
