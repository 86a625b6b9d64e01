"""A service of real, restarted processes, and faults that kill, freeze and stop them."""

import hashlib
import json
import logging
import os
import random
import re
import signal
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from tests.served import CHILD, FAKE, command_line, command_of, descendants, repeating, reserved_port, wait_until
from tests.service.ray_nodes import ACCESS, RayNodes
from trompe_client import Client, Retries
from trompe_client._job import JobHandle
from trompe_server.queue.store import JobStore
from trompe_server.service.dispatch import prepare_data
from trompe_server.settings import Settings
from trompe_shared.api import Event, Job, JobRequest, JobState

logger = logging.getLogger(__name__)

WORKERS: Final = 3
RENDERERS: Final = 3
REAL_EVERY: Final = 12
"""One in this many jobs is a real attack."""
KINDS: Final = {"serve": "API", "dispatcher": "dispatcher", "worker": "attack worker", "render": "renderer worker"}
"""Kinds of processes, by command."""
SHARES: Final = ["API", "dispatcher", *["attack worker"] * WORKERS, *["renderer worker"] * RENDERERS]
RESTART: Final = 0.5
"""Seconds before a dead process is restarted."""

Digests = Mapping[int, Mapping[str, str]]
"""SHA-256 of each artifact without its times, by number of the job."""


def request(number: int) -> JobRequest:
    """The job with this number: most are fake, some are attacks with a checkpoint in the middle."""
    common = {"label": "mug", "seed": number, "labels": {"run": "chaos"}}
    if number % REAL_EVERY != REAL_EVERY // 3:
        return JobRequest.of("mug", **common, steps=1)
    return JobRequest.of("mug", **common, grid=True, azimuths=2, elevations=1, held_out=2, steps=10)


def is_real(number: int) -> bool:
    return request(number).search.steps > 1


class Kept:
    """A process restarted whenever it dies, as by compose. Its output goes to ``log``."""

    def __init__(self, arguments: Sequence[str], environment: Mapping[str, str], log: Path) -> None:
        self._command = [*CHILD, *arguments]
        self._environment, self._log = os.environ | environment, log
        self._stopping = threading.Event()
        self.process: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._supervise, daemon=True)
        self._thread.start()

    def _supervise(self) -> None:
        while not self._stopping.is_set():
            with self._log.open("ab") as log:
                self.process = subprocess.Popen(
                    self._command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=self._environment
                )
            self.process.wait()
            assert self.process.stdin is not None
            self.process.stdin.close()
            self._stopping.wait(RESTART)

    def close(self) -> None:
        self._stopping.set()
        if self.process is not None:
            self.process.terminate()
            try:
                self.process.wait(40)
            except subprocess.TimeoutExpired:
                self.process.kill()
        self._thread.join()


class Site:
    """Three attack workers, three renderer workers and the API on the database at ``url``, all under ``folder``.

    With ``scattered=False``, `trompe serve` has them all. Otherwise API, renderers and two dispatchers, of which one
    waits, share only the database and the store. ``phase_seconds``: length of the phases of fake jobs. With ``nodes``
    the jobs run on that Ray cluster.
    """

    def __init__(
        self,
        folder: Path,
        url: str,
        *,
        scattered: bool,
        silence: float,
        phase_seconds: float,
        nodes: RayNodes | None = None,
    ) -> None:
        self.folder = folder
        self.settings = Settings(data=folder / "api", database=url, store=str(folder / "store"), silence=silence)
        self.nodes = nodes
        self._environment = ACCESS | {
            "TROMPE_EXECUTOR": nodes.address if nodes is not None else "local",
            "TROMPE_DATABASE": self.settings.database_url,
            "TROMPE_STORE": self.settings.store_url,
            "TROMPE_SILENCE": str(silence),
            "TROMPE_RATE_LIMIT": "0",
            "TROMPE_RENDERER_PATIENCE": "120",
            "TROMPE_PIPELINE": "tests.service.chaos_pipeline:open_job",
            "TROMPE_FAKE_SECONDS": str(phase_seconds),
            "PYTHONPATH": FAKE["PYTHONPATH"],
            "OMP_NUM_THREADS": "1",
        }
        prepare_data(self.settings)
        self.store = JobStore(self.settings.database_url, silence=silence)
        self._reserved = ExitStack()
        self.port = self._free_port()
        self._kept = self._scattered() if scattered else [self._serve(workers=WORKERS, renderers=RENDERERS)]

    def _free_port(self) -> int:
        """A port that nobody else gets while its process is started again."""
        return self._reserved.enter_context(reserved_port())

    def _serve(self, *, workers: int, renderers: int) -> Kept:
        numbers = ["--workers", str(workers), "--renderers", str(renderers)]
        return self._keep("api", "serve", "--port", str(self.port), *numbers)

    def _scattered(self) -> list[Kept]:
        ports = [self._free_port() for _ in range(RENDERERS)]
        known = [word for port in ports for word in ("--renderer", f"127.0.0.1:{port}")]
        renderers = [self._keep(f"renderer-{port}", "render", "--port", str(port)) for port in ports]
        many = ["--workers", str(WORKERS)]
        dispatchers = [self._keep(f"dispatcher-{number}", "worker", *many, *known) for number in range(2)]
        return [self._serve(workers=0, renderers=0), *dispatchers, *renderers]

    def _keep(self, name: str, *arguments: str) -> Kept:
        """A process with its own data folder."""
        own = {"TROMPE_DATA": str(self.folder / name)}
        return Kept(arguments, self._environment | own, self.folder / f"{name}.log")

    def client(self) -> Client:
        """A client that retries until the API is back."""
        url = f"http://127.0.0.1:{self.port}"
        return Client(url, timeout=120, retries=Retries(limit=1000, longest=1.0))

    def processes(self) -> dict[str, list[int]]:
        """Ids of our living processes, by kind."""
        roots = {kept.process.pid for kept in self._kept if kept.process is not None}
        roots |= {self.nodes.process.pid} if self.nodes is not None else set()
        found: dict[str, list[int]] = {kind: [] for kind in KINDS.values()}
        for pid in sorted(roots.union(*map(descendants, roots))):
            kind = kind_of(pid)
            if kind is not None:
                found[kind].append(pid)
        return found

    def wait_ready(self) -> None:
        """Wait until the API answers and all attack workers are registered."""
        wait_until(lambda: sum(worker.alive for worker in self.store.workers()) == WORKERS, seconds=180, story=self.log)
        with self.client() as client:
            client.workers()

    def kill_node(self, place: float) -> bool:
        """Kill one of the nodes that run jobs, and start another in its place. Returns whether there was one."""
        if self.nodes is None:
            return False
        self.nodes.kill(self.nodes.nodes[int(place * len(self.nodes.nodes))])
        self.nodes.add()
        return True

    def log(self) -> str:
        """The end of all logs."""
        return "\n".join(f"--- {file.name}\n{file.read_text()[-2500:]}" for file in sorted(self.folder.glob("*.log")))

    def __enter__(self) -> Self:
        try:
            self.wait_ready()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def close(self) -> None:
        with ThreadPoolExecutor(len(self._kept)) as threads:
            list(threads.map(Kept.close, self._kept))
        self.store.close()
        self._reserved.close()


class Faults:
    """Faults injected into the processes of ``site``. ``story`` lists them with times, ``counts`` counts them."""

    def __init__(self, site: Site, *, seed: int) -> None:
        self._site, self._random = site, random.Random(seed)
        self._started = time.monotonic()
        self._told: list[str] = [f"seed {seed}"]
        self.counts: Counter[str] = Counter()

    def tell(self, words: str) -> None:
        self._told.append(f"{time.monotonic() - self._started:7.1f} s  {words}")
        logger.info(self._told[-1])

    def story(self) -> str:
        """All events and the end of all logs."""
        return "\n".join([*self._told, self._site.log()])

    def kill(self) -> None:
        kind = self._random.choice([*SHARES, "node"] if self._site.nodes is not None else SHARES)
        place = self._random.random()
        if kind == "node" and self._site.kill_node(place):
            self.tell(f"killed a node; running: {self._running()}")
            self.counts["node killed"] += 1
            return
        pids = self._site.processes()[kind]
        if not pids:
            self.tell(f"no {kind} to kill")
            return
        pid = pids[int(place * len(pids))]
        self.tell(f"kill -9 {kind} {pid}, of {pids}; running: {self._running()}")
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
            self.counts[f"{kind} killed"] += 1

    def freeze(self, *, seconds: float) -> None:
        """Stop an attack worker for ``seconds``."""
        pids = self._site.processes()["attack worker"]
        if not pids:
            return
        pid = self._random.choice(pids)
        self.tell(f"SIGSTOP attack worker {pid}, of {pids}; running: {self._running()}")
        os.kill(pid, signal.SIGSTOP)
        self.counts["attack worker frozen"] += 1
        try:
            time.sleep(seconds)
        finally:
            self.tell(f"SIGCONT {pid}")
            with suppress(ProcessLookupError):  # it was replaced
                os.kill(pid, signal.SIGCONT)

    def _running(self) -> str:
        try:
            jobs = self._site.store.page(state=JobState.running, limit=20).jobs
        except Exception as error:
            return f"unknown ({type(error).__name__})"
        told = [f"{job.attack.search.seed} ({job.progress.phase}) by {job.worker}" for job in jobs]
        return ", ".join(told) or "nothing"

    def every(self, pause: float, fault: Callable[[], None]) -> AbstractContextManager[None]:
        """Inject ``fault`` every ``pause`` seconds during the block."""

        def inject() -> None:
            try:
                fault()
            except Exception as error:
                self.tell(f"FAILED: {type(error).__name__}: {error}")

        return repeating(inject, pause=pause)


@dataclass(frozen=True)
class Run:
    """Jobs of one run with their events and the digests of their artifacts."""

    jobs: Mapping[int, Job]
    events: Mapping[int, Sequence[Event]]
    digests: Digests


class Submission:
    """Submits jobs in a thread, ``pause`` seconds apart."""

    def __init__(self, site: Site, count: int, *, pause: float) -> None:
        self._site, self._count, self._pause = site, count, pause
        self._ids: list[str] = []
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._submit, daemon=True)
        self._thread.start()

    def _submit(self) -> None:
        try:
            with self._site.client() as client:
                for number in range(self._count):
                    self._ids.append(client.submit(request(number), key=f"chaos/{number}").id)
                    time.sleep(self._pause)
        except BaseException as error:
            self._error = error

    def ended(self) -> int:
        """Number of ended jobs; 0 while the database is away."""
        if self._error is not None:
            raise self._error
        with suppress(Exception):
            counts = self._site.store.counts()
            return sum(counts[state] for state in JobState if state.final)
        return 0

    def wait(self, *, seconds: float, story: Callable[[], str] = str) -> None:
        """Wait until all are submitted and have ended."""
        wait_until(lambda: self.ended() >= self._count, seconds=seconds, story=story)
        self._thread.join()

    def run(self) -> Run:
        """The jobs as reported by the API."""
        with self._site.client() as client:
            handles = list(client.jobs(labels={"run": "chaos"}))
            found = sorted(handle.id for handle in handles)
            assert found == sorted(self._ids), "there are more or fewer than submitted"
            jobs = {handle.status.attack.search.seed: handle.status for handle in handles}
            digests = {handle.status.attack.search.seed: self._digests(handle) for handle in handles}
        events = {number: self._site.store.events(job.id) for number, job in jobs.items()}  # a client stops early
        return Run(jobs, events, digests)

    def _digests(self, handle: JobHandle) -> dict[str, str]:
        files = handle.download(self._site.folder / "downloads" / handle.id)
        return {file.name: hashlib.sha256(without_times(file)).hexdigest() for file in files}


def without_times(file: Path) -> bytes:
    """Bytes of an artifact; of result.json without the seconds."""
    if file.name != "result.json":
        return file.read_bytes()
    result = json.loads(file.read_bytes())
    result.pop("seconds", None)
    return json.dumps(result).encode()


def check_history(job: Job, events: Sequence[Event]) -> str | None:
    """The fault in the history of a job, or ``None``."""
    if [event.id for event in events] != list(range(1, len(events) + 1)):
        return f"its events are numbered {[event.id for event in events]}"
    letters = "".join(_letter(event) for event in events)
    if not re.fullmatch("q+(sr*q+)*sr*f", letters):  # a waiting job is told why it waits
        return f"its states were {[event.state.value for event in events]}"
    if letters.count("s") != job.attempts:
        return f"it was started {letters.count('s')} times in {job.attempts} attempts"
    return None


def _letter(event: Event) -> str:
    """q: queued, s: started, r: running, f: ended."""
    if event.state.final:
        return "f"
    if event.state is JobState.queued:
        return "q"
    return "s" if event.message is not None and event.message.startswith(("started", "continued by")) else "r"


def kind_of(pid: int) -> str | None:
    """Kind of one of our processes; ``None`` for others."""
    with suppress(PermissionError):
        words = command_line(pid)
        if words and re.match(r"ray::[0-9a-f]{16}/", words[0]):
            return KINDS["worker"]
        command = command_of(pid)
        if command == "worker" and CHILD[-1] in words:
            command = "dispatcher"
        return KINDS.get(command or "")
    return None
