"""The API while PostgreSQL is away: 503 at once, and nothing lost when it is back."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from tests.served import wait_until
from tests.server.api.conftest import Api, running
from trompe_server.api import following, guard
from trompe_server.settings import Settings
from trompe_server.storage.tokens import Right

JOB = {"object": "mug", "goal": {"label": "mug"}}


@pytest.fixture
def api(postgres: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Api]:
    """The API on a PostgreSQL of its own. Tokens are never older than the request."""
    monkeypatch.setattr(guard, "FRESH", -1.0)
    with running(Settings(data=tmp_path, database=postgres.database())) as api:
        api.headers = api.token("ci", Right.write)
        yield api


def test_a_database_that_stops_is_answered_with_503_until_it_is_back(
    api: Api, postgres: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = Mock(wraps=following._look)
    monkeypatch.setattr(following, "_look", look)
    asyncio.run(_stop_and_start(api, postgres, look))


async def _stop_and_start(api: Api, postgres: Any, look: Mock) -> None:
    async with api.connect() as client:
        job = (await client.post("/v1/jobs", json=JOB)).json()["id"]
        stream = asyncio.create_task(client.get(f"/v1/jobs/{job}/events"))
        await asyncio.to_thread(wait_until, lambda: look.called)
        await asyncio.to_thread(postgres.stop)
        for method, path in [("GET", "/v1/jobs"), ("GET", "/readyz"), ("GET", "/metrics"), ("POST", "/v1/jobs")] * 2:
            answer = await asyncio.wait_for(client.request(method, path, json=JOB), 60)
            assert (answer.status_code, answer.headers["retry-after"]) == (503, "5"), (method, path)
            assert "not available" in answer.text, (method, path)
        assert (await client.get("/healthz")).status_code == 200
        assert not stream.done(), "followers wait until it is back"

        await asyncio.to_thread(postgres.start)
        listed = (await client.get("/v1/jobs")).json()["jobs"]
        assert [each["id"] for each in listed] == [job]
        await client.post(f"/v1/jobs/{job}/cancel")
        text = (await asyncio.wait_for(stream, 120)).text
        assert '"cancelled"' in text
