"""The commands, as far as they need no service to run."""

from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from trompe_client.cli import main
from trompe_server.service import commands
from trompe_server.settings import Settings


def run(command: click.Command, *arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(main, [str(command.name), *arguments])
    return result.exit_code, result.output


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.5", "::", "example.org"])
def test_serve_refuses_to_be_seen_by_other_machines_where_anybody_could_come_in(tmp_path: Path, host: str) -> None:
    status, words = run(commands.serve, "--host", host, "--port", "0", "--data", str(tmp_path))
    assert status == 1
    assert "trompe token create NAME" in words


def test_attack_workers_without_a_renderer_are_refused(tmp_path: Path) -> None:
    status, words = run(commands.serve, "--renderers", "0", "--data", str(tmp_path))
    assert status == 1
    assert "--workers 0" in words


def test_a_worker_must_be_told_where_the_renderers_are(tmp_path: Path) -> None:
    status, words = run(commands.worker, "--data", str(tmp_path))
    assert status == 2
    assert "--renderers-dns" in words


def test_a_worker_without_processes_is_refused(tmp_path: Path) -> None:
    status, words = run(commands.worker, "--data", str(tmp_path), "--renderer", "127.0.0.1:1", "--workers", "0")
    assert status == 1
    assert "--workers 1" in words


@pytest.mark.parametrize("url", ["mysql://host/name", "nonsense", "sqlite://"])
def test_a_database_that_cannot_be_used_is_refused_with_a_remedy(tmp_path: Path, url: str) -> None:
    status, words = run(commands.migrate, "--data", str(tmp_path), "--database", url)
    assert status == 1
    assert "is not a supported database URL" in words


def test_migrating_makes_the_database_once_and_again(tmp_path: Path) -> None:
    for _ in range(2):
        assert run(commands.migrate, "--data", str(tmp_path)) == (0, "the database is up to date\n")
    assert (tmp_path / "trompe.sqlite").exists()


def test_serve_says_what_is_wrong_with_the_data_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    status, words = run(commands.serve, "--port", "0", "--data", str(tmp_path / "file" / "data"))
    assert status == 1
    assert "cannot be written" in words
    assert "TROMPE_DATA" in words


@pytest.mark.parametrize("address", ["8085", "host:", ":80x", ""])
def test_worker_refuses_a_renderer_that_is_no_address(tmp_path: Path, address: str) -> None:
    status, words = run(commands.worker, "--data", str(tmp_path), "--renderer", address)
    assert status == 2
    assert "is not HOST:PORT" in words


def test_wrong_settings_are_named_with_their_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    status, words = run(commands.serve, "--data", str(tmp_path), "--executor", "dask")
    assert status == 2
    assert "executor: String should match" in words
    monkeypatch.setenv("TROMPE_WORKERS", "many")
    status, words = run(commands.migrate, "--data", str(tmp_path))
    assert status == 2
    assert "workers: Input should be a valid integer" in words
    assert "(TROMPE_WORKERS)" in words


def test_the_data_folder_is_set_by_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TROMPE_DATA", str(tmp_path))
    assert Settings().data == tmp_path
