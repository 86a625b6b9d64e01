"""A job's events as a stream: resumed, kept alive, and ended."""

import asyncio
import json
import threading
import time
from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import httpx
import pytest

from tests.served import wait_until
from tests.server.api.conftest import Api
from trompe_server.api import following
from trompe_server.storage.database import DatabaseDownError
from trompe_shared.api import JobState, Progress


def progress(fraction: float) -> dict[str, object]:
    return Progress(phase="attack-000", fraction=fraction).model_dump(mode="json")


def sse(response: httpx.Response) -> list[dict[str, str]]:
    """The events of a stream that has ended."""
    assert response.headers["content-type"].startswith("text/event-stream")
    blocks = [block for block in response.text.replace("\r\n", "\n").split("\n\n") if block and block[0] != ":"]
    return [dict(line.split(": ", 1) for line in block.splitlines()) for block in blocks]


def test_events_are_replayed_from_the_beginning_or_after_the_last_one_seen(stocked: Api) -> None:
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
    for late in ("5", "9" * 5000):
        assert sse(stocked.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": late})) == []


def follow(api: Api, job: str, *, meanwhile: Callable[[], None]) -> httpx.Response:
    """The stream of a job while ``meanwhile`` happens, once it has begun."""
    look, begun = following._look, threading.Event()

    def noticed(*arguments: Any) -> Any:
        found = look(*arguments)
        begun.set()
        return found

    async def both() -> httpx.Response:
        async with api.connect() as client:
            stream = asyncio.create_task(client.get(f"/v1/jobs/{job}/events"))
            assert await asyncio.to_thread(begun.wait, 120)
            await asyncio.to_thread(meanwhile)
            return await asyncio.wait_for(stream, 120)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(following, "_look", noticed)
        return asyncio.run(both())


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(following, "INTERVAL", 0.02)
    monkeypatch.setattr(following, "PATIENCE", 0.05)


def test_a_stream_ends_with_the_event_that_ends_the_job(stocked: Api) -> None:
    job = stocked.job()
    events = sse(follow(stocked, job, meanwhile=lambda: stocked.end(job)))
    assert [json.loads(event["data"])["state"] for event in events] == ["queued", "succeeded"]


def test_a_stream_ends_when_its_job_is_deleted(stocked: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    job = stocked.job()

    def delete() -> None:
        monkeypatch.setattr(stocked.services.store, "events", lambda *_, **__: [])
        stocked.end(job)
        stocked.services.store.delete(job)

    assert [event["id"] for event in sse(follow(stocked, job, meanwhile=delete))] == ["1"]


def test_a_follower_waits_for_a_database_away_for_a_moment(stocked: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    job, away = stocked.job(), Mock(side_effect=DatabaseDownError("The database is away."))

    def lose() -> None:
        with monkeypatch.context() as patch:
            patch.setattr(stocked.services.store, "get", away)
            wait_until(lambda: away.call_count >= 3)
        stocked.end(job)

    events = sse(follow(stocked, job, meanwhile=lose))
    assert [json.loads(event["data"])["state"] for event in events] == ["queued", "succeeded"]


def test_a_connection_in_which_nothing_happens_is_kept_alive(stocked: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(following, "KEEP_ALIVE", 0.05)
    job, app, sent = stocked.job(), stocked.app, list[bytes]()

    async def noting(scope: Any, receive: Any, send: Any) -> None:
        async def note(message: Any) -> None:
            sent.append(message.get("body", b""))
            await send(message)

        await app(scope, receive, note)

    def wait() -> None:
        wait_until(lambda: b"".join(sent).count(b": ping") >= 3)
        stocked.end(job, JobState.cancelled)

    monkeypatch.setattr(stocked, "app", noting)
    assert follow(stocked, job, meanwhile=wait).text.count("\n: ping") >= 3


def test_many_followers_of_waiting_jobs_ask_the_database_seldom(stocked: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    job = stocked.job()
    look = Mock(side_effect=following._look)
    monkeypatch.setattr(following, "_look", look)
    monkeypatch.setattr(following, "PATIENCE", 0.5)

    def wait() -> None:
        time.sleep(0.5)
        stocked.end(job)

    began = time.monotonic()
    follow(stocked, job, meanwhile=wait)
    assert look.call_count <= 8 + (time.monotonic() - began) / following.PATIENCE
