"""Processes of attempts on one node of a cluster, without the cluster."""

import os
import pickle
import signal
from collections.abc import Iterator
from multiprocessing.connection import Client
from pathlib import Path

import pytest

from tests.served import wait_until, workers_of
from tests.service.executors import NAME, Executed
from tests.service.records import claim
from trompe_server.executor import task
from trompe_server.executor.forks import Forks
from trompe_server.executor.process import READY, Setup
from trompe_server.executor.task import run_forked
from trompe_server.queue.leases import DISPATCHER, mark_store, take_lease
from trompe_server.storage.folders import open_folder
from trompe_shared.api import JobState


@pytest.fixture(scope="module")
def forks() -> Forks:
    return Forks()


@pytest.fixture
def executed(tmp_path: Path, renderer: int) -> Iterator[Executed]:
    queue = Executed(tmp_path, "local", renderer)
    yield queue
    queue.store.close()


def test_attempts_of_a_task_share_a_process_until_one_kills_it(
    forks: Forks, executed: Executed, monkeypatch: pytest.MonkeyPatch
) -> None:
    pickled = pickle.dumps(executed.setup)
    others = set(workers_of(os.getpid()))  # of services that other files' tests share

    def run(label: str) -> tuple[str | None, set[int]]:
        executed.submit(label)
        said = run_forked(forks.address, pickled, pickle.dumps(claim(executed.store, "here")))
        return said, set(workers_of(os.getpid())) - others

    (first, its), (second, same), (died, none) = run("fine"), run("fine"), run("deadly")
    assert (first, second, died) == (None, None, "its process died (signal 9)")
    assert len(its) == 1
    assert (same, none) == (its, set())
    assert executed.store.counts()[JobState.succeeded] == 2
    third, new = run("fine")
    assert third is None
    assert new
    (idle,) = new
    os.kill(idle, signal.SIGKILL)
    (kept,) = task._kept.values()
    wait_until(kept.poll)
    assert run("fine")[0] is None, "a process that died between two attempts is no loss"
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    _, other = run("fine")
    assert len(other) == 1, "the one with other devices has ended"


def test_the_process_of_a_dead_task_is_killed_even_if_it_is_frozen(forks: Forks, executed: Executed) -> None:
    before = set(workers_of(os.getpid()))
    with Client(forks.address(), family="AF_UNIX") as task:
        task.send({})
        task.send(executed.setup)
        assert task.recv() == READY
        (frozen,) = set(workers_of(os.getpid())) - before
        os.kill(frozen, signal.SIGSTOP)
    wait_until(lambda: frozen not in workers_of(os.getpid()))


def test_a_node_is_sound_if_it_sees_the_store_and_can_fork(forks: Forks, executed: Executed) -> None:
    take_lease(executed.store.engine, DISPATCHER, holder=NAME, seconds=60)
    assert "does not see the store" in str(forks.fault(executed.setup, NAME))
    mark_store(open_folder(executed.settings.store_url), NAME)
    assert forks.fault(executed.setup, NAME) is None
    elsewhere = executed.settings.model_copy(update={"store": "memory://user:secret@elsewhere"})
    fault = str(forks.fault(Setup(elsewhere, executed.setup.renderers), NAME))
    assert "does not see the store" in fault
    assert "secret" not in fault
    lacking = Setup(executed.settings.model_copy(update={"silence": "soon"}), executed.setup.renderers)
    assert "die before they are ready (status 1)" in str(forks.fault(lacking, NAME))
