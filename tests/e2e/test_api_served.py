"""The API of a running ``trompe serve``: real sockets, many requests at once, streams, the examples of the docs.

The jobs are fake.
"""

import json
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPConnection
from pathlib import Path
from typing import Any, Self

import httpx
import pytest

from tests.documentation import blocks, readers_environment
from tests.fake_job import PHASES, trace
from tests.served import FAKE, Served, wait_until
from tests.worker_process import memory
from trompe_server.api.guard import FRESH
from trompe_server.service.dispatch import prepare_data
from trompe_server.storage.tokens import Right, Tokens
from trompe_shared.api import JobState, in_parts
from trompe_shared.shipped import shipped_objects

JOB = {"object": "mug", **in_parts({"label": "mug"})}


class Serve(Served):
    """A running ``trompe serve`` with tokens: ``http`` may write, ``reader`` may read."""

    def __init__(self, data: Path) -> None:
        super().__init__(data, environment=FAKE | {"TROMPE_RATE_LIMIT": "0", "TROMPE_LOG": "json"})
        prepare_data(self.settings)
        self.tokens = Tokens(self.store.engine)
        self.secret = self.tokens.create("writer", Right.write)
        self._read_secret = self.tokens.create("reader", Right.read)

    def start(self) -> Self:
        super().start()
        self.http, self.reader = self.client_of(self.secret), self.client_of(self._read_secret)
        return self

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        self.reader.close()
        return super().stop(number)


@pytest.fixture(scope="module")
def serve(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serve]:
    with Serve(tmp_path_factory.mktemp("api") / "data") as running:
        yield running


def test_a_log_in_json_has_the_http_servers_lines_too(serve: Serve) -> None:
    with socket.create_connection(("127.0.0.1", serve.port)) as connection:
        connection.sendall(b"nonsense\r\n\r\n")
        assert connection.recv(100).startswith(b"HTTP/1.1 400")
    wait_until(lambda: "Invalid HTTP request" in serve.words())
    (line,) = (line for line in serve.words().splitlines() if "Invalid HTTP request" in line)
    assert json.loads(line)["logger"] == "uvicorn.error"


def all_ended(serve: Serve) -> bool:
    counts = serve.store.counts()
    return counts[JobState.queued] + counts[JobState.running] == 0


@pytest.mark.thorough
def test_a_thousand_jobs_submitted_at_once_are_all_there_and_none_twice(serve: Serve) -> None:
    """Every tenth request is sent twice with the same key, as by a client that lost the answer."""
    numbers = [*range(1000), *range(0, 1000, 10)]
    start = threading.Barrier(len(numbers))

    def submit(number: int) -> tuple[int, int, str]:
        start.wait(240)
        body = JOB | in_parts({"label": "mug", "seed": number}) | {"labels": {"experiment": "thousand"}}
        # A connection each, as clients have: httpcore may close one that a thread of another request is about to use.
        headers = {"Idempotency-Key": f"thousand {number}", "Connection": "close"}
        answer = serve.http.post("/v1/jobs", json=body, headers=headers)
        return number, answer.status_code, answer.json()["id"]

    with ThreadPoolExecutor(len(numbers)) as pool:
        answers = list(pool.map(submit, numbers))
    assert Counter(status for _, status, _ in answers) == {201: 1000, 200: 100}
    ids = {number: job for number, _, job in answers}
    assert len(set(ids.values())) == 1000

    listed: list[dict[str, Any]] = []
    cursor: str | None = None
    while cursor != "":
        params = {"limit": "500", "label": "experiment:thousand"} | ({"cursor": cursor} if cursor else {})
        page = serve.reader.get("/v1/jobs", params=params).json()
        listed += page["jobs"]
        cursor = page["next_cursor"] or ""
    assert {job["spec"]["search"]["seed"]: job["id"] for job in listed} == ids
    assert len(listed) == 1000
    with ThreadPoolExecutor(4) as pool:
        cancel = [f"/v1/jobs/{job['id']}/cancel" for job in listed[:-20]]
        assert all(answer.is_success for answer in pool.map(serve.http.post, cancel))
    wait_until(lambda: all_ended(serve), seconds=240)
    for job in listed[-20:]:
        folder = serve.settings.data / "jobs" / job["id"]
        assert serve.store.get(job["id"]).state is JobState.succeeded
        assert [note for note in trace(folder) if note.startswith("end")] == [f"end {phase}" for phase in PHASES]


def test_an_idle_connection_outlives_the_time_that_clients_keep_theirs(serve: Serve) -> None:
    """A server that closes first, or after the same 5 s as httpx, loses the request that is sent at that moment."""
    url = httpx.URL(serve.url)
    connection = HTTPConnection(url.host, url.port, timeout=240)

    def answered() -> bool:
        connection.request("GET", "/healthz")
        with connection.getresponse() as response:
            return bool(response.read()) and response.status == 200

    assert answered()
    connection.auto_open = 0  # never a second connection in place of the first
    expiry = httpx.Limits().keepalive_expiry
    assert expiry is not None
    time.sleep(expiry + 2)
    assert answered()
    connection.close()


def test_a_revoked_token_is_worthless_within_moments(serve: Serve) -> None:
    with serve.client_of(serve.tokens.create("guest", Right.read)) as guest:
        time.sleep(FRESH + 0.1)
        assert guest.get("/v1/jobs").status_code == 200
        job = serve.submit("gate")
        with guest.stream("GET", f"/v1/jobs/{job}/events") as stream:
            lines = stream.iter_lines()
            assert next(lines)
            serve.tokens.revoke("guest")
            assert not any("succeeded" in line for line in lines)  # it ends before the job
        assert guest.get("/v1/jobs").status_code == 401
    serve.open_gate(job)
    with serve.reader.stream("GET", f"/v1/jobs/{job}/events") as stream:
        assert any("succeeded" in line for line in stream.iter_lines())


def test_a_large_upload_does_not_fill_the_memory_of_the_server(serve: Serve) -> None:
    """200 MiB that are no classifier: they are refused, and on their way they are in files alone."""

    def parts() -> Iterator[bytes]:
        yield b'--b\r\nContent-Disposition: form-data; name="file"; filename="x.onnx"\r\n\r\n'
        for _ in range(200):
            yield bytes(2**20)
        yield b"\r\n--b--\r\n"

    Path(f"/proc/{serve.process.pid}/clear_refs").write_text("5")  # what was the peak so far is forgotten
    before = memory(serve.process.pid, "VmHWM")
    headers = {"Content-Type": "multipart/form-data; boundary=b"}
    answer = serve.http.post("/v1/classifiers", content=parts(), headers=headers)
    assert answer.status_code == 422, answer.text
    assert memory(serve.process.pid, "VmHWM") - before < 50 * 2**20


@pytest.mark.thorough
def test_the_examples_of_the_documentation_work(serve: Serve, tmp_path: Path) -> None:
    """All blocks of docs/api.md, as one script, in a folder with an object and the server's address and token."""
    for program in ("curl", "jq"):
        if shutil.which(program) is None:
            pytest.skip(f"there is no {program} here; install it: sudo apt-get install {program}")
    codes = [code for _, code in blocks("api.md", "bash")]
    assert len(codes) >= 8
    (tmp_path / "vase.zip").write_bytes(shipped_objects()["bottle"].read())
    own = {"TROMPE_SERVER": serve.url, "TROMPE_TOKEN": serve.secret, "TROMPE_DATA": str(serve.settings.data)}
    environment = readers_environment(**own)
    script = "set -euo pipefail\n" + "\n".join(codes)
    done = subprocess.run(["bash", "-xc", script], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr + done.stdout


def test_streams_end_when_the_server_stops_and_it_stops_at_once(serve: Serve) -> None:
    """The last test here: the server stays stopped."""
    job = serve.submit("gate")
    with serve.reader.stream("GET", f"/v1/jobs/{job}/events") as stream:
        events = stream.iter_lines()
        next(events)
        serve.process.send_signal(signal.SIGTERM)
        rest = list(events)
    assert not any("succeeded" in line for line in rest)
    assert serve.process.wait(120) == 0
    assert "shutdown exceeded" not in serve.log.read_text(), "the server gave up waiting for the stream"
