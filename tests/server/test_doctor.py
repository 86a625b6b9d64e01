"""``trompe doctor``: content with a machine that can do the work, and of help with one that cannot."""

import http.server
import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from trompe_server import commands, doctor
from trompe_server.jobs.store import JobStore
from trompe_server.settings import Settings

CHECKS = {
    "data folder",
    "disk space",
    "store",
    "database",
    "engine",
    "torch",
    "rendering",
    "renderer",
    "shipped objects",
    "TROMPE_ASSETS",
}


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test depends on what listens on this machine."""
    monkeypatch.setattr(doctor, "PORTS", {})


def run(*arguments: str) -> Result:
    return CliRunner().invoke(commands.doctor, arguments)


def unwell(settings: Settings) -> dict[str, doctor.Finding]:
    return {finding.what: finding for finding in doctor.check_all(settings) if not finding.ok}


def test_a_machine_that_can_do_the_work_is_well(tmp_path: Path) -> None:
    done = run("--json", "--data", str(tmp_path))
    report = json.loads(done.output)
    assert [finding for finding in report["findings"] if not finding["ok"]] == []
    assert (done.exit_code, report["ok"]) == (0, True)
    assert {finding["what"] for finding in report["findings"]} == CHECKS


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """What takes seconds is left out."""
    monkeypatch.setattr(doctor, "_check_torch", lambda _device: "fine")
    monkeypatch.setattr(doctor, "_check_renderer", lambda: "fine")
    monkeypatch.setattr(doctor, "_check_rendering", lambda: "fine")


@pytest.mark.usefixtures("quick")
def test_a_folder_that_cannot_be_written_is_found_and_its_remedy_said(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    done = run("--data", str(tmp_path / "file" / "data"))
    assert done.exit_code == 1
    assert "FAIL data folder" in done.output
    assert "\n     Choose another with --data" in done.output


@pytest.mark.usefixtures("quick")
def test_a_full_disk_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "ROOM", 2**80)
    found = unwell(Settings(data=tmp_path))
    assert list(found) == ["disk space"]
    assert "trompe jobs delete" in str(found["disk space"].remedy)


@pytest.mark.usefixtures("quick")
def test_a_database_that_is_away_is_found_and_its_password_kept(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path, database="postgresql://me:hunter2@127.0.0.1:9/trompe")
    found = unwell(settings)
    assert set(found) == {"database", "engine"}
    assert "hunter2" not in str(found["database"])
    assert "TROMPE_DATABASE" in str(found["database"].remedy)


@pytest.mark.usefixtures("quick")
def test_a_database_without_tables_is_found(tmp_path: Path) -> None:
    (tmp_path / "trompe.sqlite").touch()
    found = unwell(Settings(data=tmp_path))
    assert "trompe migrate" in str(found["engine"].remedy)
    store = JobStore(Settings(data=tmp_path).database_url)
    store.migrate()
    store.close()
    assert unwell(Settings(data=tmp_path)) == {}


@pytest.mark.usefixtures("quick")
def test_a_store_that_nobody_knows_is_found(tmp_path: Path) -> None:
    assert set(unwell(Settings(data=tmp_path, store="nosuch://bucket"))) == {"store"}


@pytest.mark.usefixtures("quick")
def test_assets_that_are_not_there_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TROMPE_ASSETS", str(tmp_path))
    found = unwell(Settings(data=tmp_path))
    assert "no objects/objects.json and no classifiers" in found["TROMPE_ASSETS"].words
    (tmp_path / "classifiers").mkdir()
    (tmp_path / "objects").mkdir()
    (tmp_path / "objects" / "objects.json").touch()
    assert unwell(Settings(data=tmp_path)) == {}


def test_a_machine_without_gl_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_RENDER", "raise SystemExit('no EGL here')")
    finding = doctor._finding("rendering", doctor._check_rendering)
    assert not finding.ok
    assert "no EGL here" in finding.words
    assert "apt install" in str(finding.remedy)


def test_a_device_that_is_not_there_is_found() -> None:
    finding = doctor._finding("torch", lambda: doctor._check_torch("nonsense"))
    assert "does not compute on nonsense" in finding.words
    assert "--device cpu" in str(finding.remedy)


class Healthy(http.server.BaseHTTPRequestHandler):
    """Answers as a service of ours does."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b'{"status": "ok"}')

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


@pytest.fixture
def healthy() -> Iterator[int]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Healthy) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        yield server.server_port
        server.shutdown()
        thread.join()


def test_a_port_is_free_or_ours_or_somebody_elses(healthy: int) -> None:
    assert doctor._check_port(healthy, "trompe serve") == "a `trompe serve` runs there"
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        other.close()
        assert doctor._check_port(port, "trompe serve") == "free for `trompe serve`"
    with socket.create_server(("127.0.0.1", 0)) as other:
        other.listen()
        threading.Thread(target=lambda: other.accept()[0].close(), daemon=True).start()
        finding = doctor._finding("port", lambda: doctor._check_port(other.getsockname()[1], "trompe serve"))
    assert not finding.ok
    assert "trompe serve --port" in str(finding.remedy)
