"""Whatever goes wrong is told as problem details."""

import errno
import sqlite3

import pytest
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from trompe_server.database import DatabaseDownError
from trompe_server.errors import ServiceError
from trompe_server.jobs.store import JobStore
from trompe_server.library import Library


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/nothing", 404),
        ("DELETE", "/v1/jobs", 405),
        ("GET", "/v1/jobs/unknown", 404),
        ("POST", "/v1/jobs/unknown/cancel", 404),
        ("GET", "/v1/jobs/unknown/events", 404),
        ("GET", "/v1/jobs/unknown/artifacts/x", 404),
        ("GET", "/v1/jobs?limit=0", 422),
        ("GET", "/v1/jobs?state=asleep", 422),
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
    ],
)
def test_every_error_is_problem_details(api, method: str, path: str, status: int):
    assert api.problem(api.request(method, path), status)["instance"] == path.partition("?")[0]


def test_a_mistake_of_the_server_is_problem_details_without_its_secrets(api, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(JobStore, "page", lambda *_, **__: 1 / 0)
    assert "division" not in api.problem(api.get("/v1/jobs"), 500)["detail"]


def test_the_service_is_ready_when_nothing_is_missing(api, missing):
    assert api.get("/healthz").json() == {"status": "ok"}
    assert api.get("/readyz").json() == {"status": "ready"}
    missing.append("the attack worker is not up")
    assert api.problem(api.get("/readyz"), 503)["detail"] == "the attack worker is not up"
    assert api.get("/healthz").status_code == 200


def test_a_body_that_is_no_json_is_told_apart_from_one_that_is_wrong(api):
    broken = api.post("/v1/jobs", content=b"{", headers={"Content-Type": "application/json"})
    assert "JSON" in api.problem(broken, 422)["detail"]
    api.problem(api.post("/v1/jobs", content=b"object=mug"), 422)


def test_a_database_that_is_away_is_a_matter_of_seconds_and_no_mistake(api, monkeypatch, caplog):
    for error in (DatabaseDownError("It is away."), PoolTimeoutError("QueuePool limit")):

        def away(*_, error=error, **__):
            raise error

        monkeypatch.setattr(JobStore, "page", away)
        answer = api.get("/v1/jobs")
        assert api.problem(answer, 503)["type"] == "urn:trompe:database-down"
        assert answer.headers["retry-after"] == "5"
    assert "Traceback" not in caplog.text


def test_a_real_database_that_cannot_be_opened_is_answered_with_503_on_every_path(api, tmp_path):
    api.services.store.close()
    for file in tmp_path.glob("trompe.sqlite*"):
        file.unlink()
    (tmp_path / "trompe.sqlite").mkdir()
    for path in ("/v1/jobs", "/v1/jobs/x", "/v1/workers", "/v1/experiments", "/metrics", "/readyz"):
        assert api.get(path).status_code == 503, path
    assert api.get("/healthz").status_code == 200


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_full_disk_is_named(api, triangle_zip, monkeypatch, wrapped):
    def full(*_, **__):
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


def test_a_disk_that_is_full_while_the_upload_is_spooled_is_named(api, monkeypatch):
    class FullDisk:
        def __init__(self, *_, **__):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("starlette.formparsers.SpooledTemporaryFile", FullDisk)
    assert api.problem(api.upload_object(b"x"), 507)["type"] == "urn:trompe:disk-full"


def test_a_database_whose_disk_is_full_is_told_so(api, monkeypatch):
    def full(*_, **__):
        error = sqlite3.OperationalError("database or disk is full")
        error.sqlite_errorcode = sqlite3.SQLITE_FULL
        raise DatabaseDownError("The database cannot be used just now.") from error

    monkeypatch.setattr(JobStore, "page", full)
    api.problem(api.get("/v1/jobs"), 507)


def test_a_mistake_is_logged_with_the_id_that_the_client_was_told(api, monkeypatch, caplog):
    monkeypatch.setattr(JobStore, "page", lambda *_, **__: 1 / 0)
    told = api.problem(api.get("/v1/jobs"), 500)["request_id"]
    assert f"request {told} failed" in caplog.text
    assert "ZeroDivisionError" in caplog.text


def test_writes_are_logged_with_request_token_and_job(stocked, caplog):
    caplog.set_level("INFO", logger="trompe_server.api.middleware")
    job = stocked.job()
    stocked.headers = stocked.token("ci", "write")
    answer = stocked.post(f"/v1/jobs/{job}/cancel")
    record = caplog.records[-1]
    assert record.getMessage().startswith(f"POST /v1/jobs/{job}/cancel 200 in ")
    assert (record.request, record.token, record.job) == (answer.headers["x-request-id"], "ci", job)
