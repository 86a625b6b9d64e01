"""What is sent again, after which pause, and with which key."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.client.conftest import SPEC, FakeServer
from trompe_client import APIError, Client, Retries, ServerFault, ServerUnreachable, TooMany, Unauthorized
from trompe_client._core import error_from


def refusal(status: int, **headers: str) -> APIError:
    return error_from(status, headers, b"", job_id=None)


@given(st.integers(0, 3), st.floats(0, 1), st.sampled_from([429, 502, 503, 504]))
def test_the_pauses_grow_and_are_never_longer_than_the_longest(attempt: int, chance: float, status: int) -> None:
    retries = Retries(limit=4, base=0.5, longest=3.0, random=lambda: chance)
    pause = retries.pause(refusal(status), attempt=attempt)
    assert pause == pytest.approx(chance * min(3.0, 0.5 * 2**attempt))


@pytest.mark.parametrize("status", [400, 401, 403, 404, 409, 413, 422, 500])
def test_what_would_be_refused_again_is_not_sent_again(status: int) -> None:
    assert Retries().pause(refusal(status), attempt=0) is None


def test_after_the_last_attempt_the_error_is_raised(client: Client, server: FakeServer, slept: list[float]) -> None:
    server.refusals = [(503, {})] * 9
    with pytest.raises(ServerFault):
        client.objects()
    assert len(slept) == Retries().limit
    assert len(server.requests) == Retries().limit + 1


@pytest.mark.parametrize("status", [429, 503])
def test_a_pause_that_the_server_asks_for_is_kept(
    client: Client, server: FakeServer, slept: list[float], status: int
) -> None:
    server.refusals = [(status, {"Retry-After": "7"})]
    assert client.objects()
    assert 7 <= slept[0] < 7.25


def test_a_pause_may_be_given_as_a_time_of_day() -> None:
    later = format_datetime(datetime.now(UTC) + timedelta(seconds=3000), usegmt=True)
    assert 2900 < (refusal(503, **{"Retry-After": later}).retry_after or 0) <= 3000
    assert refusal(503, **{"Retry-After": "in a while"}).retry_after is None


def test_a_server_that_wants_to_be_left_alone_for_an_hour_is_not_waited_for(
    client: Client, server: FakeServer, slept: list[float]
) -> None:
    server.refusals = [(429, {"Retry-After": "3600"})]
    with pytest.raises(TooMany) as caught:
        client.objects()
    assert caught.value.retry_after == 3600
    assert slept == []


def test_a_submission_whose_answer_is_lost_makes_one_job(server: FakeServer) -> None:
    lost = iter([True, True])

    def carry(request: httpx.Request) -> httpx.Response:
        response = real.handle_request(request)
        response.read()
        if request.method == "POST" and next(lost, False):
            raise httpx.ReadError("the line is dead", request=request)
        return response

    with httpx.HTTPTransport() as real, Client(server.url, transport=httpx.MockTransport(carry)) as client:
        first, second = client.submit(SPEC), client.submit(SPEC)
    assert next(lost, None) is None
    assert [first.id, second.id] == list(server.jobs) == ["job-1", "job-2"]


def test_a_retry_of_a_job_whose_answer_is_lost_makes_one_job(client: Client, server: FakeServer) -> None:
    job = client.submit(SPEC)
    server.refusals = [(504, {})]
    assert job.retry().id == "job-2"
    keys = {headers["Idempotency-Key"] for _, path, headers in server.requests if path.endswith("/retry")}
    assert len(keys) == 1


def test_nobody_at_the_address_is_tried_some_times_before_it_is_an_error(slept: list[float]) -> None:
    with Client("http://127.0.0.1:9") as client, pytest.raises(ServerUnreachable):
        client.objects()
    assert len(slept) == Retries().limit


def test_a_token_is_shown_to_the_server_and_kept_out_of_sight(
    server: FakeServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.token = "trompe_secret"
    with Client(server.url) as client, pytest.raises(Unauthorized):
        client.objects()
    with Client(server.url, token="trompe_secret") as client:
        assert client.objects()
    monkeypatch.setenv("TROMPE_TOKEN", "trompe_secret")
    monkeypatch.setenv("TROMPE_SERVER", server.url)
    with Client() as client:
        assert client.objects()
        assert "secret" not in repr(vars(client))


@pytest.mark.parametrize(
    ("patience", "send", "wanted"),
    [
        pytest.param(0.5, lambda client, _: client.objects(), [0.5] * 4, id="question"),
        pytest.param(2, lambda client, file: client.upload_classifier(file), [10, 302, 302, 302], id="upload"),
    ],
)
def test_a_server_that_says_nothing_is_given_up_but_may_read_an_upload_for_long(
    server: FakeServer, tmp_path: Path, patience: float, send: Callable[[Client, Path], object], wanted: list[float]
) -> None:
    (tmp_path / "net.onnx").write_bytes(b"much to read")

    def silence(request: httpx.Request) -> httpx.Response:
        assert request.extensions["timeout"] == dict(zip(("connect", "read", "write", "pool"), wanted, strict=True))
        raise httpx.ReadTimeout("nothing", request=request)

    client = Client(server.url, timeout=patience, transport=httpx.MockTransport(silence))
    with client, pytest.raises(ServerUnreachable, match="does not answer"):
        send(client, tmp_path / "net.onnx")


@pytest.mark.usefixtures("slept")
def test_a_vain_attempt_that_took_long_is_told(
    client: Client, server: FakeServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    clock = iter([0.0, 60.0, 60.0, 61.0, 61.0])  # two vain attempts and one more
    monkeypatch.setattr("trompe_client._operations.time", SimpleNamespace(monotonic=lambda: next(clock)))
    server.refusals = [(503, {})] * 2
    assert client.objects()
    assert [record.getMessage().endswith("Trying again.") for record in caplog.records] == [True]
