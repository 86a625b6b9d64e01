"""A job's events as a stream: resumed, kept alive, and ended."""

import asyncio
import json
import time

import httpx
import pytest

from trompe_server.api import following
from trompe_server.database import DatabaseDownError
from trompe_shared.api import JobState, Progress


def progress(fraction: float) -> dict[str, object]:
    return Progress(phase="attack-000", fraction=fraction).model_dump(mode="json")


def sse(response: httpx.Response) -> list[dict[str, str]]:
    """The events of a stream that has ended."""
    assert response.headers["content-type"].startswith("text/event-stream")
    blocks = [block for block in response.text.replace("\r\n", "\n").split("\n\n") if block and block[0] != ":"]
    return [dict(line.split(": ", 1) for line in block.splitlines()) for block in blocks]


def test_events_are_replayed_from_the_beginning_or_after_the_last_one_seen(stocked):
    job = stocked.job()
    stocked.tell(job, "started", state="running")
    for fraction in (0.25, 0.5):
        stocked.tell(job, None, progress=progress(fraction))
    stocked.tell(job, "well done", state="succeeded")

    events = sse(stocked.get(f"/v1/jobs/{job}/events"))
    assert [event["id"] for event in events] == ["1", "2", "3", "4", "5"]
    assert {event["event"] for event in events} == {"progress"}
    data = [json.loads(event["data"]) for event in events]
    assert [each["state"] for each in data] == ["queued", "running", "running", "running", "succeeded"]
    assert [each["progress"]["fraction"] for each in data] == [0, 0, 0.25, 0.5, 0.5]
    assert data[-1]["message"] == "well done"
    assert sse(stocked.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": "3"})) == events[3:]
    for nonsense in ("x", "-1", "²", ""):
        header = {"Last-Event-ID": nonsense.encode()}
        assert sse(stocked.get(f"/v1/jobs/{job}/events", headers=header)) == events
    for late in ("5", "9" * 40):
        assert sse(stocked.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": late})) == []


def follow(api, job, *, meanwhile) -> list[dict[str, str]]:
    """The events of a job while ``meanwhile`` happens."""

    async def both() -> httpx.Response:
        transport = httpx.ASGITransport(api.app)
        async with httpx.AsyncClient(transport=transport, base_url="http://trompe") as client:
            stream = asyncio.create_task(client.get(f"/v1/jobs/{job}/events"))
            await asyncio.sleep(0.1)
            await asyncio.to_thread(meanwhile)
            return await asyncio.wait_for(stream, 10)

    return sse(asyncio.run(both()))


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(following, "INTERVAL", 0.02)
    monkeypatch.setattr(following, "PATIENCE", 0.05)


def test_a_stream_ends_with_the_event_that_ends_the_job(stocked, quick):
    job = stocked.job()
    events = follow(stocked, job, meanwhile=lambda: stocked.end(job))
    assert [json.loads(event["data"])["state"] for event in events] == ["queued", "succeeded"]


def test_a_stream_ends_when_its_job_is_deleted(stocked, quick, monkeypatch):
    job = stocked.job()

    def delete():
        monkeypatch.setattr(stocked.services.store, "events", lambda *_, **__: [])
        stocked.end(job)
        stocked.services.store.delete(job)

    assert [event["id"] for event in follow(stocked, job, meanwhile=delete)] == ["1"]


def test_a_follower_waits_for_a_database_that_is_away_for_a_moment(stocked, quick, monkeypatch):
    job, store = stocked.job(), stocked.services.store
    get, failures = store.get, []

    def flaky(job):
        if len(failures) < 3:
            failures.append(job)
            raise DatabaseDownError("The database is away.")
        return get(job)

    def lose():
        monkeypatch.setattr(store, "get", flaky)
        time.sleep(0.3)
        monkeypatch.setattr(store, "get", get)
        stocked.end(job)

    events = follow(stocked, job, meanwhile=lose)
    assert [json.loads(event["data"])["state"] for event in events] == ["queued", "succeeded"]
    assert len(failures) == 3


def test_a_connection_in_which_nothing_happens_is_kept_alive(stocked, quick, monkeypatch):
    monkeypatch.setattr(following, "KEEP_ALIVE", 0.05)
    job = stocked.job()

    async def look() -> str:
        transport = httpx.ASGITransport(stocked.app)
        async with httpx.AsyncClient(transport=transport, base_url="http://trompe") as client:
            stream = asyncio.create_task(client.get(f"/v1/jobs/{job}/events"))
            await asyncio.sleep(0.5)
            await asyncio.to_thread(stocked.end, job, JobState.cancelled)
            return (await stream).text

    assert asyncio.run(look()).count("\n: ping") >= 3


def test_many_followers_of_waiting_jobs_ask_the_database_seldom(stocked, monkeypatch):
    job, looks = stocked.job(), []
    look = following._look
    monkeypatch.setattr(following, "_look", lambda *args: looks.append(time.monotonic()) or look(*args))

    def wait():
        time.sleep(2.5)
        stocked.end(job)

    follow(stocked, job, meanwhile=wait)
    assert len(looks) <= 9
