"""``trompe worker`` as a real process with fake jobs, and the API's side of its queue."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from typing import Final, Self

from tests.served import FAKE, Child, Queue, wait_until
from trompe_server.queue.leases import DISPATCHER, end_lease, lease_holder
from trompe_server.service.dispatch import prepare_data
from trompe_server.settings import Settings
from trompe_server.storage.folders import JobArtifacts, job_artifacts, open_folder
from trompe_shared.api import Job
from trompe_shared.sailenv import COMMANDS, LIGHT_NOT_FOUND, REGISTER

REGISTER_BYTES: Final = len(REGISTER.encode_request(width=1, height=1, gzip=False))


@contextmanager
def listening() -> Iterator[int]:
    """A port with a SAILenv renderer that answers the handshake alone: renderer enough for fake jobs."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=_greet, args=(server,), daemon=True)
        thread.start()
        yield server.getsockname()[1]
        server.shutdown(socket.SHUT_RDWR)
        thread.join()


def _greet(server: socket.socket) -> None:
    with suppress(OSError):
        while True:
            connection, _ = server.accept()
            with connection, connection.makefile("rb") as stream, suppress(OSError):
                if stream.read(REGISTER_BYTES):
                    connection.sendall(REGISTER.encode_reply(0, []))
                if stream.read(1):
                    connection.sendall(COMMANDS["get_light_type"].encode_reply(LIGHT_NOT_FOUND))


class WorkerProcess(Child):
    def __init__(self, settings: Settings, renderers: list[str], **environment: str) -> None:
        own = {
            "TROMPE_DATA": str(settings.data),
            "TROMPE_DATABASE": settings.database_url,
            "TROMPE_STORE": settings.store_url,
            "TROMPE_SILENCE": str(settings.silence),
        }
        super().__init__(settings.data / f"worker-{time.monotonic_ns()}.log", FAKE | own | environment)
        self._renderers = renderers

    def start(self) -> Self:
        line = self.launch("worker", *self._renderers)
        assert line == "trompe worker ready\n", self.words()
        return self


class Service(Queue):
    """A queue with workers on demand."""

    def __init__(self, settings: Settings, renderer: int) -> None:
        prepare_data(settings)
        super().__init__(settings)
        self.renderer = renderer

    @contextmanager
    def worker(self, *, renderers: list[str] | None = None, **environment: str) -> Iterator[WorkerProcess]:
        words = renderers or ["--renderer", f"127.0.0.1:{self.renderer}"]
        with closing(WorkerProcess(self.settings, words, **environment)) as running:
            yield running.start()

    def end_silence(self) -> None:
        """Let the lease of a dead or frozen dispatcher be over now, not after its silence."""
        holder = lease_holder(self.store.engine, DISPATCHER)
        if holder is not None:
            end_lease(self.store.engine, DISPATCHER, holder=holder)

    def ended(self, job: str) -> Job:
        wait_until(lambda: self.state(job).state.final)
        return self.state(job)

    def artifacts(self, job: str) -> JobArtifacts:
        return job_artifacts(open_folder(self.settings.store_url), job)
