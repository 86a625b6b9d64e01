"""Names of workers, ``<host>-<slot>-<token>``: unique in a database, and the same after a restart.

A slot is a lock file in the worker's data folder. Each holds a random token, so that machines or containers with the
same host name have different workers.
"""

import re
import secrets
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from filelock import FileLock, Timeout

from trompe_server.errors import ServiceError

__all__ = ["worker_name"]

SLOTS: Final = 256
_TOKEN: Final = re.compile(r"[0-9a-f]{6}")


@contextmanager
def worker_name(folder: Path) -> Iterator[str]:
    """Hold a name during the block. The kernel releases it when the process dies.

    Raises ``ServiceError`` if all slots of ``folder`` are taken.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for slot in range(SLOTS):
        lock = FileLock(folder / f"worker-{slot}.lock")
        try:
            lock.acquire(blocking=False)
        except Timeout:
            continue
        with lock:
            yield f"{socket.gethostname()}-{slot}-{_token(folder / f'worker-{slot}.token')}"
        return
    raise ServiceError(f"{SLOTS} workers run on {folder}. Start more of them with another --data folder.")


def _token(file: Path) -> str:
    token = file.read_text().strip() if file.exists() else ""
    if not _TOKEN.fullmatch(token):
        token = secrets.token_hex(3)
        file.write_text(token)
    return token
