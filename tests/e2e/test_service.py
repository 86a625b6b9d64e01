"""``trompe serve`` as users start it: real processes, a real renderer, and mostly fake jobs."""

import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.fake_job import PHASES, trace
from tests.served import Child, Served, process_table, wait_until


@pytest.fixture(scope="module")
def serve(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A running ``trompe serve`` whose worker runs fake jobs; each test leaves it whole for the next."""
    with Served(tmp_path_factory.mktemp("serve") / "data") as running:
        yield running


def events(serve: Served, job: str, *, after: int = 0) -> Iterator[dict[str, Any]]:
    """Events of a job as they come in."""
    with serve.http.stream("GET", f"/v1/jobs/{job}/events", headers={"Last-Event-ID": str(after)}) as stream:
        for line in stream.iter_lines():
            if line.startswith("data: "):
                yield json.loads(line.removeprefix("data: "))


def test_a_job_is_followed_live_through_a_lost_connection_and_a_killed_worker(serve: Served) -> None:
    assert serve.get("/readyz") == {"status": "ready"}
    job = serve.submit("gate")
    seen = []
    for event in events(serve, job):
        seen.append(event)
        if event["progress"]["phase"] == "attack-001":
            break

    os.kill(serve.children()["worker"], signal.SIGKILL)
    wait_until(lambda: serve.state(job).attempts == 2)
    serve.open_gate(job)
    seen += list(events(serve, job, after=seen[-1]["id"]))

    assert [event["id"] for event in seen] == list(range(1, len(seen) + 1))
    assert seen[-1]["state"] == "succeeded"
    assert serve.get(f"/v1/jobs/{job}/result").keys() == {"fake"}
    ends = [note for note in trace(serve.folder(job)) if note.startswith("end")]
    assert ends == [f"end {phase}" for phase in PHASES]


def test_a_renderer_that_is_killed_comes_back_at_the_same_address(serve: Served) -> None:
    before = wait_until(lambda: "worker" in (children := serve.children()) and children)
    renderers = wait_until(serve.engines)
    assert before["render"] not in process_table().values()  # serve alone supervises it
    os.kill(before["render"], signal.SIGKILL)
    come_back = {before["render"], None}  # if we are held up, before we look
    wait_until(lambda: serve.http.get("/readyz").status_code == 503 or serve.children().get("render") not in come_back)
    wait_until(lambda: serve.http.get("/readyz").status_code == 200)
    after = serve.children()
    assert after["worker"] == before["worker"]
    assert after["render"] != before["render"]
    assert wait_until(serve.engines) == renderers
    job = serve.submit("fine")
    wait_until(lambda: serve.state(job).state == "succeeded")


def refusal(data: Path, **environment: str) -> str:
    """What a service says that ends instead of serving."""
    with closing(Child(data.with_name("refused.log"), environment)) as serve:
        assert serve.launch("serve", "--port", "0", "--data", str(data)) == ""
        assert serve.process.wait(240) == 1
        return serve.words()


def test_a_second_serve_on_the_same_data_is_refused(serve: Served) -> None:
    assert f"Another `trompe serve` uses the data folder {serve.data}" in refusal(serve.data)
    assert serve.get("/readyz") == {"status": "ready"}


@pytest.mark.parametrize(
    "number",
    [signal.SIGKILL, *(pytest.param(each, marks=pytest.mark.thorough) for each in (signal.SIGTERM, signal.SIGINT))],
)
def test_nothing_is_left_running_when_serve_ends_and_its_job_outlives_it(serve: Served, number: signal.Signals) -> None:
    job = serve.submit("gate")
    wait_until(lambda: serve.in_gate(job))
    children = serve.children()
    assert set(children) == {"worker", "render"}
    assert serve.stop(number) == (-number if number is signal.SIGKILL else 0)
    wait_until(lambda: not process_table().keys() & children.values())
    serve.start()
    serve.open_gate(job)
    wait_until(lambda: serve.state(job).state == "succeeded")
    assert serve.get("/v1/jobs?state=succeeded")["jobs"][0]["id"] == job


def test_told_twice_to_end_it_ends_in_order(tmp_path: Path) -> None:
    with closing(Child(tmp_path / "serve.log", {})) as serve:
        options = ("--workers", "0", "--renderers", "0", "--port", "0", "--data", str(tmp_path / "data"))
        assert "trompe serving" in serve.launch("serve", *options)
        serve.process.send_signal(signal.SIGINT)
        time.sleep(0.05)
        assert serve.end(signal.SIGINT) == 0
        assert "Traceback" not in serve.words()


def test_serve_says_so_where_no_renderer_comes_up(tmp_path: Path) -> None:
    words = refusal(tmp_path / "data", EGL_DEVICE_ID="99")
    assert "No OpenGL context can be created" in words
    assert "The renderer worker does not start (it died 3 times)" in words
    assert "Traceback" not in words
