"""Jobs and the engines of their renderers. Workers with other settings count as other engines."""

import json
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

from tests.served import Served, reserved_port, wait_until
from tests.service.processes import listening
from tests.worker_process import FLAT, FLAT_SETTINGS, SHARP, SHARP_SETTINGS, shared_worker, started
from trompe_client.cli import main
from trompe_server.executor.opener import JobOpener
from trompe_server.queue.claims import Claim
from trompe_server.renderers import discovery
from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.settings import Settings
from trompe_server.storage.folders import open_folder
from trompe_shared.api import JobSpec
from trompe_shared.errors import RendererError, RendererLostError, SpecError


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A renderer on a busy machine may take long to tell its engine; one that is not there refuses at once."""
    monkeypatch.setattr(discovery, "PATIENCE", 60.0)


sharp = shared_worker(*SHARP, scope="module")
flat = shared_worker(*FLAT, scope="module")


def pipeline(_spec: JobSpec, **parts: Any) -> Any:
    """A job that shows the arguments it was opened with."""
    return SimpleNamespace(**parts)


class Opening:
    """Opens attempts of one job."""

    def __init__(self, folder: Path, *, patience: float = 0.0) -> None:
        path = f"{pipeline.__module__}:{pipeline.__name__}"
        self._settings = Settings(data=folder, pipeline=path, renderer_patience=patience)
        self._files, self._attempt = open_folder(str(folder)), 0

    def engines(self, *addresses: tuple[str, int], **options: Any) -> list[str]:
        """The engines of the targets of the next attempt: attacked ones, and after a bar the others."""
        self._attempt += 1
        job = SimpleNamespace(id="0123456789abcdef", spec=JobSpec.of("mug", label="mug", **options))
        opener = JobOpener(self._settings, self._files, RendererAddresses(addresses))
        parts: Any
        with opener.open(Claim(job, self._attempt, 0)) as parts:  # type: ignore[arg-type]
            attacked = [parts.target, *parts.more_targets]
            return [str(each.engine) for each in attacked] + ["|", *(str(each.engine) for each in parts.judge_targets)]


@pytest.fixture
def opening(tmp_path: Path) -> Opening:
    return Opening(tmp_path)


def test_a_job_takes_the_first_listed_engine_or_those_it_names(
    tmp_path: Path, worker: tuple[str, int], sharp: tuple[str, int]
) -> None:
    ours, other = Opening(tmp_path / "a").engines(worker, sharp)[0], Opening(tmp_path / "b").engines(sharp, worker)[0]
    assert other == f"{ours} ({SHARP_SETTINGS})"
    found = Opening(tmp_path / "c").engines(worker, sharp, renderers=[other], judge_renderers=[ours])
    assert found == [other, "|", ours]
    assert Opening(tmp_path / "d").engines(worker, sharp, renderers=[other, ours]) == [other, ours, "|"]
    with pytest.raises(SpecError, match="give one in full"):
        Opening(tmp_path / "e").engines(worker, sharp, renderers=["pyrender"])
    with pytest.raises(RendererError, match=f"three.*There are: {ours}; {ours} .{SHARP_SETTINGS}"):
        Opening(tmp_path / "f").engines(worker, sharp, renderers=["three"])


def test_later_attempts_keep_to_the_engine_of_the_first(
    opening: Opening, worker: tuple[str, int], sharp: tuple[str, int]
) -> None:
    first = opening.engines(worker, sharp)
    assert opening.engines(sharp, worker) == first
    with pytest.raises(RendererLostError, match=rf"began with {first[0]},.*There are: {first[0]} \({SHARP_SETTINGS}\)"):
        opening.engines(sharp)


def test_a_default_waits_for_the_first_listed_renderer(tmp_path: Path, sharp: tuple[str, int]) -> None:
    done = threading.Event()

    def late() -> None:
        with started("--port", str(port)):
            done.wait(240)

    thread = threading.Thread(target=late)
    with reserved_port() as port:
        address = ("127.0.0.1", port)
        ours = Opening(tmp_path / "a").engines(address, sharp)[0]
        assert SHARP_SETTINGS in ours  # it has no patience
        thread.start()
        try:
            assert SHARP_SETTINGS not in Opening(tmp_path / "b", patience=240).engines(address, sharp)[0]
        finally:
            done.set()
            thread.join()


def test_a_renderer_without_our_extensions_is_sailenv(opening: Opening) -> None:
    with listening() as port:
        assert opening.engines(("127.0.0.1", port)) == ["sailenv", "|"]


@pytest.mark.thorough
def test_one_paint_for_two_renderers_judged_by_a_third(
    tmp_path: Path, sharp: tuple[str, int], flat: tuple[str, int]
) -> None:
    """From the command line, through a service with a renderer of its own."""
    elsewhere = [word for host, port in (sharp, flat) for word in ("--renderer", f"{host}:{port}")]
    patience = {"TROMPE_RENDERER_PATIENCE": "120"}
    with Served(tmp_path / "data", *elsewhere, environment=patience) as served:
        listed = wait_until(served.engines)
        assert [each["settings"] for each in listed] == ["", SHARP_SETTINGS, FLAT_SETTINGS]
        ours = f"pyrender {listed[0]['version']}"
        words = ["attack", "mug", "--label", "mug", "--server", served.url, "--pool", "16", "--held-out", "12"]
        words += ["--steps", "15", "--epsilon", "0.1", "--surrogate", "calibrated", "--out", str(tmp_path / "out")]
        asked = ["--renderer", ours, "--renderer", f"{ours} ({SHARP_SETTINGS})"]
        asked += ["--judge-renderer", f"{ours} ({FLAT_SETTINGS})"]
        done = CliRunner().invoke(main, [*words, *asked])
        assert done.exit_code == 0, done.output
        (job,) = served.get("/v1/jobs")["jobs"]
        page = served.http.get(f"/jobs/{job['id']}").text
        for number, side in (("", 0), ("-1", 0), ("-2", 3)):
            picture = served.http.get(f"/jobs/{job['id']}/pictures/own{number}/{side}/after.png")
            assert picture.headers["Content-Type"] == "image/png"
        assert served.http.get(f"/jobs/{job['id']}/pictures/own-3/0/after.png").status_code == 404
        wait_until(lambda: served.http.get("/jobs/new").text.count("<option>pyrender") == 3)  # as soon as all answer
        failed = CliRunner().invoke(main, [*words, "--renderer", "pyrender"])
        assert failed.exit_code == 6
        assert f"--renderer pyrender names several renderers; give one in full: {ours};" in failed.output
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert [(each["renderer"]["settings"], each["attacked"]) for each in result["renderers"]] == [
        ("", True),
        (SHARP_SETTINGS, True),
        (FLAT_SETTINGS, False),
    ]
    assert all(each["held_out"]["a_drop"] >= 0.5 for each in result["renderers"])
    assert result["held_out"]["a_drop"] == min(each["held_out"]["a_drop"] for each in result["renderers"][:2])
    for text in (page, done.output):
        assert "of 2 attacked renderers the one with the smallest A_drop" in text
        assert f"{ours} ({FLAT_SETTINGS}), not attacked: target" in text
