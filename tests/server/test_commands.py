"""The commands, as far as they need no service to run."""

from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from trompe_server import commands, doctor
from trompe_server.settings import Settings


def run(command: click.Command, *arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(command, arguments)
    return result.exit_code, result.output


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.5", "::", "example.org"])
def test_serve_refuses_to_be_seen_by_other_machines(tmp_path: Path, host: str) -> None:
    status, words = run(commands.serve, "--host", host, "--port", "0", "--data", str(tmp_path / "data"))
    assert status == 1
    assert "TROMPE_ALLOW_PUBLIC=1" in words
    assert not (tmp_path / "data").exists()


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


def test_the_data_folder_is_set_by_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TROMPE_DATA", str(tmp_path))
    assert Settings().data == tmp_path


def test_doctor_is_content_with_a_machine_that_can_do_the_work(tmp_path: Path) -> None:
    findings = doctor.check_all(Settings(data=tmp_path))
    assert [finding.words for finding in findings if not finding.ok] == []
    assert {finding.what for finding in findings} == {"data folder", "torch", "rendering", "shipped objects"}


def test_doctor_says_how_to_mend_what_is_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(doctor, "_RENDER", "raise SystemExit('no EGL here')")
    status, words = run(commands.doctor, "--data", str(tmp_path / "file" / "data"))
    assert status == 1
    assert "FAIL data folder" in words
    assert "choose another with --data" in words
    assert "FAIL rendering" in words
    assert "no EGL here" in words
    assert "apt install" in words
