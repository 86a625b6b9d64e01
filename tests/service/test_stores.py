"""Folders of files, local and remote, by one contract; files of a job; the library; deletion and retention."""

import errno
import importlib.util
import io
import os
import secrets
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from tests.service.records import DONE, claim, claims_of, create
from tests.surfaces import object_of, quad
from trompe_server.errors import ConflictError, NotFoundError, ServiceError
from trompe_server.library import Library
from trompe_server.queue import retention
from trompe_server.queue.retention import Retention, delete_job
from trompe_server.queue.store import JobStore
from trompe_server.service.dispatch import prepare_data
from trompe_server.settings import Settings
from trompe_server.storage.database import DatabaseDownError, connect
from trompe_server.storage.folders import Folder, JobArtifacts, LocalArtifacts, job_artifacts, open_folder
from trompe_server.system.files import exclusive
from trompe_shared.api import JobState
from trompe_shared.errors import ClassifierError, SpecError
from trompe_shared.local_files import pack_zip


@pytest.fixture(scope="session")
def bucket() -> Iterator[str]:
    """The URL of a bucket in an object store of our own."""
    if importlib.util.find_spec("moto") is None or importlib.util.find_spec("s3fs") is None:
        pytest.skip("NOT TESTED ON S3: pip install 'trompe[dev]' brings s3fs and moto")
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL_S3", f"http://{host}:{port}")
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(name, "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        import s3fs

        s3fs.S3FileSystem().mkdir("trompe")
        yield "s3://trompe"
    server.stop()


@pytest.fixture(params=["local", "file", "memory", "s3"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Folder:
    """An empty folder; a test that asks for it runs once on each kind."""
    match request.param:
        case "local":
            return open_folder(tmp_path / "folder")
        case "file":
            return open_folder(f"file://{tmp_path}/folder")
        case "memory":
            return open_folder(f"memory://{secrets.token_hex(4)}/folder")
        case _:
            return open_folder(f"{request.getfixturevalue('bucket')}/{secrets.token_hex(4)}")


def test_a_file_is_read_as_it_was_written_last(folder: Folder, tmp_path: Path) -> None:
    assert not folder.exists("a.bin")
    folder.write("a.bin", b"one")
    folder.write("a.bin", b"two")
    (tmp_path / "large").write_bytes(b"0123456789" * 300_000)
    folder.write("b.bin", tmp_path / "large")
    assert folder.read("a.bin") == b"two"
    assert (folder.size("a.bin"), folder.size("b.bin")) == (3, 3_000_000)
    assert folder.names() == ["a.bin", "b.bin"]
    with folder.open("b.bin") as file:
        file.seek(1_000_003)
        assert file.read(10) == b"3456789012"
    assert abs(folder.touched("a.bin") - time.time()) < 100
    folder.touch("a.bin")
    assert folder.read("a.bin") == b"two"


def test_what_is_not_there_is_a_file_not_found_error(folder: Folder) -> None:
    for call in (folder.read, folder.open, folder.size, folder.touched):
        with pytest.raises(FileNotFoundError):
            call("a.bin")
    assert folder.names() == folder.folders() == []
    folder.delete("a.bin")
    folder.delete_all()


def test_folders_lie_within_folders_and_go_with_them(folder: Folder) -> None:
    folder.within("one").within("two").write("a", b"1")
    folder.within("one").write("b", b"2")
    folder.within("other").write("c", b"3")
    assert folder.folders() == ["one", "other"]
    assert (folder.within("one").names(), folder.within("one").folders()) == (["b"], ["two"])
    folder.within("one").delete_all()
    assert folder.folders() == ["other"]
    folder.within("other").delete("c")
    assert folder.within("other").names() == []


def test_a_name_that_could_leave_the_folder_is_refused(folder: Folder, tmp_path: Path) -> None:
    for name in ("", ".", "..", "../a", "a/b", "a\\b", ".hidden", "-rf", "a\0b", "ä.png", "a\n", "x" * 201):
        for call in (folder.read, folder.exists, folder.within, folder.delete, lambda name: folder.write(name, b"")):
            with pytest.raises(SpecError, match="not a valid file name"):
                call(name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("url", "reason"),
    [("s3:/bucket", "'s3:/bucket' is no URL: write 's3://bucket'"), ("nonsense://bucket", "cannot be opened")],
)
def test_a_url_of_no_store_is_refused_with_a_remedy(url: str, reason: str) -> None:
    with pytest.raises(ServiceError, match=reason):
        open_folder(url)


def test_a_store_that_cannot_be_reached_is_told_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    folder, away = open_folder("memory://gone"), Mock(side_effect=ConnectionError("nobody there"))
    monkeypatch.setattr(type(folder.system), "cat_file", away)  # type: ignore[union-attr]
    with pytest.raises(ServiceError, match=r"is not available.*TROMPE_STORE"):
        folder.read("a")


@pytest.mark.parametrize(
    ("fault", "expected"),
    [(OSError(errno.ENOSPC, "full"), ServiceError), (OSError(errno.EIO, "no space left by chance"), OSError)],
)
def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    fault: OSError, expected: type[Exception], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = LocalArtifacts(tmp_path / "full")
    folder.write("a.bin", b"old")
    monkeypatch.setattr(os, "fsync", Mock(side_effect=fault))
    with pytest.raises(expected, match="no space left"):
        folder.write("a.bin", b"new")
    assert folder.read("a.bin") == b"old"
    assert [file.name for file in (tmp_path / "full").iterdir()] == ["a.bin"]


def test_an_older_attempt_never_replaces_what_a_newer_one_wrote(folder: Folder) -> None:
    old, new, reader = (job_artifacts(folder, "j", attempt=attempt) for attempt in (1, 10, None))
    old.write("state", b"old")
    old.write("only", b"once")
    assert new.read("state") == b"old", "a new attempt goes on with what there is"
    new.write("state", b"new")
    old.write("state", b"older")
    assert reader.read("state") == new.read("state") == old.read("state") == b"new"
    assert reader.names() == ["only", "state"]
    assert (reader.size("only"), reader.exists("only"), reader.exists("nothing")) == (4, True, False)
    with reader.open("state") as file:
        assert file.read() == b"new"
    with pytest.raises(FileNotFoundError):
        reader.read("nothing")
    with pytest.raises(ServiceError, match="read-only"):
        reader.write("state", b"")
    reader.keep(["only"])
    assert reader.names() == ["only"]
    reader.delete()
    assert reader.names() == []


def test_what_lies_in_the_folder_of_a_job_itself_is_found_last(tmp_path: Path) -> None:
    folder = LocalArtifacts(tmp_path)
    artifacts = JobArtifacts(folder, 1)
    folder.write("a", b"before attempts had folders")
    assert artifacts.read("a") == b"before attempts had folders"
    artifacts.write("a", b"now")
    assert artifacts.read("a") == b"now"


def _inspect(_: str) -> dict[str, object]:
    return {"white_box": True, "n_classes": 3, "image_size": [8, 8]}


def test_the_library_is_the_same_wherever_it_is(folder: Folder, tmp_path: Path) -> None:
    archive = pack_zip(dict(object_of(quad(np.zeros((8, 8, 3), np.uint8))).files))
    library = Library(folder, cache=tmp_path / "cache", inspect=_inspect)
    info = library.add_object(io.BytesIO(archive), "square.zip")
    assert library.add_object(io.BytesIO(archive), "again.zip").id == info.id
    net = library.add_classifier(io.BytesIO(b"weights"), "net.pt2", classes=["a", "b", "c"])
    again = Library(folder, cache=tmp_path / "cache")
    assert again.object_bytes("again") == archive
    assert [each.name for each in again.objects.all() if not each.shipped] == ["again"]
    assert again.classifier(net.id) == net
    path = Path(again.classifier_path("net"))
    assert (path.read_bytes(), path.suffix) == (b"weights", ".pt2")
    assert again.classifier_path("net") == str(path), "it is fetched once"
    with pytest.raises(NotFoundError):
        again.objects.find("nothing")


def test_a_classifier_whose_stored_bytes_are_damaged_is_not_loaded(tmp_path: Path) -> None:
    folder = open_folder(f"memory://{secrets.token_hex(4)}")
    library = Library(folder, cache=tmp_path / "cache", inspect=_inspect)
    net = library.add_classifier(io.BytesIO(b"weights"), "net.pt2")
    folder.within("classifiers").within(net.id).write("data.pt2", b"rubbish")
    with pytest.raises(ClassifierError, match="damaged"):
        library.classifier_path("net")
    assert list(tmp_path.rglob("*.pt2")) == []


def test_retention_deletes_what_is_old_and_nothing_else(store: JobStore, tmp_path: Path) -> None:
    files = open_folder(tmp_path / "files")
    old, running, queued = (create(store) for _ in range(3))
    for job in (old, running, queued):
        job_artifacts(files, job, attempt=1).write("result.json", b"{}")
    claims_of(store).finish(claim(store), DONE)
    claim(store)
    calibrations = LocalArtifacts(tmp_path / "files" / "library" / "calibrations")
    for name, age in (("used.npz", 0.0), ("unused.npz", 10 * 86400.0)):
        calibrations.write(name, b"0")
        os.utime(calibrations.path(name), (time.time() - age,) * 2)

    assert Retention(store, files, days=7).run() == 0
    assert calibrations.names() == ["used.npz"]
    assert Retention(store, files, days=-1 / 86400).run() == 1
    with pytest.raises(NotFoundError):
        store.get(old)
    assert {store.get(job).state for job in (running, queued)} == {JobState.running, JobState.queued}
    assert files.within("jobs").folders() == sorted([running, queued])


def test_retention_goes_on_after_as_many_jobs_as_it_looks_up_at_once_whose_files_cannot_be_deleted(
    store: JobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    files, stuck, other = open_folder(f"memory://{secrets.token_hex(4)}"), create(store), create(store)
    for job in (stuck, other):
        job_artifacts(files, job, attempt=1).write("result.json", b"{}")
        claims_of(store).finish(claim(store), DONE)
    remove = type(files.system).rm  # type: ignore[union-attr]

    def rm(self: Any, path: str, **how: Any) -> None:
        if stuck in path:
            raise PermissionError(path)
        remove(self, path, **how)

    monkeypatch.setattr(type(files.system), "rm", rm)  # type: ignore[union-attr]
    monkeypatch.setattr(retention, "BATCH", 1)
    assert Retention(store, files, days=-1 / 86400).run() == 1
    assert store.get(stuck).state is JobState.succeeded
    with pytest.raises(NotFoundError):
        store.get(other)


@pytest.mark.parametrize(
    ("days", "seconds"),
    [
        pytest.param(30, 3600, id="a month: every hour"),
        pytest.param(1 / 24, 900, id="an hour: every quarter of it"),
        pytest.param(1e-9, 1, id="no time: every second"),
    ],
)
def test_retention_looks_often_enough_that_little_is_kept_for_longer(
    days: float, seconds: float, store: JobStore, tmp_path: Path
) -> None:
    assert Retention(store, open_folder(tmp_path), days=days).interval == pytest.approx(seconds)


def test_a_job_whose_files_cannot_be_deleted_stays_until_they_can(
    store: JobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    files, job = open_folder(f"memory://{secrets.token_hex(4)}"), create(store)
    job_artifacts(files, job, attempt=1).write("result.json", b"{}")
    with pytest.raises(ConflictError, match="Cancel it first"):
        delete_job(store, files, job)
    assert job_artifacts(files, job).names() == ["result.json"]
    claims_of(store).finish(claim(store), DONE)
    with monkeypatch.context() as patch:
        patch.setattr(type(files.system), "rm", Mock(side_effect=ConnectionError("nobody there")))  # type: ignore[union-attr]
        with pytest.raises(ServiceError, match="not available"):
            delete_job(store, files, job)
        assert store.get(job).state is JobState.succeeded
    delete_job(store, files, job)
    assert files.within("jobs").folders() == []
    with pytest.raises(NotFoundError):
        delete_job(store, files, job)


def test_a_local_folder_that_cannot_be_deleted_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = open_folder(tmp_path / "job")
    folder.write("a", b"1")
    monkeypatch.setattr(shutil, "rmtree", Mock(side_effect=PermissionError("read-only")))
    with pytest.raises(ServiceError, match="cannot be deleted"):
        folder.delete_all()


def test_a_lock_is_held_by_one_and_free_again_afterwards(tmp_path: Path) -> None:
    lock = tmp_path / "folder" / "x.lock"
    with exclusive(lock, "taken"), pytest.raises(ServiceError, match="taken"), exclusive(lock, "taken"):
        pytest.fail("two hold one lock")
    with exclusive(lock, "taken"):
        pass


def test_a_database_url_that_cannot_be_used_is_quoted_without_its_password() -> None:
    with pytest.raises(ServiceError, match=r"mysql://me:\*\*\*@host/jobs") as caught:
        connect("mysql://me:geheim@host/jobs")
    assert "geheim" not in str(caught.value)


def test_the_database_is_in_the_data_folder_whatever_that_is_called(tmp_path: Path) -> None:
    data = tmp_path / "100%20 Größe? a=b&c #1"
    prepare_data(Settings(data=data))
    assert [each.name for each in data.iterdir()] == ["trompe.sqlite"]


def test_a_damaged_database_is_not_available(tmp_path: Path) -> None:
    (tmp_path / "trompe.sqlite").write_bytes(bytes(range(256)) * 100)
    with pytest.raises(DatabaseDownError, match="file is not a database"):
        JobStore(Settings(data=tmp_path).database_url).counts()
