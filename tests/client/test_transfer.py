"""Files come whole or not at all, and no byte of them twice."""

import hashlib

import pytest

from trompe_client import BrokenDownload, ServerUnreachable
from trompe_shared.api import JobSpec

SPEC = JobSpec(object="mug", label="mug")
DATA = bytes(range(256)) * 4000


@pytest.fixture
def job(client, server, monkeypatch):
    """A finished job of one file of a megabyte."""
    monkeypatch.setattr(server, "artifact", lambda _job, _name: DATA)
    server.artifacts = ["big.bin"]
    job = client.submit(SPEC)
    server.finish_all()
    return job


def asked(server):
    """What the downloads asked for: (Range, If-None-Match)."""
    return [
        (headers.get("Range"), headers.get("If-None-Match"))
        for _, path, headers in server.requests
        if "/artifacts/" in path
    ]


def test_a_file_that_breaks_off_goes_on_where_it_was(job, server, tmp_path):
    server.cut = [300_000, 500_000]
    (path,) = job.download(tmp_path)
    assert path.read_bytes() == DATA
    assert asked(server) == [(None, None), ("bytes=300000-", None), ("bytes=800000-", None)]
    assert [file.name for file in tmp_path.iterdir()] == ["big.bin"]


def test_another_process_takes_up_what_one_has_left(job, server, client, tmp_path):
    server.cut = [300_000] + [0] * 9
    with pytest.raises(ServerUnreachable):
        job.download(tmp_path)
    assert not (tmp_path / "big.bin").exists()
    server.cut, server.requests = [], []
    (path,) = client.job(job.id).download(tmp_path)
    assert path.read_bytes() == DATA
    assert asked(server) == [("bytes=300000-", None)]


def test_a_slow_line_that_brings_something_each_time_is_not_given_up(job, server, tmp_path):
    server.cut = [50_000] * 15
    assert job.download(tmp_path)[0].read_bytes() == DATA


def test_what_is_there_is_not_brought_again(job, server, tmp_path):
    job.download(tmp_path)
    job.download(tmp_path)
    assert asked(server) == [(None, None), (None, f'"{hashlib.sha256(DATA).hexdigest()}"')]


def test_a_part_of_another_file_is_of_no_use(job, server, tmp_path):
    other = hashlib.sha256(b"other").hexdigest()
    (tmp_path / f".big.bin.{other}.part").write_bytes(b"oth")
    assert job.download(tmp_path)[0].read_bytes() == DATA
    assert [file.name for file in tmp_path.iterdir()] == ["big.bin"]


@pytest.mark.parametrize("extra", [b"", b"more"], ids=["all of it", "more than all"])
def test_a_part_that_is_no_part_is_checked_and_brought_anew_if_need_be(job, server, tmp_path, extra):
    (tmp_path / f".big.bin.{hashlib.sha256(DATA).hexdigest()}.part").write_bytes(DATA + extra)
    assert job.download(tmp_path)[0].read_bytes() == DATA
    assert [file.name for file in tmp_path.iterdir()] == ["big.bin"]
    assert len(asked(server)) == 1 + bool(extra)


def test_wrong_bytes_are_brought_again(job, server, tmp_path):
    server.lies = 1
    assert job.download(tmp_path)[0].read_bytes() == DATA


def test_bytes_that_stay_wrong_are_an_error_and_no_file(job, server, tmp_path):
    (tmp_path / "big.bin").write_bytes(b"old")
    server.lies = 99
    with pytest.raises(BrokenDownload, match=hashlib.sha256(DATA).hexdigest()):
        job.download(tmp_path)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == {"big.bin": b"old"}


def test_an_archive_comes_under_the_name_it_is_given(job, tmp_path):
    path = job.archive(tmp_path / "deep" / "all.zip")
    assert path.read_bytes()[:2] == b"PK"
    assert [file.name for file in path.parent.iterdir()] == ["all.zip"]
