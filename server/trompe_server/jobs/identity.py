"""The name of a worker: unique among all processes that share a database, and the same when it is started again.

It is ``<host>-<slot>-<token>``. A slot is a lock file in the worker's data folder: the first that nobody holds. The
token is written into it once, so that machines or containers which share a host name do not share a worker's.
"""

import fcntl
import re
import secrets
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final

from trompe_server.errors import ServiceError

__all__ = ["worker_name"]

SLOTS: Final = 256
_TOKEN: Final = re.compile(r"[0-9a-f]{6}")


@contextmanager
def worker_name(folder: Path) -> Iterator[str]:
    """Hold a name while the block runs; the kernel lets go of it when the process dies, however it dies.

    Raises ``ServiceError`` where all slots of ``folder`` are taken.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for slot in range(SLOTS):
        with (folder / f"worker-{slot}.lock").open("a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield f"{socket.gethostname()}-{slot}-{_token(file)}"
            return
    raise ServiceError(f"{SLOTS} workers run on {folder}; give more of them another folder with --data.")


def _token(file: IO[str]) -> str:
    file.seek(0)
    token = file.read().strip()
    if not _TOKEN.fullmatch(token):
        token = secrets.token_hex(3)
        file.truncate(0)
        file.write(token)
        file.flush()
    return token
