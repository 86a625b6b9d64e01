"""Whatever goes wrong is told as problem details."""

import errno
import sqlite3
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from tests.server.api.conftest import Api
from tests.small_models import triangle_zip
from trompe_server.errors import ServiceError
from trompe_server.library import Library
from trompe_server.queue.store import JobStore
from trompe_server.storage.database import DatabaseDownError

ERRORS = [
    ("GET", "/nothing", 404),
    ("DELETE", "/v1/jobs", 405),
    ("GET", "/v1/jobs/unknown", 404),
    ("POST", "/v1/jobs/unknown/cancel", 404),
    ("GET", "/v1/jobs/unknown/events", 404),
    ("GET", "/v1/jobs/unknown/artifacts/x", 404),
    ("GET", "/v1/jobs?limit=0", 422),
    ("GET", "/v1/jobs?state=asleep", 422),
    ("GET", "/v1/jobs?stat=running", 422),
    ("GET", "/v1/objects?limit=1", 422),
    ("GET", "/v1/jobs?cursor=x", 422),
    ("GET", "/v1/objects/unknown", 404),
    ("POST", "/v1/objects", 422),
    ("GET", "/v1/classifiers/unknown", 404),
    ("PUT", "/v1/objects/x", 405),
    ("TRACE", "/healthz", 405),
    ("DELETE", "/v1/jobs/unknown", 404),
    ("POST", "/v1/jobs/unknown/retry", 404),
    ("GET", "/v1/jobs/unknown/archive", 404),
    ("GET", "/v1/jobs?label=x", 422),
    ("GET", "/v1/jobs?cursor=" + "9" * 300, 422),
    ("GET", "/v1/experiments/unknown", 404),
    ("GET", "/v1", 404),
]


def test_every_error_is_problem_details(api: Api) -> None:
    for method, path, status in ERRORS:
        told = api.problem(api.request(method, path), status, (method, path))
        assert told["instance"] == path.partition("?")[0]


def test_an_unknown_query_parameter_is_named_with_the_known_ones(api: Api) -> None:
    assert "'stat'; did you mean 'state'?" in api.get("/v1/jobs?limit=1&stat=running").json()["detail"]
    assert "'q'; /v1/jobs takes state, label, object" in api.get("/v1/jobs?q=x").json()["detail"]
    assert "/v1/objects takes none" in api.get("/v1/objects?limit=1").json()["detail"]


ALLOWED = [
    ("/v1/jobs", "GET, POST, HEAD"),
    ("/v1/jobs/x", "GET, DELETE, HEAD"),
    ("/v1/jobs/x/cancel", "POST"),
    ("/login", "GET, POST, HEAD"),
    ("/static/trompe.css", "GET, HEAD"),
]


@pytest.mark.parametrize(("path", "methods"), ALLOWED)
def test_a_refused_method_tells_those_of_all_routes_of_the_path(api: Api, path: str, methods: str) -> None:
    answer = api.request("PUT", path)
    api.problem(answer, 405)
    assert answer.headers["allow"] == methods


def test_a_mistake_of_the_server_is_told_without_its_secrets_and_logged_with_the_id_that_the_client_was_told(
    api: Api, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(JobStore, "page", lambda *_, **__: 1 / 0)
    told = api.problem(api.get("/v1/jobs"), 500)
    assert "division" not in told["detail"]
    assert f"request {told['request_id']} failed" in caplog.text
    assert "ZeroDivisionError" in caplog.text


def test_the_service_is_ready_when_nothing_is_missing(api: Api, missing: list[str]) -> None:
    assert api.get("/healthz").json() == {"status": "ok"}
    assert api.get("/readyz").json() == {"status": "ready"}
    missing.append("the attack worker is not up")
    assert api.problem(api.get("/readyz"), 503)["detail"] == "the attack worker is not up"
    assert api.get("/healthz").status_code == 200
    assert [api.request("HEAD", path).status_code for path in ("/healthz", "/readyz")] == [200, 503]


def test_a_body_that_is_no_json_is_told_apart_from_one_that_is_wrong(api: Api) -> None:
    broken = api.post("/v1/jobs", content=b"{", headers={"Content-Type": "application/json"})
    assert "JSON" in api.problem(broken, 422)["detail"]
    for other in (b"object=mug", b'{"object": "mug", "goal": {"label": "mug"}}'):
        form = api.post("/v1/jobs", content=other, headers={"Content-Type": "application/x-www-form-urlencoded"})
        assert "Content-Type: application/json" in api.problem(form, 422)["detail"]


def test_a_database_that_is_away_is_a_matter_of_seconds_and_no_mistake(
    api: Api, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for error in (DatabaseDownError("It is away."), PoolTimeoutError("QueuePool limit")):
        monkeypatch.setattr(JobStore, "page", Mock(side_effect=error))
        answer = api.get("/v1/jobs")
        assert api.problem(answer, 503)["type"] == "urn:trompe:database-down"
        assert answer.headers["retry-after"] == "5"
    assert "Traceback" not in caplog.text


def test_a_real_database_that_cannot_be_opened_is_answered_with_503_on_every_path(api: Api, tmp_path: Path) -> None:
    api.services.store.close()
    for file in tmp_path.glob("trompe.sqlite*"):
        file.unlink()
    (tmp_path / "trompe.sqlite").mkdir()
    for path in ("/v1/jobs", "/v1/jobs/x", "/v1/workers", "/v1/experiments", "/metrics", "/readyz"):
        assert api.get(path).status_code == 503, path
    assert api.get("/healthz").status_code == 200


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_full_disk_is_named(api: Api, monkeypatch: pytest.MonkeyPatch, wrapped: bool) -> None:
    def full(*_: Any, **__: Any) -> None:
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError as error:
            if wrapped:
                raise ServiceError("There is no space left at /data.") from error
            raise

    monkeypatch.setattr(Library, "add_object", full)
    refusal = api.problem(api.upload_object(triangle_zip()), 507)
    assert refusal["type"] == "urn:trompe:disk-full"
    assert ("/data" in refusal["detail"]) == wrapped


def test_a_disk_that_is_full_while_the_upload_is_spooled_is_named(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    full = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    monkeypatch.setattr("starlette.formparsers.SpooledTemporaryFile", full)
    assert api.problem(api.upload_object(b"x"), 507)["type"] == "urn:trompe:disk-full"


def test_a_database_whose_disk_is_full_is_told_so(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    cause = sqlite3.OperationalError("database or disk is full")
    cause.sqlite_errorcode = sqlite3.SQLITE_FULL
    error = DatabaseDownError("The database cannot be used just now.")
    error.__cause__ = cause
    monkeypatch.setattr(JobStore, "page", Mock(side_effect=error))
    api.problem(api.get("/v1/jobs"), 507)


def test_writes_are_logged_with_request_token_and_job(stocked: Api, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", logger="trompe_server.api.middleware")
    job = stocked.job()
    stocked.headers = stocked.token("ci", "write")
    answer = stocked.post(f"/v1/jobs/{job}/cancel")
    record = caplog.records[-1]
    assert record.getMessage().startswith(f"POST /v1/jobs/{job}/cancel 200 in ")
    told = {name: vars(record)[name] for name in ("request", "token", "job")}
    assert told == {"request": answer.headers["x-request-id"], "token": "ci", "job": job}


def test_failed_reads_are_logged_in_one_line(api: Api, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", logger="trompe_server.api.middleware")
    answer = api.get("/v1/jobs/none%0AINFO")
    record = caplog.records[-1]
    assert record.getMessage().startswith("GET /v1/jobs/none%0AINFO 404 in ")
    assert vars(record)["request"] == answer.headers["x-request-id"]
