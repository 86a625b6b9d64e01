"""A renderer worker of one's own, for suites, benches and scripts that need a target and no service."""

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from trompe_server.target import SailenvTarget
from trompe_shared.errors import RendererError

__all__ = ["running_renderer"]


@contextmanager
def running_renderer(*, field_of_view: float | None = None) -> Iterator[SailenvTarget]:
    """A renderer worker process on a free port, which lasts as long as the block and no longer than this process.

    ``field_of_view``: vertical, degrees, where it shall not be the protocol's.

    Raises ``RendererError`` when it does not start.
    """
    patch = f"import trompe_shared.geometry as g; g.FIELD_OF_VIEW = {field_of_view}; " if field_of_view else ""
    code = f"{patch}from trompe_server.jobs.leash import main; main(['render', '--port', '0'])"
    pipe = subprocess.PIPE  # when its input closes, it ends
    with subprocess.Popen([sys.executable, "-c", code], stdin=pipe, stdout=pipe, text=True) as process:
        try:
            assert process.stdout is not None
            ready = re.search(r"listening on ([\d.]+):(\d+)", process.stdout.readline())
            if ready is None:
                raise RendererError("The renderer worker did not start. `trompe doctor` says what is missing.")
            target = SailenvTarget(ready[1], int(ready[2]))
            yield target
            target.close()
        finally:
            process.terminate()
