"""Results, artifacts and archives."""

import hashlib
import io
import zipfile

import httpx
import pytest

from tests.server.api.conftest import Api
from trompe_server.api import downloads
from trompe_shared.api import JobState, JudgementRequest

TEN = b"0123456789"


class Ended:
    """A job that ended with a few files."""

    def __init__(self, api: Api, job: str) -> None:
        self.api, self.job = api, job

    def get(self, name: str = "digits.txt", headers: dict[str, str] | None = None) -> httpx.Response:
        return self.api.get(f"/v1/jobs/{self.job}/artifacts/{name}", headers=headers)


@pytest.fixture
def done(stocked: Api) -> Ended:
    job = stocked.job()
    stocked.end(job, result__json=b'{"a": 1.50}', digits__txt=TEN, empty__txt=b"")
    return Ended(stocked, job)


def test_a_result_is_refused_until_the_job_has_ended_and_then_served_as_it_was_written(stocked: Api) -> None:
    job = stocked.job()
    assert "is queued" in stocked.problem(stocked.get(f"/v1/jobs/{job}/result"), 409)["detail"]
    stocked.end(job, result__json=b'{"a": 1.50}')
    stocked.tell(job, "kept", artifacts=["result.json"])

    result = stocked.get(f"/v1/jobs/{job}/result")
    artifact = stocked.get(f"/v1/jobs/{job}/artifacts/result.json")
    for answer in (result, artifact):
        assert (answer.content, answer.headers["content-type"]) == (b'{"a": 1.50}', "application/json")


def test_only_public_files_are_served(done: Ended) -> None:
    done.api.tell(done.job, "fewer", artifacts=["digits.txt"])
    for private in ("result.json", "..%2F..%2Ftrompe.sqlite", "%2Fetc%2Fpasswd", ".%00"):
        assert done.get(private).status_code == 404
    assert "It has: digits.txt." in done.api.problem(done.get("x"), 404)["detail"]


@pytest.mark.parametrize(
    "path",
    [
        "/v1/jobs/{}/artifacts/digits.txt",
        "/v1/jobs/{}/archive",
        "/v1/judgements/{}/manifest",
        "/v1/judgements/{}/page",
        "/jobs/{}/result.html",
        "/jobs/{}/models/after.glb",
    ],
)
def test_a_file_that_is_gone_from_the_store_is_not_found(stocked: Api, path: str) -> None:
    if "judgements" in path:
        request = JudgementRequest.of("mug", "mug", label="mug")
        job = stocked.services.store.create(request)[0].id
    else:
        job = stocked.job()
    files = {"digits.txt": TEN, "judgement.json": b"{}", "judgement.html": b"", "mug-adversarial.zip": b""}
    stocked.end(job, JobState.succeeded, **files)
    stocked.services.artifacts(job).delete()
    assert "no longer in the store" in stocked.problem(stocked.get(path.format(job)), 404)["detail"]


def test_without_a_result_the_reason_is_told_and_there_is_no_archive(stocked: Api) -> None:
    job = stocked.job()
    stocked.end(job, JobState.failed)
    stocked.tell(job, "why", error="The renderer is gone.")
    assert "The renderer is gone." in stocked.problem(stocked.get(f"/v1/jobs/{job}/result"), 409)["detail"]
    assert "has no artifacts" in stocked.problem(stocked.get(f"/v1/jobs/{job}/archive"), 404)["detail"]


def test_the_etag_is_the_hash_of_the_bytes_and_saves_sending_them_again(done: Ended) -> None:
    first = done.get()
    etag = first.headers["etag"]
    assert etag == f'"{hashlib.sha256(TEN).hexdigest()}"'
    assert first.headers["cache-control"] == "private, no-cache"
    for known in (etag, f'"x", {etag}', f"W/{etag}", "*"):
        again = done.get("digits.txt", {"If-None-Match": known})
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", etag)
    assert done.get("digits.txt", {"If-None-Match": '"x"'}).content == TEN


def test_a_file_of_a_job_that_goes_on_is_hashed_anew_each_time(stocked: Api) -> None:
    job = stocked.job()
    stocked.end(job, JobState.running, a__txt=b"one")
    first = stocked.get(f"/v1/jobs/{job}/artifacts/a.txt").headers["etag"]
    stocked.end(job, JobState.running, a__txt=b"two")
    assert stocked.get(f"/v1/jobs/{job}/artifacts/a.txt").headers["etag"] != first


RANGES = [
    ("bytes=0-3", 206, b"0123"),
    ("bytes=4-", 206, b"456789"),
    ("bytes=-3", 206, b"789"),
    ("bytes=9-99", 206, b"9"),
    ("bytes=2-2", 206, b"2"),
    ("bytes=-99", 206, TEN),
    ("bytes=10-", 416, b""),
    ("bytes=-0", 416, b""),
    ("bytes=5-4", 200, TEN),
    ("bytes=0-1,4-5", 200, TEN),
    ("bytes=-", 200, TEN),
    ("bytes=a-b", 200, TEN),
    (f"bytes=0-{'9' * 5000}", 200, TEN),
    ("lines=1-2", 200, TEN),
]


def test_a_range_of_a_file(done: Ended) -> None:
    for asked, status, content in RANGES:
        answer = done.get("digits.txt", {"Range": asked})
        assert answer.status_code == status, asked
        if status == 416:
            assert done.api.problem(answer, 416)["type"] == "urn:trompe:no-such-range", asked
            assert answer.headers["content-range"] == "bytes */10", asked
            continue
        assert answer.content == content, asked
        assert answer.headers["content-length"] == str(len(content)), asked
        first = TEN.index(content)
        told = f"bytes {first}-{first + len(content) - 1}/10" if status == 206 else None
        assert answer.headers.get("content-range") == told, asked


def test_a_download_goes_on_only_if_the_file_is_the_same(done: Ended) -> None:
    part = {"Range": "bytes=5-", "If-Range": done.get().headers["etag"]}
    assert done.get(headers=part).content == TEN[5:]
    assert done.get(headers=part | {"If-Range": '"other"'}).content == TEN


READ = ("artifacts/digits.txt", "artifacts/nope", "archive", "result", "events", "")


@pytest.mark.parametrize("path", READ)
def test_head_has_status_and_headers_of_get_alone(done: Ended, path: str) -> None:
    head, get = (done.api.request(method, f"/v1/jobs/{done.job}/{path}".rstrip("/")) for method in ("HEAD", "GET"))
    assert (head.status_code, head.content) == (get.status_code, b"")
    own = {"x-request-id", "content-length"} if get.status_code == 404 else {"x-request-id"}
    told = [[(name, value) for name, value in each.headers.items() if name not in own] for each in (head, get)]
    assert told[0] == told[1]


@pytest.mark.timeout(20)
def test_head_does_not_wait_for_the_events_of_a_job_that_goes_on(stocked: Api) -> None:
    assert stocked.request("HEAD", f"/v1/jobs/{stocked.job()}/events").status_code == 200


def test_an_empty_file_is_served(done: Ended) -> None:
    assert done.get("empty.txt").content == b""
    assert done.get("empty.txt", {"Range": "bytes=0-"}).status_code == 416


def test_the_archive_holds_all_artifacts_and_nothing_else(done: Ended) -> None:
    answer = done.api.get(f"/v1/jobs/{done.job}/archive")
    assert answer.headers["content-type"] == "application/zip"
    assert answer.headers["content-disposition"] == f'attachment; filename="trompe-{done.job}.zip"'
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    assert archive.testzip() is None
    assert archive.namelist() == ["result.json", "digits.txt", "empty.txt"]
    assert archive.read("digits.txt") == TEN
    assert done.api.get(f"/v1/jobs/{done.job}/archive").content == answer.content


def test_an_archive_is_made_part_by_part(stocked: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(downloads, "PART", 1000)
    job = stocked.job()
    stocked.end(job, big__png=bytes(50_000), text__txt=b"x" * 5000)
    found = stocked.services.store.get(job)
    parts = list(downloads.zip_stream(stocked.services.artifacts(job), found.artifacts, time=found.created))
    assert max(map(len, parts)) < 2000
    assert zipfile.ZipFile(io.BytesIO(b"".join(parts))).read("big.png") == bytes(50_000)
