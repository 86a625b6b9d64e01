"""``trompe serve`` with renderers elsewhere: it uses and lists them."""

import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from tests.served import Served, command_line, process_table, reserved_port, wait_until
from tests.service.processes import listening
from trompe_client import Client, ServerFault
from trompe_client._core import Request
from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.service.supervisor import Supervisor
from trompe_server.settings import Settings


@pytest.fixture
def nobody() -> Iterator[int]:
    """A port that refuses connections and stays reserved."""
    with reserved_port() as port:
        yield port


def supervisor(folder: Path, elsewhere: RendererAddresses) -> Supervisor:
    return Supervisor(Settings(data=folder, renderers=0, workers=0), elsewhere)


def test_those_that_are_listed_and_those_behind_a_name_are_asked(tmp_path: Path, nobody: int) -> None:
    with listening() as first, listening() as second:
        elsewhere = RendererAddresses((("127.0.0.1", first), ("127.0.0.1", nobody)), (("127.0.0.1", second),))
        found = {info.address: info.alive for info in supervisor(tmp_path, elsewhere).renderer_infos()}
    assert found == {f"127.0.0.1:{port}": port != nobody for port in (first, nobody, second)}


def test_a_name_that_nobody_knows_is_no_renderer(tmp_path: Path) -> None:
    lost = supervisor(tmp_path, RendererAddresses(dns=(("renderer.invalid", 8085),)))
    assert lost.renderer_infos() == []
    assert lost.missing() == ["no renderer worker elsewhere answers"]


def test_one_of_them_is_enough_and_none_need_be_known(tmp_path: Path, nobody: int) -> None:
    with listening() as port:
        assert supervisor(tmp_path, RendererAddresses((("127.0.0.1", nobody), ("127.0.0.1", port)))).missing() == []
    assert supervisor(tmp_path, RendererAddresses()).missing() == []


def test_a_renderer_is_restarted_and_stopped_whatever_its_engine_prints_and_leaves_behind() -> None:
    service = Supervisor(Settings(engine="tests.renderer_worker.noisy_engine:Talkative"), RendererAddresses())
    with closing(service):
        service.start()
        (worker,) = (pid for pid in children(os.getpid()) if "render" in command_line(pid))
        helpers = children(worker)
        assert helpers
        os.kill(worker, signal.SIGKILL)
        wait_until(lambda: not service.missing() and not {worker, *helpers} & process_table().keys())


def test_a_renderer_that_hangs_is_told_and_replaced() -> None:
    service = Supervisor(Settings(silence=3), RendererAddresses())
    with closing(service):
        service.start()
        (worker,) = (pid for pid in children(os.getpid()) if "render" in command_line(pid))
        os.kill(worker, signal.SIGSTOP)
        wait_until(lambda: service.missing() == ["a renderer worker does not answer"])
        assert not any(info.alive for info in service.renderer_infos())
        wait_until(lambda: not service.missing() and worker not in process_table())
        wait_until(lambda: [info.alive for info in service.renderer_infos()] == [True])


def children(process: int) -> list[int]:
    return [pid for pid, parent in process_table().items() if parent == process]


def test_workers_of_a_service_use_renderers_elsewhere_and_it_is_not_ready_once_all_are_away(
    tmp_path: Path, nobody: int
) -> None:
    with ExitStack() as elsewhere:
        renderer = elsewhere.enter_context(listening())
        options = ["--renderers", "0", "--renderer", f"127.0.0.1:{renderer}", "--renderer", f"127.0.0.1:{nobody}"]
        with Served(tmp_path / "data", *options) as served, Client(served.url) as client:
            found = {info.address: info.alive for info in client.renderers()}
            assert found == {f"127.0.0.1:{renderer}": True, f"127.0.0.1:{nobody}": False}
            assert client.job(served.submit("fine")).wait(120).status.attempts == 1
            assert b"ready" in client.send(Request("GET", "/readyz", bytes))
            elsewhere.close()
            with pytest.raises(ServerFault, match="no renderer worker elsewhere answers"):
                client.send(Request("GET", "/readyz", bytes))
