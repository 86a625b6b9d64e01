"""``trompe serve`` as a real process, for every test that needs one."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, Self

import httpx

from trompe_server.queue.store import JobStore
from trompe_server.settings import Settings
from trompe_shared.api import Job, JobRequest

CHILD: Final = [sys.executable, "-m", "trompe_shared.child"]
FAKE: Final = {
    "TROMPE_PIPELINE": "tests.fake_job:open_job",
    "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]),
}
"""Environment in which workers run fake jobs."""


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
        return port


@contextmanager
def reserved_port() -> Iterator[int]:
    """A port at which nobody listens, and which within the block nobody gets who does not ask for it by its number."""
    with socket.socket() as bound:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do, so that one may listen there
        bound.bind(("127.0.0.1", 0))
        yield bound.getsockname()[1]


@contextmanager
def answering_once(answer: Callable[[socket.socket], None]) -> Iterator[tuple[str, int]]:
    """A server whose one connection is handled by ``answer`` in a thread."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                answer(connection)

        thread = threading.Thread(target=serve)
        thread.start()
        yield listener.getsockname()[:2]
        thread.join(timeout=240)


def saying(data: bytes) -> Callable[[socket.socket], None]:
    """Answers the first bytes with ``data``."""

    def answer(connection: socket.socket) -> None:
        connection.recv(4096)
        connection.sendall(data)

    return answer


def wait_until(
    condition: Callable[[], Any], *, seconds: float = 120.0, pause: float = 0.02, story: Callable[[], str] = str
) -> Any:
    """Wait for ``condition``, checked every ``pause`` seconds; return its value. Fails after ``seconds``."""
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < deadline, f"timeout after {seconds:.0f} s\n{story()}"
        time.sleep(pause)
    return value


@contextmanager
def repeating(action: Callable[[], None], *, pause: float) -> Iterator[None]:
    """Do ``action`` in a thread every ``pause`` seconds during the block."""
    stop = threading.Event()

    def repeat() -> None:
        while not stop.wait(pause):
            action()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


class Queue:
    """The API's side of a queue of fake jobs: their record and their folders."""

    def __init__(self, settings: Settings) -> None:
        self.settings, self.store = settings, JobStore(settings.database_url)

    def submit(self, label: str, **options: Any) -> str:
        """Queue a fake job, whose label the API would refuse. Returns its id."""
        return self.store.create(JobRequest.of("mug", label=label, **options))[0].id

    def state(self, job: str) -> Job:
        return self.store.get(job)

    def in_gate(self, job: str) -> bool:
        found = self.store.get(job)
        return found.state == "running" and found.progress.phase == "attack-001"

    def open_gate(self, job: str) -> None:
        (self.folder(job) / "go").touch()

    def folder(self, job: str) -> Path:
        return Path(self.settings.store_url) / "jobs" / job


class Child:
    """A command of ``trompe`` as a process that ends with its standard input. Its messages go to ``log``."""

    process: "subprocess.Popen[str]"

    def __init__(self, log: Path, environment: Mapping[str, str]) -> None:
        self.log, self._environment = log, os.environ | environment

    def launch(self, *arguments: str) -> str:
        """Start it. Returns the first line that it prints."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        command, pipe = [*CHILD, *arguments], subprocess.PIPE
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, stderr=log, text=True, env=self._environment
            )
        assert self.process.stdout is not None
        return self.process.stdout.readline()

    def words(self) -> str:
        """Its messages so far."""
        return self.log.read_text()

    def end(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Send a signal and return the exit status."""
        self.process.send_signal(number)
        return self.process.wait(120)

    def close(self) -> None:
        """Kill it, if it has not ended, and close its pipes."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()


class Served(Queue, Child):
    """``trompe serve`` on the folder ``data``; a context manager.

    It takes a free port, and the same one after a restart.
    """

    def __init__(self, data: Path, *options: str, environment: Mapping[str, str] = FAKE) -> None:
        Queue.__init__(self, Settings(data=data))
        Child.__init__(self, data.parent / f"{data.name}.log", environment)
        self.data, self.port, self._options = data, 0, options

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def start(self) -> Self:
        """Start it and wait until it serves."""
        line = self.launch("serve", "--port", str(self.port), "--data", str(self.data), *self._options)
        assert line.startswith("trompe serving on http://127.0.0.1:"), self.words()
        self.port = int(line.rpartition(":")[2])
        self.http = self.client_of()
        return self

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        self.http.close()
        status = self.end(number)
        self.close()
        return status

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *exc_info: object) -> None:
        self.stop()
        self.store.close()

    def client_of(self, secret: str | None = None) -> httpx.Client:
        """An HTTP client, with a token or without."""
        headers = {"Authorization": f"Bearer {secret}"} if secret else {}
        limits = httpx.Limits(max_connections=None)
        return httpx.Client(base_url=self.url, headers=headers, timeout=240, limits=limits, trust_env=False)

    def get(self, path: str) -> Any:
        return self.http.get(path).raise_for_status().json()

    def engines(self) -> list[dict[str, Any]]:
        """Its renderers; none unless all tell their engines, for which a busy one has too little time."""
        found: list[dict[str, Any]] = self.get("/v1/renderers")
        return found if all(each["engine"] for each in found) else []

    def children(self) -> dict[str, int]:
        """Process ids of the children, by command; an attack worker is ``worker``."""
        found = {command_of(pid): pid for pid in descendants(self.process.pid)}
        return {command: pid for command, pid in found.items() if command is not None}


def command_line(pid: int) -> list[str]:
    """Words of a process; none if it has ended."""
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/cmdline").read_text().split("\0")
    return []


def command_of(pid: int) -> str | None:
    """Command of one of our processes; ``worker`` for an attack worker, ``None`` for processes of others."""
    words = command_line(pid)
    if CHILD[-1] in words:
        return words[words.index(CHILD[-1]) + 1]
    forked = any("multiprocessing.forkserver" in word for word in words)
    above = process_table().get(pid) if forked else None
    return "worker" if above and command_line(above) == words else None


def workers_of(service: int) -> list[int]:
    """Ids of the attack workers of a process."""
    return [pid for pid in descendants(service) if command_of(pid) == "worker"]


def descendants(process: int) -> list[int]:
    """Ids of the children of a process, of theirs, and so on."""
    table = process_table()
    return [pid for pid in table if pid != process and process in ancestry(pid, table)]


def process_table() -> dict[int, int]:
    """Parent of each living process."""
    table = {}
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(FileNotFoundError, ProcessLookupError):
            state, parent = (entry / "stat").read_text().rpartition(")")[2].split()[:2]
            if state != "Z":
                table[int(entry.name)] = int(parent)
    return table


def ancestry(pid: int, table: Mapping[int, int]) -> Iterator[int]:
    """A process, its parent, and so on."""
    while pid in table:
        yield pid
        pid = table[pid]
