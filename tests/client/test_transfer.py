"""Files come whole or not at all, and no byte of them twice."""

import hashlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.client.conftest import SPEC, FakeServer
from trompe_client import BrokenDownload, Client, JobHandle, NotWritten, ServerUnreachable

DATA = bytes(range(256)) * 4000


@pytest.fixture
def job(client: Client, server: FakeServer, monkeypatch: pytest.MonkeyPatch) -> JobHandle:
    """A finished job of one file of a megabyte."""
    monkeypatch.setattr(server, "artifact", lambda _job, _name: DATA)
    server.artifacts = ["big.bin"]
    job = client.submit(SPEC)
    server.finish_all()
    return job


def asked(server: FakeServer) -> list[tuple[str | None, str | None]]:
    """What the downloads asked for: (Range, If-None-Match)."""
    asking = [headers for _, path, headers in server.requests if "/artifacts/" in path]
    return [(headers.get("Range"), headers.get("If-None-Match")) for headers in asking]


def test_a_file_that_breaks_off_goes_on_where_it_was(job: JobHandle, server: FakeServer, tmp_path: Path) -> None:
    server.cut = [300_000, 500_000]
    (path,) = job.download(tmp_path)
    assert path.read_bytes() == DATA
    assert asked(server) == [(None, None), ("bytes=300000-", None), ("bytes=800000-", None)]
    assert [file.name for file in tmp_path.iterdir()] == ["big.bin"]


def test_another_process_takes_up_what_one_has_left(
    job: JobHandle, server: FakeServer, client: Client, tmp_path: Path
) -> None:
    server.cut = [300_000] + [0] * 9
    with pytest.raises(ServerUnreachable):
        job.download(tmp_path)
    assert not (tmp_path / "big.bin").exists()
    server.cut, server.requests = [], []
    (path,) = client.job(job.id).download(tmp_path)
    assert path.read_bytes() == DATA
    assert asked(server) == [("bytes=300000-", None)]


def test_a_slow_line_that_brings_something_each_time_is_not_given_up(
    job: JobHandle, server: FakeServer, tmp_path: Path
) -> None:
    server.cut = [50_000] * 15
    assert job.download(tmp_path)[0].read_bytes() == DATA


def test_what_is_there_is_not_brought_again(job: JobHandle, server: FakeServer, tmp_path: Path) -> None:
    job.download(tmp_path)
    job.download(tmp_path)
    assert asked(server) == [(None, None), (None, f'"{hashlib.sha256(DATA).hexdigest()}"')]


@pytest.mark.parametrize(
    ("of", "part", "requests"),
    [
        pytest.param(b"other", b"oth", 1, id="of another file"),
        pytest.param(DATA, DATA, 1, id="all of it"),
        pytest.param(DATA, DATA + b"more", 2, id="more than all"),
    ],
)
def test_a_part_that_is_no_part_is_checked_and_brought_anew_if_need_be(
    job: JobHandle, server: FakeServer, tmp_path: Path, of: bytes, part: bytes, requests: int
) -> None:
    (tmp_path / f".big.bin.{hashlib.sha256(of).hexdigest()}.part").write_bytes(part)
    assert job.download(tmp_path)[0].read_bytes() == DATA
    assert [file.name for file in tmp_path.iterdir()] == ["big.bin"]
    assert len(asked(server)) == requests


def test_wrong_bytes_are_brought_again(job: JobHandle, server: FakeServer, tmp_path: Path) -> None:
    server.lies = 1
    assert job.download(tmp_path)[0].read_bytes() == DATA


def test_bytes_that_stay_wrong_are_an_error_and_no_file(job: JobHandle, server: FakeServer, tmp_path: Path) -> None:
    (tmp_path / "big.bin").write_bytes(b"old")
    server.lies = 99
    with pytest.raises(BrokenDownload, match=hashlib.sha256(DATA).hexdigest()):
        job.download(tmp_path)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == {"big.bin": b"old"}


def test_an_archive_comes_under_the_name_it_is_given(job: JobHandle, tmp_path: Path) -> None:
    path = job.archive(tmp_path / "deep" / "all.zip")
    assert path.read_bytes()[:2] == b"PK"
    assert [file.name for file in path.parent.iterdir()] == ["all.zip"]


def test_threads_download_the_same_job_into_the_same_folder(job: JobHandle, tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(lambda _: job.download(tmp_path), range(16)))
    assert all(paths == found[0] for paths in found)
    assert all(path.is_file() for path in found[0])
    assert not list(tmp_path.glob(".*.part"))


def test_a_file_that_cannot_be_written_says_where_it_still_is(job: JobHandle, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(NotWritten, match=r"taken.*cannot be written \(Not a directory\)\. The server keeps it"):
        job.download(tmp_path / "taken" / "results")
