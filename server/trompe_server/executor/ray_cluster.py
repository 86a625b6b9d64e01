"""Attempts on a Ray cluster (the extra ``cluster``). Imports ray only here, when it is chosen."""

import logging
import os
import pickle
import socket
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final

from trompe_server.errors import ServiceError
from trompe_server.executor.forks import Forks
from trompe_server.executor.port import Ended, fits, left_in, too_much
from trompe_server.executor.process import Setup
from trompe_server.executor.task import run_task
from trompe_server.queue.claims import Claim
from trompe_server.queue.workers import Worker
from trompe_server.system.memory import GIB
from trompe_shared.addresses import host_and_port
from trompe_shared.api import Needs

logger = logging.getLogger(__name__)

ENVIRONMENT: Final = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_AUTH_MODE": "token",
    "RAY_CLIENT_RECONNECT_GRACE_PERIOD": "5",
    "RAY_DEDUP_LOGS": "0",
}
"""Ray reads it at its import. After the grace period, in seconds, the tasks of a dead dispatcher end."""
ANSWER: Final = 5.0
"""Seconds the cluster has to accept a connection."""
LOOK: Final = 1.0
"""Seconds between two looks at the nodes."""
RECHECK: Final = 30.0
"""Seconds until a faulty node is checked again."""
MOST_DEMANDED: Final = 1000
"""Jobs of one kind of needs that the autoscaler is told at most."""
OBJECT_STORE: Final = 80 * 2**20
"""Bytes of Ray's object store on one machine; attempts pass nothing through it."""


@dataclass
class _Node:
    """A node of the cluster with its actor ``Forks``.

    ``check``: the running check of store and database; ``fault``: what it found.
    """

    id: str
    name: str
    host: str
    room: Needs
    forks: Any
    check: Any
    fault: str | None = "its check of store and database has not ended"
    checked: float = 0.0


class RayExecutor:
    """An ``Executor`` on the cluster named by the settings. ``mark``: name of the dispatcher with the lease.

    Ray places nothing by itself: an attempt goes to the node that ``place`` chose, as a task without retries, named
    ``job/attempt``. The task holds the resources while the attempt runs in a process forked by the node's ``Forks``.
    Raises ``ServiceError`` if the cluster cannot be used.
    """

    def __init__(self, setup: Setup, *, mark: str) -> None:
        self._setup, self._mark = setup, mark
        devices = {device: setup.settings.model_copy(update={"device": device}) for device in ("cpu", "cuda")}
        self._setups = {device: pickle.dumps(replace(setup, settings=own)) for device, own in devices.items()}
        self._address = setup.settings.executor
        self._ray = _connected(self._address, setup.settings.workers)
        self._run = self._ray.remote(max_retries=0)(run_task)
        self._forks = self._ray.remote(num_cpus=0, max_restarts=-1, max_task_retries=-1)(Forks)
        self._demand = self._ray.remote(max_retries=0, num_cpus=0)(_request)
        self._nodes: dict[str, _Node] = {}
        self._attempts: dict[Any, Claim] = {}
        self._cancelled: set[Any] = set()
        self._demanded: list[dict[str, float]] = []
        self._looked = 0.0
        with self._translated():
            self._look()

    def place(self, needs: Needs) -> str | None:
        rooms = [(node, self._left(node)) for node in self._nodes.values() if node.fault is None]
        free = [(node, left) for node, left in rooms if fits(needs, left)]
        if not free:
            return None
        return min(free, key=lambda each: (not needs.gpu and each[0].room.gpu > 0, -each[1].cpu))[0].name

    def submit(self, claim: Claim) -> None:
        needs = claim.job.needs
        node = next(node for node in self._nodes.values() if node.name == claim.job.worker)
        setup = self._setups["cuda" if needs.gpu else "cpu"]
        with self._translated():
            task = self._run.options(
                name=f"{claim.job.id}/{claim.attempt}",
                num_cpus=needs.cpu,
                num_gpus=needs.gpu,
                memory=needs.memory * GIB or None,
                scheduling_strategy=self._at(node.id),
            ).remote(node.forks, setup, pickle.dumps(claim))
        self._attempts[task] = claim

    def cancel(self, claim: Claim) -> None:
        for task, attempt in self._attempts.items():
            if attempt == claim:
                self._cancelled.add(task)  # a frozen one holds its room until it wakes
                with self._translated():
                    self._ray.cancel(task, force=True)

    def ended(self, timeout: float) -> list[Ended]:
        with self._translated():
            if time.monotonic() - self._looked > LOOK:
                self._look()
            checks = {node.check: node for node in self._nodes.values() if node.check is not None}
            done = self._done([*self._attempts, *checks], timeout)
            for task in done:
                if task in checks:
                    self._end_check(checks[task])
            return [end for task in done if task in self._attempts and (end := self._end(task)) is not None]

    def workers(self) -> list[Worker]:
        return [Worker(node.name, node.host, str(node.room), node.fault) for node in self._nodes.values()]

    def unmet(self, waiting: Mapping[Needs, int]) -> dict[Needs, str]:
        self._tell_autoscaler(waiting)
        if any(node.check is not None for node in self._nodes.values()):
            return {}  # not known yet
        sound = [node.room for node in self._nodes.values() if node.fault is None]
        faults = "".join(f" {node.name}: {node.fault}." for node in self._nodes.values() if node.fault is not None)
        large = [needs for needs in waiting if not any(fits(needs, room) for room in sound)]
        return {needs: too_much(needs, sound) + faults for needs in large}

    def close(self) -> None:
        with self._translated():
            self._ray.shutdown()

    def _left(self, node: _Node) -> Needs:
        return left_in(node.room, (claim for claim in self._attempts.values() if claim.job.worker == node.name))

    def _look(self) -> None:
        """Learn which nodes live, and check new ones, and faulty ones again."""
        self._looked = time.monotonic()
        living = {told["NodeID"]: told for told in self._ray.nodes() if told["Alive"]}
        self._nodes = {id: node for id, node in self._nodes.items() if id in living}
        for id, told in living.items():
            room = _room(told["Resources"])
            if id not in self._nodes and (room.cpu or room.gpu):
                host = str(told["NodeManagerHostname"])
                forks = self._forks.options(scheduling_strategy=self._at(id)).remote()
                self._nodes[id] = _Node(id, f"{host}-{id[:6]}", host, room, forks, self._start_check(forks))
        for node in self._nodes.values():
            if node.check is None and node.fault is not None and self._looked - node.checked > RECHECK:
                node.check = self._start_check(node.forks)

    def _start_check(self, forks: Any) -> Any:
        return forks.fault.remote(self._setup, self._mark)

    def _at(self, node: str) -> Any:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        return NodeAffinitySchedulingStrategy(node, soft=False)

    def _doubt(self, name: str | None) -> None:
        """Check a node where an attempt died before its next attempt: Ray may learn later that the node is gone."""
        for node in self._nodes.values():
            if node.name == name and node.check is None:
                node.fault, node.check = "an attempt died there; it is checked again", self._start_check(node.forks)

    def _end_check(self, node: _Node) -> None:
        try:
            node.fault = self._ray.get(node.check)
        except self._ray.exceptions.RayError as error:
            node.fault = f"the check of store and database failed ({_first_line(error)})"
        node.check, node.checked = None, time.monotonic()
        if node.fault is not None:
            logger.error("no job can run on %s: %s", node.name, node.fault)

    def _done(self, tasks: list[Any], timeout: float) -> list[Any]:
        if not tasks:
            time.sleep(timeout)
            return []
        done, _ = self._ray.wait(tasks, num_returns=1, timeout=timeout)
        if done:
            done, _ = self._ray.wait(tasks, num_returns=len(tasks), timeout=0)
        return list(done)

    def _end(self, task: Any) -> Ended | None:
        claim, cancelled = self._attempts.pop(task), task in self._cancelled
        self._cancelled.discard(task)
        try:
            reason: str | None = self._ray.get(task)
            reason = reason and f"{claim.job.worker}: {reason}"
        except self._ray.exceptions.RayError as error:
            reason = f"{claim.job.worker} died ({_first_line(error)})"
            self._doubt(claim.job.worker)
        return None if cancelled else Ended(claim, reason)

    def _tell_autoscaler(self, waiting: Mapping[Needs, int]) -> None:
        running = [_bundle(claim.job.needs) for claim in self._attempts.values()]
        wanted = [_bundle(needs) for needs, count in waiting.items() for _ in range(min(count, MOST_DEMANDED))]
        if (demand := running + wanted) != self._demanded:
            self._demanded = demand
            with self._translated():
                self._demand.remote(demand)

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """Translate the loss of the cluster to ``ServiceError``."""
        try:
            yield
        except (ConnectionError, RuntimeError, self._ray.exceptions.RayError) as error:
            raise ServiceError(
                f"The Ray cluster {self._address} was lost ({_first_line(error)}). Jobs continue when it answers again."
            ) from error


def _connected(address: str, workers: int) -> Any:
    """The module ray, connected to the cluster."""
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError as error:
        raise ServiceError("Ray is not installed: pip install 'trompe[cluster]', or use --executor local.") from error
    if ray.is_initialized():
        ray.shutdown()
    if address != "ray-local":
        _connect(address)
        return ray
    ray.init(
        address="local",  # otherwise it may join a cluster that somebody left behind
        num_cpus=workers,
        include_dashboard=False,
        object_store_memory=OBJECT_STORE,
        logging_level=logging.ERROR,
    )
    return ray


def _connect(address: str) -> None:
    from ray.util.client_connect import connect

    place = address.removeprefix("ray://")
    _check_there(address, place)
    try:
        with warnings.catch_warnings(action="ignore"):
            connect(place, connection_retries=1, ray_init_kwargs={"logging_level": logging.ERROR})
    except RuntimeError as error:
        raise ServiceError(
            f"The Ray cluster {address} has other versions: Ray and Python must be the same on all nodes and here "
            f"({_first_line(error)})."
        ) from error
    except Exception as error:
        raise ServiceError(
            f"The Ray cluster {address} refuses us ({_first_line(error)}). Set RAY_AUTH_TOKEN, or the file "
            "~/.ray/auth_token, to the cluster's token, and check that this is the port of its client server (10001)."
        ) from error


def _check_there(address: str, place: str) -> None:
    try:
        socket.create_connection(host_and_port(place), timeout=ANSWER).close()
    except (OSError, ValueError) as error:
        raise ServiceError(
            f"No Ray cluster answers at {address} ({error}). Start its head with: ray start --head "
            "--ray-client-server-port 10001; or name another one by TROMPE_EXECUTOR."
        ) from error


def _request(bundles: list[dict[str, float]]) -> None:
    from ray.autoscaler.sdk import request_resources

    request_resources(bundles=bundles)


def _bundle(needs: Needs) -> dict[str, float]:
    amounts = {"CPU": needs.cpu, "GPU": needs.gpu, "memory": needs.memory * GIB}
    return {name: amount for name, amount in amounts.items() if amount}


def _room(resources: Mapping[str, float]) -> Needs:
    memory = resources.get("memory", 0.0) / GIB
    return Needs(cpu=resources.get("CPU", 0.0), gpu=resources.get("GPU", 0.0), memory=round(memory, 1))


def _first_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[0][:300]}" if lines else type(error).__name__
