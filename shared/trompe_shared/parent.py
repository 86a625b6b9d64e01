"""A process that ends with its parent: it holds the child's standard input open and writes nothing.

When the parent dies, by any signal, the pipe closes and the child ends itself.
"""

import os
import signal
import threading
import time
from typing import Final

GRACE: Final = 5.0
"""Seconds from SIGTERM to a forced exit."""


def end_with_parent() -> None:
    """From now on, end this process when its standard input is closed."""
    threading.Thread(target=_wait_for_the_end, daemon=True).start()


def _wait_for_the_end() -> None:
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE)
    os._exit(1)
