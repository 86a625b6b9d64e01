"""What the SDK promises, against a server that drops connections and refuses things."""

import json
import os
import pickle
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import httpx
import pytest

from tests.client.conftest import SPEC, FakeServer
from trompe_client import (
    APIError,
    AsyncClient,
    BadRequest,
    Client,
    ContractError,
    Forbidden,
    JobFailed,
    JobHandle,
    NotFound,
    Retries,
    ServerFault,
    ServerUnreachable,
    TooMany,
    Unauthorized,
    WaitTimeout,
    _core,
)
from trompe_client._port import finish
from trompe_shared.api import JobRequest, JobState, ViewRanges
from trompe_shared.errors import ObjectError, SpecError


def answering(status: int, body: bytes, **headers: str) -> Client:
    """A client whose every request is answered so."""
    transport = httpx.MockTransport(lambda _request: httpx.Response(status, content=body, headers=headers))
    return Client(transport=transport, retries=Retries(limit=0))


def test_files_are_uploaded_and_the_job_names_them_by_id(
    client: Client, server: FakeServer, mug_folder: Path, tmp_path: Path
) -> None:
    victim, member, picture, mask = (tmp_path / name for name in ("net.onnx", "member.pt2", "room.png", "mask.png"))
    for file in (victim, member, picture, mask):
        file.write_bytes(file.name.encode())
    (tmp_path / "classes.json").write_text('["mug", "cup"]')
    files: dict[str, Any] = {"classifier": victim, "judges": [victim], "ensemble": [member], "masks": {"a.png": mask}}
    ranges = {"roll": (-20, 20)}
    job = client.attack(mug_folder, label=0, **files, background=picture, ranges=ranges, materials=["m"])
    spec = job.status.attack
    assert spec.object == server.objects[-1].id
    ids = {one.name: one.id for one in server.classifiers}
    assert spec.victim.classifier == spec.judges.networks[0] == ids["net"]
    assert spec.victim.ensemble == [ids["member"]]
    assert [one.classes for one in server.classifiers[1:]] == [["mug", "cup"]] * 2
    assert server.uploads["objects"][0] == "mug.zip"
    assert {one.name for one in server.backgrounds} == {"room.png", "mask.png"}
    assert spec.views.background == [client.upload_background(picture)]
    assert server.uploads["backgrounds"][:2] == ("room.png", b"room.png")
    assert spec.paint.masks == {"a.png": client.upload_background(mask)}
    assert spec.views.ranges == ViewRanges(roll=(-20, 20))
    assert spec.paint.materials == ["m"]


def test_uploads_can_be_named_and_bring_their_own_class_names(client: Client, mug_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "net.pt2").write_bytes(b"pt2")
    assert client.upload_object(mug_folder, name="cup").name == "cup"
    assert client.upload_classifier(tmp_path / "net.pt2", classes=["a", "b"], name="n").classes == ["a", "b"]
    assert [o.name for o in client.objects()] == ["mug", "cup"]
    assert [c.name for c in client.classifiers()] == ["tiny", "n"]


def test_what_is_wrong_is_found_before_anything_is_sent() -> None:
    for address in ("localhost:8000", "http://", "http://host:port", "http://[::1"):
        with pytest.raises(SpecError, match="http://HOST:PORT"):
            Client(address)
    with pytest.raises(SpecError, match="http://HOST:PORT"):
        Client(8000)  # type: ignore[arg-type]
    for timeout in (None, "60", 0, -1, float("nan"), float("inf")):
        with pytest.raises(SpecError, match="`timeout` must be a positive number"):
            Client(timeout=timeout)  # type: ignore[arg-type]
    with Client("http://127.0.0.1:9") as client:
        with pytest.raises(SpecError, match="a job's id, got ''"):
            client.job("")
        with pytest.raises(SpecError, match="concurrency"):
            list(client.map([{"object": "mug", "label": 0}], concurrency=0))
        with pytest.raises(SpecError, match="epsilon"):
            client.attack("mug", label=0, epsilon=3.0)
        with pytest.raises(ObjectError, match="There is no file"):
            client.upload_object("no-such-thing")
        with pytest.raises(SpecError, match="There is no background picture"):
            client.upload_background("white")


def test_events_come_once_each_and_in_order_over_a_dropped_connection(client: Client, server: FakeServer) -> None:
    server.drops = 1
    job = client.submit(SPEC)
    assert [event.id for event in job.events()] == [1, 2, 3, 4, 5]
    assert server.resumed_after == [None, "2"]


def test_waiting_survives_a_server_that_is_away_for_a_moment(client: Client, server: FakeServer) -> None:
    job = client.submit(SPEC)
    server.drops = 1
    server.refusals = [(503, {})] * 3
    assert job.wait(timeout=20).state is JobState.succeeded
    assert not server.refusals


def test_a_job_without_result_raises_an_error_that_knows_the_job(client: Client, server: FakeServer) -> None:
    server.ending = JobState.failed
    with pytest.raises(JobFailed, match="the renderer said no") as caught:
        client.submit(SPEC).wait(timeout=20)
    assert caught.value.job_id == caught.value.job.id == "job-1"
    assert caught.value.job.state is JobState.failed


def test_waiting_ends_when_the_time_is_up_and_the_job_goes_on(client: Client, server: FakeServer) -> None:
    server.stalls = True
    job = client.submit(SPEC)
    with pytest.raises(WaitTimeout, match="continues"):
        job.wait(timeout=0.1)
    assert client.job(job.id).state is JobState.queued


@pytest.mark.parametrize("timeout", [0, 0.1])
def test_the_end_of_a_wait_tells_the_state_of_then(client: Client, server: FakeServer, timeout: float) -> None:
    server.stalls = True
    job = client.submit(SPEC)
    states = {event.state: event for event in server.history[job.id]}
    server.reach(job.id, states[JobState.running])
    with pytest.raises(WaitTimeout, match="still running; it continues") as late:
        job.wait(timeout=timeout)
    assert late.value.job.state is JobState.running
    server.reach(job.id, states[JobState.succeeded])
    assert job.wait(timeout=0).state is JobState.succeeded


def test_waiting_gives_up_when_the_server_stays_away(server: FakeServer) -> None:
    job = server.add_job(JobRequest.of("mug", label="mug"))
    with Client("http://127.0.0.1:9") as nobody, pytest.raises(ServerUnreachable, match="trompe serve"):
        JobHandle(nobody, job).wait()


@pytest.mark.parametrize("name", ["../evil", "/etc/evil", "a/../../evil"])
def test_a_file_outside_the_folder_is_not_written(
    client: Client, server: FakeServer, tmp_path: Path, name: str
) -> None:
    job = client.submit(SPEC).wait(timeout=20)
    server.jobs[job.id] = job.status.model_copy(update={"artifacts": [name]})
    with pytest.raises(ContractError, match="outside"):
        job.download(tmp_path / "out")
    assert not list(Path(tmp_path).rglob("evil"))


@pytest.mark.parametrize(
    ("status", "error"),
    [
        pytest.param(401, Unauthorized, id="who"),
        pytest.param(403, Forbidden, id="no right"),
        pytest.param(429, TooMany, id="too many"),
        pytest.param(422, BadRequest, id="unprocessable"),
        pytest.param(413, BadRequest, id="too-large"),
        pytest.param(503, ServerFault, id="fault"),
    ],
)
def test_a_problem_document_becomes_a_typed_error(status: int, error: type[APIError]) -> None:
    body = json.dumps({"title": "Wrong", "status": status, "detail": "Look."}).encode()
    with answering(status, body) as client, pytest.raises(error) as caught:
        client.objects()
    assert str(caught.value) == f"Look. {error.remedy}".strip()
    assert caught.value.status == status
    assert ("for example in TROMPE_TOKEN" in str(caught.value)) == (status == 401)
    fields = [{"field": "epsilon", "message": "too large"}, {"field": "tau", "message": "too small"}]
    body = json.dumps({"title": "Wrong", "status": status, "errors": fields}).encode()
    told = r"Wrong\. epsilon: too large\. tau: too small\."
    with answering(status, body) as client, pytest.raises(error, match=told):
        list(client.jobs(state="no state of ours"))


def test_a_token_may_end_with_its_line_and_a_wrong_one_is_told_without_being_shown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    answer = Mock(return_value=httpx.Response(200, content=b"[]"))
    monkeypatch.setenv("TROMPE_TOKEN", "trompe_1\n")
    with Client(transport=httpx.MockTransport(answer)) as client:
        client.objects()
    (request,) = answer.call_args.args
    assert request.headers["Authorization"] == "Bearer trompe_1"
    for wrong in ("trömpe", "trompe\n_2"):
        with pytest.raises(SpecError, match="token has characters") as caught:
            Client(token=wrong)
        assert wrong not in str(caught.value)


def test_an_answer_of_some_other_server_is_quoted() -> None:
    with answering(404, b"<html>nginx") as client, pytest.raises(NotFound, match="<html>nginx"):
        client.objects()
    moved = "HTTP 302, .* redirects to /login; give the server's own address"
    with answering(302, b"", Location="/login") as client, pytest.raises(BadRequest, match=moved):
        client.objects()
    with answering(200, b'[{"id": 3}]') as client, pytest.raises(ContractError, match="same version"):
        client.objects()


def test_errors_come_back_from_other_processes(client: Client, server: FakeServer) -> None:
    job = client.submit(SPEC)
    with pytest.raises(NotFound) as missing:
        client.job("nope")
    for error in (missing.value, JobFailed("why", job=job.status), ServerUnreachable("gone", job_id="j")):
        again = pickle.loads(pickle.dumps(error))
        assert (type(again), str(again), vars(again)) == (type(error), str(error), vars(error))


def test_a_forked_process_opens_connections_of_its_own(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    client.objects()
    inherited = vars(client.port)["_http"]
    client.objects()
    assert vars(client.port)["_http"] is inherited
    monkeypatch.setattr(os, "getpid", lambda: 1)
    assert client.objects()
    assert vars(client.port)["_http"] is not inherited
    inherited.close()


def test_any_number_of_jobs_can_be_waited_for_at_the_same_time(server: FakeServer) -> None:
    with Client(server.url, timeout=2, retries=Retries(limit=0)) as client:
        job = client.submit(SPEC)
        streams = [client.port.open(_core.events(job.id, after=None)) for _ in range(101)]
        for each in streams:
            finish(each.__aenter__())
        assert client.objects()
        for each in streams:
            finish(each.__aexit__(None, None, None))


@pytest.mark.parametrize(
    ("variable", "value", "host"),
    [
        ("ALL_PROXY", "socks5://127.0.0.1:9", "trompe.example"),
        ("ALL_PROXY", "socks://proxy", "trompe.example"),
        ("NO_PROXY", "::1/128", "trompe.example"),
        ("SSL_CERT_FILE", "/no", "trompe.example"),
        ("SSL_CERT_FILE", "/no", "localhost"),
    ],
)
def test_network_settings_that_cannot_be_used_are_told(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str, host: str
) -> None:
    monkeypatch.setenv(variable, value)
    for client in (Client, AsyncClient):
        with pytest.raises(SpecError, match=rf"environment cannot be used \(.+\)\. Correct .*{variable}"):
            client(f"https://{host}")


def test_an_unknown_certificate_is_told_with_its_remedy() -> None:
    refusal = httpx.ConnectError("[SSL: CERTIFICATE_VERIFY_FAILED] certificate verify failed")
    client = Client(transport=httpx.MockTransport(Mock(side_effect=refusal)), retries=Retries(limit=0))
    with client, pytest.raises(ServerUnreachable, match=r"FAILED.*SSL_CERT_FILE"):
        client.objects()


def test_a_proxy_of_the_environment_is_not_asked_for_a_server_on_this_machine(
    server: FakeServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HTTP_PROXY", "http://127.0.0.1:9")
    monkeypatch.delenv("NO_PROXY", raising=False)
    monkeypatch.delenv("no_proxy", raising=False)
    with Client(server.url) as client:
        assert client.objects()
