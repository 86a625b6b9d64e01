"""What the SDK promises, against a server that drops connections and refuses things."""

import json
import zipfile
from datetime import UTC, datetime
from pathlib import Path

import httpx
import pytest

from trompe_client import (
    BadRequest,
    Client,
    Conflict,
    ContractError,
    Forbidden,
    JobCancelled,
    JobFailed,
    JobHandle,
    NotFound,
    Retries,
    ServerFault,
    ServerUnreachable,
    TooMany,
    Unauthorized,
    WaitTimeout,
)
from trompe_shared.api import Job, JobSpec, JobState, ViewRanges
from trompe_shared.errors import ObjectError, SpecError

NOW = datetime(2025, 1, 2, tzinfo=UTC)
SPEC = JobSpec(object="mug", label="mug")


def answering(status: int, body: bytes, **headers: str) -> Client:
    """A client whose every request is answered so."""
    transport = httpx.MockTransport(lambda _request: httpx.Response(status, content=body, headers=headers))
    return Client(transport=transport, retries=Retries(limit=0))


def test_an_attack_on_a_stored_object_submits_the_spec_and_waits_for_its_result(client, server):
    job = client.attack("mug", label="mug", epsilon=0.1, elevation=(5.0, 40.0), judges=["tiny"], seed=7)
    assert job.state is JobState.queued
    assert job.status.spec == JobSpec(
        object="mug", label="mug", epsilon=0.1, elevation=(5.0, 40.0), judges=["tiny"], seed=7
    )
    assert job.wait(timeout=20).state is JobState.succeeded
    assert job.result().held_out.views == 17
    assert server.uploads == {}


def test_files_are_uploaded_and_the_job_names_them_by_id(client, server, mug_folder, tmp_path):
    victim, picture = tmp_path / "net.onnx", tmp_path / "room.png"
    victim.write_bytes(b"onnx")
    picture.write_bytes(b"png")
    (tmp_path / "classes.json").write_text('["mug", "cup"]')
    spec = client.attack(mug_folder, label=0, classifier=victim, judges=[victim], background=picture).status.spec
    assert spec.object == server.objects[-1].id
    assert spec.classifier == spec.judges[0] == server.classifiers[-1].id
    assert server.classifiers[-1].classes == ["mug", "cup"]
    assert server.uploads["backgrounds"][:2] == ("room.png", b"png")
    assert server.uploads["objects"][0] == "mug.zip"


def test_ensemble_and_masks_are_uploaded_too_and_ranges_may_be_plain(client, server, tmp_path):
    member, mask = tmp_path / "net.pt", tmp_path / "mask.png"
    member.write_bytes(b"script")
    mask.write_bytes(b"mask")
    ranges = {"roll": (-20, 20)}
    job = client.attack("mug", label=0, ensemble=[member], masks={"a.png": mask}, ranges=ranges, materials=["m"])
    spec = job.status.spec
    assert spec.ensemble == [server.classifiers[-1].id]
    assert server.uploads["backgrounds"][:2] == ("mask.png", b"mask")
    assert spec.masks == {"a.png": client.upload_background(mask)}
    assert spec.ranges == ViewRanges(roll=(-20, 20))
    assert spec.materials == ["m"]


def test_uploads_can_be_named_and_bring_their_own_class_names(client, server, mug_folder, tmp_path):
    (tmp_path / "net.pt2").write_bytes(b"pt2")
    assert client.upload_object(mug_folder, name="cup").name == "cup"
    assert client.upload_classifier(tmp_path / "net.pt2", classes=["a", "b"], name="n").classes == ["a", "b"]
    assert [o.name for o in client.objects()] == ["mug", "cup"]
    assert [c.name for c in client.classifiers()] == ["tiny", "n"]


def test_only_files_can_be_uploaded(client):
    with pytest.raises(ObjectError, match="There is no file"):
        client.upload_object("no-such-thing")
    with pytest.raises(SpecError, match="There is no background picture"):
        client.upload_background("white")


def test_events_come_once_each_and_in_order_over_a_dropped_connection(client, server):
    server.drops = 1
    job = client.submit(SPEC)
    assert [event.id for event in job.events()] == [1, 2, 3, 4, 5]
    assert server.resumed_after == [None, "2"]


def test_waiting_survives_a_server_that_is_away_for_a_moment(client, server):
    job = client.submit(SPEC)
    server.drops = 1
    server.refusals = [(503, {})] * 3
    assert job.wait(timeout=20).state is JobState.succeeded
    assert not server.refusals


def test_a_job_that_was_over_before_it_is_followed_still_tells_its_story(client, server):
    job = client.submit(SPEC)
    job.wait(timeout=20)
    assert [event.id for event in client.job(job.id).events()] == [1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("ending", "error", "words"),
    [
        pytest.param(JobState.failed, JobFailed, "the renderer said no", id="failed"),
        pytest.param(JobState.cancelled, JobCancelled, "was cancelled", id="cancelled"),
    ],
)
def test_a_job_without_result_raises_an_error_that_knows_the_job(client, server, ending, error, words):
    server.ending = ending
    with pytest.raises(error, match=words) as caught:
        client.submit(SPEC).wait(timeout=20)
    assert caught.value.job_id == caught.value.job.id == "job-1"
    assert caught.value.job.state is ending


def test_not_applicable_is_a_result_and_no_error(client, server):
    server.ending = JobState.not_applicable
    job = client.submit(SPEC).wait(timeout=20)
    assert job.result().target.a_drop is None


def test_waiting_ends_when_the_time_is_up_and_the_job_goes_on(client, server):
    server.stalls = True
    job = client.submit(SPEC)
    with pytest.raises(WaitTimeout, match="goes on"):
        job.wait(timeout=0.1)
    assert client.job(job.id).state is JobState.queued


def test_waiting_gives_up_when_the_server_stays_away(server):
    job = Job(id="job-1", state="running", spec=SPEC, created=NOW)
    with Client("http://127.0.0.1:9") as nobody, pytest.raises(ServerUnreachable, match="trompe serve"):
        JobHandle(nobody, job).wait()


def test_cancel_says_how_the_job_stands(client, server):
    job = client.submit(SPEC)
    assert job.cancel().state is job.state is JobState.cancelled


def test_download_writes_every_artifact_whole_and_replaces_older_ones(client, server, tmp_path):
    (tmp_path / "result.json").write_text("old")
    job = client.submit(SPEC).wait(timeout=20)
    paths = job.download(tmp_path)
    assert [path.relative_to(tmp_path).as_posix() for path in paths] == job.status.artifacts
    assert json.loads((tmp_path / "result.json").read_text())["object"] == "mug"
    assert zipfile.ZipFile(tmp_path / "adversarial.zip").namelist() == ["mug.obj", "a.png"]
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("name", ["../evil", "/etc/evil", "a/../../evil"])
def test_a_file_outside_the_folder_is_not_written(client, server, tmp_path, name):
    job = client.submit(SPEC).wait(timeout=20)
    server.jobs[job.id] = job.status.model_copy(update={"artifacts": [name]})
    with pytest.raises(ContractError, match="outside"):
        job.download(tmp_path / "out")
    assert not list(Path(tmp_path).rglob("evil"))


def test_jobs_are_listed_page_after_page_newest_first(client, server):
    ids = [client.submit(SPEC).id for _ in range(5)]
    assert [job.id for job in client.jobs()] == ids[::-1]
    client.job(ids[1]).cancel()
    assert [job.id for job in client.jobs(state="cancelled")] == [ids[1]]


def test_a_refused_request_keeps_request_and_job_id(client):
    with pytest.raises(NotFound, match="No such job") as caught:
        client.job("nope")
    assert (caught.value.status, caught.value.request_id, caught.value.job_id) == (404, "req-7", "nope")


def test_a_result_that_is_not_there_yet_is_a_conflict(client):
    with pytest.raises(Conflict, match="The job is queued"):
        client.submit(SPEC).result()


def test_an_unknown_object_is_refused_by_the_server(client):
    with pytest.raises(NotFound, match="'muggg' is not stored"):
        client.attack("muggg", label=0)


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
def test_a_problem_document_becomes_a_typed_error(status, error):
    body = json.dumps({"title": "Wrong", "status": status, "detail": "Look."}).encode()
    with answering(status, body) as client, pytest.raises(error) as caught:
        client.objects()
    assert str(caught.value) == f"Wrong. Look. {error.remedy}".strip()
    assert caught.value.status == status
    fields = [{"field": "epsilon", "message": "too large"}, {"field": "tau", "message": "too small"}]
    body = json.dumps({"title": "Wrong", "status": status, "errors": fields}).encode()
    with (
        answering(status, body) as client,
        pytest.raises(error, match=r"Wrong\. epsilon: too large\. tau: too small\."),
    ):
        client.objects()


def test_who_lacks_a_token_is_told_how_to_give_one():
    body = json.dumps({"title": "Unauthorized", "status": 401, "detail": "This needs a token."}).encode()
    with answering(401, body) as client, pytest.raises(Unauthorized, match=r"a token\. Give a token by TROMPE_TOKEN"):
        client.objects()


def test_an_answer_of_some_other_server_is_quoted():
    with answering(404, b"<html>nginx") as client, pytest.raises(NotFound, match="<html>nginx"):
        client.objects()
    with answering(302, b"", Location="/login") as client, pytest.raises(BadRequest, match="HTTP 302"):
        client.objects()
    with answering(200, b'[{"id": 3}]') as client, pytest.raises(ContractError, match="same version"):
        client.objects()


def test_when_nothing_listens_the_error_says_how_to_start_a_server():
    with Client("http://127.0.0.1:9") as client, pytest.raises(ServerUnreachable, match="trompe serve"):
        client.objects()


def test_a_proxy_of_the_environment_is_not_asked_for_a_server_on_this_machine(server, monkeypatch):
    monkeypatch.setenv("HTTP_PROXY", "http://127.0.0.1:9")
    monkeypatch.delenv("NO_PROXY", raising=False)
    monkeypatch.delenv("no_proxy", raising=False)
    with Client(server.url) as client:
        assert client.objects()


def test_an_address_without_scheme_is_refused_at_once():
    with pytest.raises(SpecError, match="http://"):
        Client("localhost:8000")


def test_wrong_options_are_found_before_anything_is_sent():
    with Client("http://127.0.0.1:9") as client, pytest.raises(SpecError, match="epsilon"):
        client.attack("mug", label=0, epsilon=3.0)


def test_progress_is_shown_by_phase_where_there_is_no_terminal(client, capsys):
    client.submit(SPEC).wait(timeout=20, progress=True)
    assert capsys.readouterr().err.splitlines() == [
        "  0%  queued",
        " 20%  calibrate  chose the calibrated model",
        " 50%  attack  step 7/15  loss 0.25  fooled 50%",
        "100%  succeeded",
    ]
