"""``trompe serve`` as users start it: real processes, a real renderer, and mostly a pipeline without an attack."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from trompe_server.jobs.fake import PHASES, trace

FAKE = {"TROMPE_PIPELINE": "trompe_server.jobs.fake:open_pipeline"}


def wait_until(condition: Callable[[], Any], *, seconds: float = 60.0) -> Any:
    """What ``condition`` returns once it is true; fails after ``seconds``."""
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)
    return value


class Serve:
    """A running ``trompe serve``."""

    def __init__(self, data: Path, environment: dict[str, str] = FAKE) -> None:
        self.data = data
        with (data.parent / "serve.log").open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "trompe_server.jobs.leash", "serve", "--port", "0", "--data", str(data)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env=os.environ | environment,
            )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("trompe serving on http://127.0.0.1:"), line
        self.client = httpx.Client(base_url=line.split()[-1], timeout=30)

    def get(self, path: str) -> Any:
        return self.client.get(path).raise_for_status().json()

    def submit(self, label: str) -> str:
        """Queue a job past the checks of the API, which know nothing of a fake pipeline's labels."""
        from trompe_server.jobs.store import JobStore
        from trompe_shared.api import JobRequest

        store = JobStore(f"sqlite:///{self.data / 'trompe.sqlite'}")
        job = store.create(JobRequest.model_validate({"object": "mug", "label": label}))[0].id
        store.close()
        return job

    def state(self, job: str) -> str:
        return str(self.get(f"/v1/jobs/{job}")["state"])

    def in_gate(self, job: str) -> bool:
        return bool(self.get(f"/v1/jobs/{job}")["progress"]["phase"] == "attack-001")

    def open_gate(self, job: str) -> None:
        (self.folder(job) / "go").touch()

    def folder(self, job: str) -> Path:
        return self.data / "jobs" / job

    def children(self) -> dict[str, int]:
        """Process ids of the supervised children, by command."""
        found = {}
        for entry in Path("/proc").iterdir():
            if entry.name.isdecimal() and self.process.pid == parent(int(entry.name)):
                words = (entry / "cmdline").read_text().split("\0")
                if "trompe_server.jobs.leash" in words:
                    found[words[words.index("trompe_server.jobs.leash") + 1]] = int(entry.name)
        return found

    def close(self) -> None:
        self.client.close()
        if self.process.poll() is None:
            self.process.terminate()
        self.process.wait(60)
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()


def parent(pid: int) -> int | None:
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    except (FileNotFoundError, ProcessLookupError):
        return None


def gone(pid: int) -> bool:
    """Whether a process has ended (a zombie has)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    running = Serve(tmp_path / "data")
    yield running
    running.close()


def events(serve: Serve, job: str, *, after: int = 0) -> Iterator[dict[str, Any]]:
    """Events of a job as they come in."""
    with serve.client.stream("GET", f"/v1/jobs/{job}/events", headers={"Last-Event-ID": str(after)}) as stream:
        for line in stream.iter_lines():
            if line.startswith("data: "):
                yield json.loads(line.removeprefix("data: "))


def test_a_job_is_followed_live_through_a_lost_connection_and_a_killed_worker(serve: Serve) -> None:
    assert serve.get("/readyz") == {"status": "ready"}
    job = serve.submit("gate")
    seen = []
    for event in events(serve, job):
        seen.append(event)
        if event["progress"]["phase"] == "attack-001":
            break

    os.kill(serve.children()["worker"], signal.SIGKILL)
    wait_until(lambda: serve.get(f"/v1/jobs/{job}")["attempts"] == 2)
    serve.open_gate(job)
    seen += list(events(serve, job, after=seen[-1]["id"]))

    assert [event["id"] for event in seen] == list(range(1, len(seen) + 1))
    assert seen[-1]["state"] == "succeeded"
    assert serve.get(f"/v1/jobs/{job}/result").keys() == {"fake"}
    ends = [note for note in trace(serve.folder(job)) if note.startswith("end")]
    assert ends == [f"end {phase}" for phase in PHASES]


def test_a_job_is_cancelled_over_http(serve: Serve) -> None:
    job = serve.submit("gate")
    wait_until(lambda: serve.in_gate(job))
    asked = time.monotonic()
    assert serve.client.post(f"/v1/jobs/{job}/cancel").json()["state"] == "running"
    wait_until(lambda: serve.state(job) == "cancelled")
    assert time.monotonic() - asked < 5


def test_a_renderer_that_is_killed_comes_back_at_the_same_address(serve: Serve) -> None:
    before = serve.children()
    os.kill(before["render"], signal.SIGKILL)
    wait_until(lambda: serve.client.get("/readyz").status_code == 503)
    wait_until(lambda: serve.client.get("/readyz").status_code == 200)
    after = serve.children()
    assert after["worker"] == before["worker"]
    assert after["render"] != before["render"]
    job = serve.submit("fine")
    wait_until(lambda: serve.state(job) == "succeeded")


def test_a_second_serve_on_the_same_data_is_refused(serve: Serve) -> None:
    command = [sys.executable, "-m", "trompe_server.jobs.leash", "serve", "--port", "0", "--data", str(serve.data)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as second:
        assert second.wait(60) == 1
        assert second.stderr is not None
        assert f"Another `trompe serve` uses the data folder {serve.data}" in second.stderr.read()
    assert serve.get("/readyz") == {"status": "ready"}


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_nothing_is_left_running_when_serve_ends(serve: Serve, number: signal.Signals) -> None:
    job = serve.submit("gate")
    wait_until(lambda: serve.in_gate(job))
    children = serve.children()
    assert set(children) == {"worker", "render"}
    serve.process.send_signal(number)
    status = serve.process.wait(30)
    assert status == (-number if number is signal.SIGKILL else 0)
    wait_until(lambda: all(gone(pid) for pid in children.values()), seconds=20)


def test_jobs_outlive_the_service(serve: Serve) -> None:
    job = serve.submit("gate")
    wait_until(lambda: serve.in_gate(job))
    serve.close()

    again = Serve(serve.data)
    try:
        again.open_gate(job)
        wait_until(lambda: again.state(job) == "succeeded")
        assert again.get("/v1/jobs?state=succeeded")["jobs"][0]["id"] == job
    finally:
        again.close()


def test_an_attack_whose_worker_is_killed_ends_with_the_same_bytes(tmp_path: Path) -> None:
    few = {"pool": 0, "azimuths": 2, "elevations": 2, "held_out": 2, "steps": 60}
    spec = {"object": "mug", "label": "mug", "classifier": "tiny", **few}
    serve = Serve(tmp_path / "data", {})
    try:
        whole, cut = (serve.client.post("/v1/jobs", json=spec).json()["id"] for _ in range(2))
        wait_until(lambda: serve.state(whole) == "succeeded", seconds=120)
        wait_until(lambda: (serve.get(f"/v1/jobs/{cut}")["progress"]["step"] or 0) > 10, seconds=120)
        os.kill(serve.children()["worker"], signal.SIGKILL)
        wait_until(lambda: serve.state(cut) == "succeeded", seconds=120)

        assert [serve.get(f"/v1/jobs/{job}")["attempts"] for job in (whole, cut)] == [1, 2]
        adversarial = [serve.client.get(f"/v1/jobs/{job}/artifacts/adversarial.zip") for job in (whole, cut)]
        assert adversarial[0].raise_for_status().content == adversarial[1].raise_for_status().content
    finally:
        serve.close()


def test_serve_says_so_where_no_renderer_comes_up(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "trompe_server.jobs.leash", "serve", "--port", "0", "--data", str(tmp_path)]
    pipe, environment = subprocess.PIPE, os.environ | {"EGL_DEVICE_ID": "99"}
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment) as serve:
        assert serve.wait(90) == 1
        assert serve.stdout is not None
        assert serve.stderr is not None
        assert serve.stdout.read() == ""
        words = serve.stderr.read()
    assert "No OpenGL context can be created" in words
    assert "The renderer worker does not come up (it died 3 times)" in words
    assert "Traceback" not in words
