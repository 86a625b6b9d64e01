"""Run a ``trompe`` command as a child process that ends with its parent.

``python -m trompe_shared.child render --port 0``: the parent holds the child's standard input open and writes nothing.
When the parent dies, by any signal, the pipe closes and the child ends itself.
"""

import os
import signal
import sys
import threading
import time
from importlib.metadata import entry_points
from typing import Final

from trompe_shared.errors import TrompeError

GRACE: Final = 5.0
"""Seconds from SIGTERM to a forced exit."""


def main(arguments: list[str]) -> None:
    """Run the command named by the first argument with the remaining arguments."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    name, *rest = arguments
    try:
        command = entry_points(group="trompe.commands")[name].load()
    except ModuleNotFoundError as error:
        sys.exit(f"`trompe {name}` needs more packages: pip install 'trompe[server]' ({error})")
    try:
        command.main(rest, prog_name=f"trompe {name}")
    except TrompeError as error:
        sys.exit(f"Error: {error}")


def _end_with_parent() -> None:
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE)
    os._exit(1)


if __name__ == "__main__":  # attack workers import it again
    main(sys.argv[1:])
