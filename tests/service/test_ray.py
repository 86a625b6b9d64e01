"""A Ray cluster of three nodes that fails, and one that cannot be used."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.fake_job import trace
from tests.served import reserved_port, wait_until
from tests.service.executors import NAME, Executed
from tests.service.ray_nodes import RayNodes, task_of
from trompe_server.errors import ServiceError
from trompe_server.queue.leases import MARKS
from trompe_server.storage.folders import open_folder
from trompe_shared.api import JobState

pytestmark = pytest.mark.cluster

CLEAR = 10.0
"""Seconds until a fault is told."""

Open = Callable[..., Executed]


@pytest.fixture
def queue(ray_access: None, tmp_path: Path, renderer: int) -> Iterator[Open]:
    opened: list[Executed] = []

    def open_queue(address: str, **settings: float) -> Executed:
        opened.append(Executed(tmp_path, address, renderer, **settings))
        return opened[-1]

    yield open_queue
    for each in opened:
        each.store.close()


def test_the_job_of_a_frozen_process_goes_on_elsewhere_and_the_process_does_no_harm(
    cluster: RayNodes, queue: Open
) -> None:
    executed = queue(cluster.address, silence=5.0)
    job = executed.submit("gate")
    with executed.dispatching():
        wait_until(lambda: executed.in_gate(job))
        process, task = int((executed.folder(job) / "process").read_text()), task_of(job)
        first = executed.state(job).worker
        for frozen in (task, process):
            os.kill(frozen, signal.SIGSTOP)
        wait_until(lambda: executed.state(job).attempts == 2 and executed.in_gate(job))
        assert executed.state(job).worker != first, "a frozen task holds its room"
        executed.open_gate(job)
        (ended,) = executed.ended(job)
        result = (executed.folder(job) / "2" / "result.json").read_bytes()
        wait_until(lambda: not any(Path(f"/proc/{each}").exists() for each in (task, process)))  # Ray and the node kill
        after = [executed.submit("fine", seed=number) for number in range(6)]
        executed.ended(*after)
    assert (ended.state, ended.attempts) == (JobState.succeeded, 2)
    assert "no heartbeat for 5 s" in "".join(event.message or "" for event in executed.store.events(job))
    assert (executed.folder(job) / "2" / "result.json").read_bytes() == result
    assert trace(executed.folder(job)).count("end judge") == 1


def test_the_job_of_a_killed_process_and_of_a_killed_node_goes_on_at_its_phase(cluster: RayNodes, queue: Open) -> None:
    executed = queue(cluster.address)
    job = executed.submit("gate")
    with executed.dispatching():
        wait_until(lambda: executed.in_gate(job))
        os.kill(task_of(job), signal.SIGKILL)
        wait_until(lambda: executed.state(job).attempts == 2 and executed.in_gate(job))
        place = str(executed.state(job).worker)
        (node,) = [node for node in cluster.nodes if place.endswith(node[:6])]
        cluster.kill(node)
        wait_until(lambda: executed.state(job).attempts == 3 and executed.in_gate(job))
        assert executed.state(job).worker != place
        executed.open_gate(job)
        (ended,) = executed.ended(job)
        cluster.add()
        wait_until(lambda: sum(worker.alive and not worker.fault for worker in executed.store.workers()) >= 3)
    assert (ended.state, ended.attempts) == (JobState.succeeded, 3)
    assert trace(executed.folder(job)).count("begin prepare") == 1


def test_a_node_without_the_store_gets_no_job_and_says_so(cluster: RayNodes, queue: Open) -> None:
    executed = queue(cluster.address, silence=4.0)
    with executed.dispatching():
        wait_until(lambda: executed.ended(executed.submit("fine")))
        open_folder(executed.settings.store_url).within(MARKS).delete(NAME)  # as if the new node had another folder
        node = cluster.add(num_gpus=4)
        job = executed.submit("fine", needs={"gpu": 3})
        wait_until(lambda: "does not see the store" in str(executed.state(job).note), seconds=CLEAR + 20)
        (faulty,) = [worker for worker in executed.store.workers() if "gpu 4" in worker.device]
        assert "does not see the store" in str(faulty.fault)
        assert executed.state(job).state is JobState.queued
        cluster.kill(node)


def refusal(executed: Executed) -> str:
    """The sentence that refuses the executor."""
    started = time.monotonic()
    with pytest.raises(ServiceError) as refused:
        executed.open()
    assert time.monotonic() - started < 2 * CLEAR
    return str(refused.value)


def test_a_cluster_that_is_not_there_is_told_with_the_remedy_while_the_job_waits(queue: Open) -> None:
    with reserved_port() as port:
        executed = queue(f"ray://127.0.0.1:{port}")
        assert "No Ray cluster answers at" in refusal(executed)
        job = executed.submit("fine")
        with executed.dispatching() as dispatcher:
            assert "ray start --head" in str(dispatcher.fault)
            assert executed.state(job).state is JobState.queued


def test_a_port_that_is_no_cluster_is_told(queue: Open) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:  # its backlog accepts
        port = silent.getsockname()[1]
        assert "refuses us" in refusal(queue(f"ray://127.0.0.1:{port}"))


OPEN = """
import sys
from pathlib import Path
from tests.service.executors import Executed
import trompe_server.executor.ray_cluster
{change}
try:
    Executed(Path(sys.argv[1]), sys.argv[2], 1).open()
except Exception as error:
    print(type(error).__name__, error)
"""


@pytest.mark.parametrize(
    ("change", "token", "said"),
    [
        pytest.param("", "w" * 32, "ServiceError .* refuses us .*RAY_AUTH_TOKEN", id="wrong token"),
        pytest.param(
            "import ray; ray.__version__ = '2.0.0'", None, "ServiceError .*must be the same", id="other version"
        ),
    ],
)
def test_a_wrong_token_and_another_version_are_told(
    cluster: RayNodes, tmp_path: Path, change: str, token: str | None, said: str
) -> None:
    environment = os.environ | ({"RAY_AUTH_TOKEN": token} if token else {})
    command = [sys.executable, "-c", OPEN.format(change=change), str(tmp_path), cluster.address]
    started = time.monotonic()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert re.search(said, done.stdout, re.DOTALL), done.stdout + done.stderr
    assert time.monotonic() - started < 3 * CLEAR
