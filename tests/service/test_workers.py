"""Real worker processes on real databases, with fake jobs: what happens to jobs when things go wrong."""

import json
import os
import re
import signal
import time
from pathlib import Path
from typing import Any

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.fake_job import PHASES, trace
from tests.served import Served, reserved_port, wait_until, workers_of
from tests.service.processes import Service
from trompe_server.settings import Settings
from trompe_server.storage.folders import LocalArtifacts
from trompe_shared.api import JobState


def test_jobs_run_one_after_the_other_each_as_its_pipeline_says_and_the_worker_ends_with_its_parent(
    service: Service,
) -> None:
    labels = ["fine", "hopeless", "broken", "bug", "no object", "flaky renderer"]
    jobs = {label: service.submit(label) for label in labels}
    with service.worker(TROMPE_LOG="json") as running:
        ended = {label: service.ended(job) for label, job in jobs.items()}
        lines = [json.loads(line) for line in running.words().splitlines() if line.startswith("{")]
        assert running.process.stdin is not None
        running.process.stdin.close()
        assert running.process.wait(120) == 0

    assert {label: job.state for label, job in ended.items()} == {
        "fine": JobState.succeeded,
        "hopeless": JobState.not_applicable,
        "broken": JobState.failed,
        "bug": JobState.failed,
        "no object": JobState.failed,
        "flaky renderer": JobState.succeeded,
    }
    assert ended["fine"].artifacts == ["result.json", "judge.txt"]
    left = LocalArtifacts(service.folder(jobs["fine"]) / "1")
    wait_until(lambda: left.names() == ["judge.txt", "result.json"])
    assert ended["fine"].progress.fraction == 1.0
    assert ended["hopeless"].note == "no view was recognised"
    assert ended["broken"].error == "The object is broken; mend it."
    assert ended["bug"].error == "An unexpected error ended the job: ZeroDivisionError: a mistake of ours"
    assert ended["no object"].error == "The object went away."
    assert all(job.attempts == 1 for job in ended.values())
    starts = [started for label in labels if (started := ended[label].started)]
    assert starts == sorted(starts)
    assert len(starts) == len(labels)
    (told,) = [line for line in lines if line["level"] == "error" and line["job"] == jobs["bug"]]
    assert told["message"] == f"job {jobs['bug']} failed"
    assert "ZeroDivisionError" in told["traceback"]
    assert all({"time", "level", "logger", "message", "process"} <= line.keys() for line in lines)
    for label in ("broken", "bug"):
        assert trace(service.folder(jobs[label])).count("begin attack-001") == 1, "failing phases are not tried again"


def test_a_second_dispatcher_waits_and_takes_over_the_job_of_a_killed_one_at_its_last_phase(service: Service) -> None:
    job, after = service.submit("gate"), service.submit("fine")
    with service.worker() as first:
        wait_until(lambda: service.in_gate(job))
        with service.worker() as second:
            assert [(info.alive, info.jobs) for info in service.store.workers()] == [(True, [job])]
            assert "dispatches the jobs" not in second.words()
            first.end(signal.SIGKILL)
            assert service.state(job).state is JobState.running
            wait_until(lambda: service.state(job).attempts == 2)
            assert "dispatches the jobs" in second.words()
            service.open_gate(job)
            found = service.ended(job)
            service.ended(after)

    assert (found.state, found.attempts) == (JobState.succeeded, 2)
    notes = trace(service.folder(job))
    assert [note for note in notes if note.startswith("end")] == [f"end {phase}" for phase in PHASES]
    assert notes.count("begin prepare") == notes.count("begin attack-000") == 1
    assert notes.count("begin attack-001") == 2
    messages = [event.message for event in service.store.events(job) if event.message]
    assert [message.split(" ")[0] for message in messages[:2]] == ["queued", "started"]
    assert messages[2] == "its worker or dispatcher died"
    assert "continued by" in messages[3]


def test_a_dispatcher_that_was_frozen_leaves_the_jobs_to_the_next_and_waits(service: Service) -> None:
    job = service.submit("gate")
    with service.worker() as frozen:
        wait_until(lambda: service.in_gate(job))
        frozen.process.send_signal(signal.SIGSTOP)
        service.end_silence()
        with service.worker() as healthy:
            wait_until(lambda: service.state(job).attempts == 2)
            wait_until(lambda: "was lost" in frozen.words())  # its process was not frozen
            frozen.process.send_signal(signal.SIGCONT)
            service.open_gate(job)
            found = service.ended(job)
            assert "was lost" not in healthy.words()
            assert healthy.end(signal.SIGTERM) == 0
            after = service.submit("fine")
            assert service.ended(after).state is JobState.succeeded, "the one that was frozen goes on working"
        assert "Traceback" not in frozen.words()
    assert (found.state, found.attempts) == (JobState.succeeded, 2)
    assert trace(service.folder(job)).count("end judge") == 1


def test_a_frozen_process_loses_its_job_and_never_replaces_what_a_newer_attempt_wrote(service: Service) -> None:
    job = service.submit("gate")
    with service.worker() as alone:
        wait_until(lambda: service.in_gate(job))
        alone.process.send_signal(signal.SIGSTOP)
        for pid in workers_of(alone.process.pid):
            os.kill(pid, signal.SIGSTOP)
        service.end_silence()
        with service.worker():
            wait_until(lambda: service.state(job).attempts == 2)
            service.open_gate(job)
            service.ended(job)
            result = service.artifacts(job).read("result.json")
            for pid in workers_of(alone.process.pid):
                os.kill(pid, signal.SIGCONT)  # it sees the gate open, and writes attack-001.txt of the first attempt
            wait_until(lambda: "was lost" in alone.words())
            wait_until(lambda: LocalArtifacts(service.folder(job) / "1").names() == [])
            alone.process.send_signal(signal.SIGCONT)
    assert service.artifacts(job).read("result.json") == result
    assert service.state(job).state is JobState.succeeded


def test_cancelling_stops_a_running_job_within_its_phase_and_a_queued_one_at_once(service: Service) -> None:
    running, queued, after = service.submit("gate"), service.submit("fine"), service.submit("fine")
    with service.worker(renderers=["--renderers-dns", f"localhost:{service.renderer}"]) as process:
        wait_until(lambda: service.in_gate(running))
        assert service.store.request_cancel(queued).state is JobState.cancelled
        assert service.store.request_cancel(running).state is JobState.running
        assert service.ended(running).state is JobState.cancelled  # its gate is closed: the phase would never end
        assert service.ended(after).state is JobState.succeeded, "its renderer is found by a name"
        words = process.words()

    assert trace(service.folder(queued)) == []
    assert "end attack-001" not in trace(service.folder(running))
    assert "Traceback" not in words


def test_a_job_that_stands_still_three_times_is_failed(service: Service) -> None:
    job = service.submit("silent")
    with service.worker(TROMPE_STALL_TIMEOUT="2"):
        found = service.ended(job)
    assert (found.state, found.attempts) == (JobState.failed, 3)
    assert "no progress for 2 s" in (found.error or "")


def test_a_job_fails_with_a_remedy_where_no_renderer_answers(service: Service) -> None:
    job = service.submit("fine")
    with service.worker(renderers=["--renderer", "127.0.0.1:1"], TROMPE_RENDERER_PATIENCE="0.5"):
        found = service.ended(job)
    assert found.state is JobState.failed
    assert re.search(r"No renderer answers at 127\.0\.0\.1:1.*trompe render", found.error or "", re.DOTALL)


def test_workers_of_a_service_are_counted_together_and_those_elsewhere_serve_their_own(
    tmp_path: Path, renderer: int
) -> None:
    def scraped(url: str) -> dict[str, float]:
        families = text_string_to_metric_families(httpx.get(url, timeout=120).text)
        return {"".join([s.name, *s.labels.values()]): s.value for family in families for s in family.samples}

    with Served(tmp_path / "data") as serve:
        assert scraped(f"{serve.url}/metrics")["trompe_attack_steps_total"] == 0
        done = serve.submit("fine")
        wait_until(lambda: serve.state(done).state.final)
        first = serve.children()["worker"]
        os.kill(first, signal.SIGKILL)
        wait_until(lambda: serve.children().get("worker", first) != first)
        again = serve.submit("fine")
        wait_until(lambda: serve.state(again).state.final)
        wait_until(lambda: scraped(f"{serve.url}/metrics")["trompe_attack_steps_total"] == 20)
        found = scraped(f"{serve.url}/metrics")
    assert found["trompe_target_renders_total"] == 6
    assert {"trompe_phase_seconds_totalattack", "trompe_phase_seconds_totalprepare"} <= found.keys()

    elsewhere = Service(Settings(data=tmp_path / "elsewhere"), renderer)
    job = elsewhere.submit("fine")
    with reserved_port() as port, elsewhere.worker(TROMPE_METRICS_PORT=str(port)):
        elsewhere.ended(job)
        assert scraped(f"http://127.0.0.1:{port}/metrics")["trompe_attack_steps_total"] == 10
    elsewhere.store.close()


class TestOutage:
    """PostgreSQL goes away and comes back."""

    @pytest.fixture
    def service(self, postgres: Any, tmp_path: Any, renderer: int) -> Any:
        service = Service(Settings(data=tmp_path, database=postgres.database(), silence=20.0), renderer)
        yield service
        service.store.close()

    def test_a_job_runs_on_and_ends_when_the_database_is_back(self, service: Service, postgres: Any) -> None:
        job = service.submit("gate")
        with service.worker() as running:
            wait_until(lambda: service.in_gate(job))
            postgres.stop()
            service.open_gate(job)  # so that it wants to write its end while nobody listens
            wait_until(lambda: running.words().count("Retrying") >= 2)
            assert running.process.poll() is None
            postgres.start()
            found = service.ended(job)
            after = service.submit("fine")
            assert service.ended(after).state is JobState.succeeded
        assert (found.state, found.attempts) == (JobState.succeeded, 1)
        assert trace(service.folder(job)).count("end judge") == 1

    def test_a_stop_while_the_database_is_down_does_not_hang(self, service: Service, postgres: Any) -> None:
        job = service.submit("gate")
        with service.worker() as running:
            wait_until(lambda: service.in_gate(job))
            postgres.stop()
            started = time.monotonic()
            assert running.end(signal.SIGTERM) == 0
            assert time.monotonic() - started < 30  # the database is away for longer than that
            postgres.start()
        service.open_gate(job)
        with service.worker():
            assert service.ended(job).attempts == 2
