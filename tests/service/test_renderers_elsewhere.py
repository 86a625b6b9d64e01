"""``trompe serve`` with renderers that run elsewhere: it uses them, and says which are there."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import FAKE, listening, serving

from trompe_client import Client, ServerFault
from trompe_client._core import Request
from trompe_server.jobs.renderers import Renderers
from trompe_server.jobs.store import JobStore
from trompe_server.jobs.supervisor import Supervisor
from trompe_server.settings import Settings
from trompe_shared.api import JobRequest


@pytest.fixture
def nobody() -> Iterator[int]:
    """A port that refuses connections, and that nobody else gets meanwhile."""
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        yield bound.getsockname()[1]


def supervisor(folder: Path, elsewhere: Renderers) -> Supervisor:
    return Supervisor(Settings(data=folder, renderers=0, workers=0), elsewhere)


def test_those_that_are_listed_and_those_behind_a_name_are_asked(tmp_path: Path, nobody: int) -> None:
    with listening() as first, listening() as second:
        elsewhere = Renderers((("127.0.0.1", first), ("127.0.0.1", nobody)), (("127.0.0.1", second),))
        found = {info.address: info.alive for info in supervisor(tmp_path, elsewhere).renderer_infos()}
    assert found == {f"127.0.0.1:{port}": port != nobody for port in (first, nobody, second)}


def test_a_name_that_nobody_knows_is_no_renderer(tmp_path: Path) -> None:
    lost = supervisor(tmp_path, Renderers(dns=(("renderer.invalid", 8085),)))
    assert lost.renderer_infos() == []
    assert lost.missing() == ["none of the renderer workers elsewhere answers"]


def test_one_of_them_is_enough_and_none_need_be_known(tmp_path: Path, nobody: int) -> None:
    with listening() as port:
        assert supervisor(tmp_path, Renderers((("127.0.0.1", nobody), ("127.0.0.1", port)))).missing() == []
    assert supervisor(tmp_path, Renderers()).missing() == []


def test_workers_of_a_service_without_renderers_use_those_elsewhere(tmp_path: Path, renderer: int, nobody: int) -> None:
    options = ["--renderers", "0", "--renderer", f"127.0.0.1:{renderer}", "--renderer", f"127.0.0.1:{nobody}"]
    environment = {"TROMPE_PIPELINE": FAKE}
    data = tmp_path / "data"
    with (
        serving(data, *options, log=tmp_path / "log", environment=environment) as (_, url),
        Client(url) as client,
    ):
        found = {info.address: info.alive for info in client.renderers()}
        assert found == {f"127.0.0.1:{renderer}": True, f"127.0.0.1:{nobody}": False}
        store = JobStore(Settings(data=data).database_url)
        job = store.create(JobRequest.model_validate({"object": "mug", "label": "fine"}))[0].id
        store.close()
        assert client.job(job).wait(60).status.attempts == 1
        assert b"ready" in client.send(Request("GET", "/readyz", bytes))


def test_a_service_whose_renderers_are_all_away_is_not_ready(tmp_path: Path, nobody: int) -> None:
    options = ["--renderers", "0", "--workers", "0", "--renderer", f"127.0.0.1:{nobody}"]
    with (
        serving(tmp_path / "data", *options, log=tmp_path / "log", environment={}) as (_, url),
        Client(url) as client,
        pytest.raises(ServerFault, match="none of the renderer workers elsewhere answers"),
    ):
        client.send(Request("GET", "/readyz", bytes))
