"""Runs one of the ``trompe`` commands as a child that does not outlive its parent.

``python -m trompe_server.jobs.leash render --port 0``: the child reads its standard input, to which its parent writes
nothing; when the parent dies, by whatever signal, the pipe closes and the child ends itself.
"""

import os
import signal
import sys
import threading
import time
from importlib.metadata import entry_points
from typing import Final

GRACE: Final = 5.0
"""Seconds that the command has to end in good order."""


def _end_with_parent() -> None:
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE)
    os._exit(1)


def main(arguments: list[str]) -> None:
    """Run the command named by the first argument with the others."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    name, *rest = arguments
    command = entry_points(group="trompe.commands")[name].load()
    command.main(rest, prog_name=f"trompe {name}")


if __name__ == "__main__":
    main(sys.argv[1:])
