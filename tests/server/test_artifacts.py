"""The files of a job."""

import os
from pathlib import Path

import pytest

from trompe_server.artifacts import LocalArtifacts
from trompe_server.errors import ServiceError
from trompe_server.files import exclusive
from trompe_shared.errors import SpecError


def test_a_file_is_read_as_it_was_written_last(tmp_path: Path) -> None:
    artifacts = LocalArtifacts(tmp_path / "job")
    assert not artifacts.exists("a.bin")
    artifacts.write("a.bin", b"one")
    artifacts.write("a.bin", b"two")
    assert artifacts.exists("a.bin")
    assert artifacts.read("a.bin") == b"two"
    assert [file.name for file in (tmp_path / "job").iterdir()] == ["a.bin"]


def test_reading_what_is_not_there_is_a_file_not_found_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        LocalArtifacts(tmp_path).read("a.bin")


def test_a_write_that_is_cut_off_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    artifacts = LocalArtifacts(tmp_path)
    artifacts.write("a.bin", b"old")

    def full_disk(_: int) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="no space left"):
        artifacts.write("a.bin", b"new")
    assert artifacts.read("a.bin") == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.bin"]


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../a", "a/b", "a\\b", ".hidden", "-rf", "a\0b", "ä.png", "a\n", "x" * 201]
)
def test_a_name_that_could_leave_the_folder_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(SpecError, match="cannot be the name of an artifact"):
        LocalArtifacts(tmp_path / "job").write(name, b"")
    assert list(tmp_path.iterdir()) == []


def test_a_lock_is_held_by_one_and_free_again_afterwards(tmp_path: Path) -> None:
    lock = tmp_path / "folder" / "x.lock"
    with exclusive(lock, "taken"), pytest.raises(ServiceError, match="taken"), exclusive(lock, "taken"):
        pytest.fail("two hold one lock")
    with exclusive(lock, "taken"):
        pass
