"""``trompe doctor``: content with a healthy machine, helpful with another."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from click.testing import CliRunner

from tests.served import answering_once, reserved_port, saying
from trompe_server.queue.store import JobStore
from trompe_server.service import commands, doctor
from trompe_server.settings import Settings

CHECKS = {"data folder", "store", "database", "torch", "renderer", "shipped objects"}


def failed(check: Callable[..., str], *arguments: object, **options: object) -> doctor.Finding:
    """The finding of a check that must fail."""
    finding = doctor._finding("it", partial(check, *arguments, **options))
    assert not finding.ok
    return finding


def test_a_machine_that_can_do_the_work_is_well(tmp_path: Path) -> None:
    done = CliRunner().invoke(commands.doctor, ["--json", "--data", str(tmp_path)])
    report = json.loads(done.output)
    findings = {each["what"]: each for each in report["findings"] if not each["what"].startswith("port ")}
    assert [each for each in findings.values() if not each["ok"]] == []
    assert findings.keys() == CHECKS
    assert (done.exit_code, report["ok"]) == ((0, True) if all(f["ok"] for f in report["findings"]) else (1, False))


def test_a_failed_check_is_printed_with_its_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    finding = failed(doctor._check_folder, tmp_path / "file" / "data")
    assert doctor.in_words(finding).startswith("FAIL it: ")
    assert "\n     Choose another folder with --data" in doctor.in_words(finding)
    assert doctor.in_words(doctor.Finding("it", ok=True, words="well")) == "ok   it: well"


def test_a_full_disk_is_found(tmp_path: Path) -> None:
    assert "trompe jobs delete" in str(failed(doctor._check_folder, tmp_path, min_free=2**80).remedy)


@pytest.mark.parametrize("database", ["me:hunter2@127.0.0.1:9/trompe", "me@127.0.0.1:9/trompe?password=hunter2"])
def test_a_database_that_is_away_is_found_and_its_password_kept(tmp_path: Path, database: str) -> None:
    settings = Settings(data=tmp_path, database=f"postgresql://{database}")
    finding = failed(doctor._check_database, settings)
    assert "hunter2" not in f"{finding} {JobStore(settings.database_url).engine.url!r}"
    assert "TROMPE_DATABASE" in str(finding.remedy)


def test_a_database_without_tables_is_found(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path)
    assert "will be created" in doctor._check_database(settings)
    (tmp_path / "trompe.sqlite").touch()
    assert "trompe migrate" in str(failed(doctor._check_database, settings).remedy)
    store = JobStore(settings.database_url)
    store.migrate()
    store.close()
    assert "jobs: none; attack workers alive: 0" in doctor._check_database(settings)


@pytest.mark.parametrize("store", ["nosuch://me:hunter2@bucket", "ftp://me:hunter2@127.0.0.1:9/trompe"])
def test_a_store_that_does_not_work_is_found_and_its_password_kept(tmp_path: Path, store: str) -> None:
    finding = failed(doctor._check_store, Settings(data=tmp_path, store=store))
    assert "--store" in str(finding.remedy)
    assert "hunter2" not in str(finding)


def test_a_machine_without_gl_is_told_what_to_install() -> None:
    finding = failed(doctor._check_renderer, "raise SystemExit('no EGL here')")
    assert "no EGL here" in finding.words
    assert "apt install" in str(finding.remedy)


def test_a_device_that_is_not_there_is_found() -> None:
    finding = failed(doctor._check_torch, "nonsense")
    assert "does not compute on nonsense" in finding.words
    assert "--device cpu" in str(finding.remedy)


def test_a_port_is_free_or_ours_or_somebody_elses() -> None:
    with answering_once(saying(b'HTTP/1.0 200 OK\r\n\r\n{"status": "ok"}')) as (_, port):
        assert doctor._check_port(port) == "`trompe serve` is running"
    with reserved_port() as port:
        assert doctor._check_port(port) == "free for `trompe serve`"
    with answering_once(lambda connection: None) as (_, port):
        finding = failed(doctor._check_port, port)
    assert "trompe serve --port" in str(finding.remedy)
