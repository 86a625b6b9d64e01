"""The whole stack on a real engine, seen from outside: it works, it is closed, and it survives what is killed in it.

The tests share one stack and come in order: each leaves it whole for the next.
"""

import hashlib
import logging
import re
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

import httpx
import pytest

from tests import served
from tests.compose.conftest import Stack, docker
from trompe_client import Client, JobHandle, Unauthorized
from trompe_shared.api import JobState, Result
from trompe_shared.shipped import shipped_objects

pytestmark = [pytest.mark.compose, pytest.mark.timeout(1800)]

SERVICES: Final = ("api", "worker", "renderer", "postgres")
LIMIT: Final = 900 * 10**6
"""Bytes that the renderer's image may have."""
QUICK: Final[dict[str, Any]] = {"label": "mug", "classifier": "tiny", "steps": 4, "pool": 8, "held_out": 4}
LONG: Final[dict[str, Any]] = QUICK | {"steps": 150, "seed": 7}
"""A job that lasts for some time in its attack, and that ends alike, whatever happens to it on the way."""
PATIENCE: Final = 400.0

wait_until = partial(served.wait_until, pause=0.3)

logger = logging.getLogger(__name__)


def finish(job: JobHandle) -> Result:
    """The result of a job that ended well, and once."""
    job.wait(PATIENCE)
    events = list(job.events())
    assert [event.id for event in events] == list(range(1, len(events) + 1))
    assert [event.state for event in events if event.state.final] == [JobState.succeeded]
    logger.info("job %s succeeded on %s, attempt %d", job.id, job.refresh().worker, job.status.attempts)
    return job.result()


Outcome = tuple[dict[str, Any], str]


def outcome(job: JobHandle, folder: Path) -> Outcome:
    """What a job that ended well found, but for what depends on the clock or on earlier jobs, and its object's hash."""
    result = finish(job)
    job.download(folder)
    found = result.model_dump(exclude={"seconds", "versions", "probe_renders", "surrogate_reason"})
    return found, hashlib.sha256((folder / "mug-adversarial.zip").read_bytes()).hexdigest()


def in_the_attack(job: JobHandle) -> bool:
    status = job.refresh()
    assert not status.state.final, status
    return status.progress.phase == "attack" and status.progress.fraction > 0.45


def begin(client: Client) -> JobHandle:
    """A long job, in the middle of its attack."""
    job = client.attack("mug", **LONG)
    wait_until(lambda: in_the_attack(job), seconds=PATIENCE)
    return job


def host_of(client: Client, job: JobHandle) -> str:
    """The container that runs a job."""
    (host,) = [worker.host for worker in client.workers() if worker.id == job.refresh().worker]
    return host


def kill_process(stack: Stack, container: str) -> None:
    """End what runs in a container as a crash would; the engine starts the container anew."""
    stack.run_in(container, "sh", "-c", "kill -9 $(cat /proc/1/task/1/children)", check=False)


@pytest.fixture
def client(stack: Stack) -> Iterator[Client]:
    with stack.client() as found:
        yield found


@pytest.fixture(scope="module")
def undisturbed(stack: Stack, tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """What comes of the long job when nothing is killed."""
    with stack.client() as client:
        return outcome(client.attack("mug", **LONG), tmp_path_factory.mktemp("undisturbed"))


IMAGES: Final = ("renderer", "server", "worker", "cluster")


def test_the_images_are_small_and_hold_no_tools_and_the_renderer_no_torch(built: Stack) -> None:
    assert int(docker("image", "inspect", built.image("renderer"), "--format", "{{.Size}}")) < LIMIT
    for name in IMAGES:
        run = ("run", "--rm", "--network", "none", "--entrypoint", "sh", built.image(name), "-c")
        assert docker(*run, "id -u; command -v gcc cc make git; ls /opt/trompe/bin | grep pip; true") == "10001"
        packages = docker(*run, "ls /opt/trompe/lib/python3.11/site-packages").split()
        assert ("torch" in packages) == (name != "renderer")


def test_the_api_wants_a_token_and_says_without_one_only_whether_it_is_up(stack: Stack) -> None:
    url = f"http://127.0.0.1:{stack.environment['TROMPE_PORT']}"
    assert httpx.get(f"{url}/healthz", timeout=60).status_code == 200
    for path in ("/v1/jobs", "/v1/objects", "/v1/workers", "/metrics"):
        assert httpx.get(url + path, timeout=60).status_code == 401, path
    with stack.client(token="trompe_wrong") as stranger, pytest.raises(Unauthorized):
        stranger.attack("mug", **QUICK)
    assert re.fullmatch(r"trompe_[\w-]{40,}", stack.token)


def test_secrets_are_in_no_log_and_in_nothing_that_the_engine_tells(stack: Stack) -> None:
    password = stack.run_in(stack.containers("postgres")[0], "cat", "/secrets/database/database-password")
    told = stack.compose("logs", "--no-color") + "".join(docker("inspect", each) for each in stack.everything())
    assert len(password) > 20
    assert password not in told
    assert stack.token not in told


def test_a_job_from_outside_attacks_an_uploaded_object_and_brings_its_files(
    stack: Stack, client: Client, tmp_path: Path
) -> None:
    mine = tmp_path / "mine.zip"
    mine.write_bytes(shipped_objects()["mug"].read())
    job = client.attack(mine, **QUICK)
    result = finish(job)
    files = {path.name for path in job.download(tmp_path / "out")}
    assert result.target.a_before is not None
    assert {"mine-adversarial.zip", "result.json", "contact_sheet.png"} <= files


POWERLESS: Final = dict.fromkeys(("CapInh", "CapPrm", "CapEff", "CapBnd"), "0" * 16) | {"NoNewPrivs": "1"}


@pytest.mark.parametrize("service", SERVICES)
def test_nothing_runs_as_root_or_can_become_root_or_write_the_root_of_its_container(stack: Stack, service: str) -> None:
    (container,) = stack.containers(service)
    top = [line.split() for line in docker("top", container, "-eo", "pid,uid,comm").splitlines()[1:]]
    assert top
    assert all(int(uid) != 0 for _, uid, *_ in top), top
    status = stack.run_in(container, "cat", "/proc/self/status")
    assert POWERLESS.items() <= dict(line.split(":\t", 1) for line in status.splitlines()).items()
    tried = stack.run_in(container, "sh", "-c", "for f in /x /opt/x /usr/bin/x /etc/x; do touch $f 2>&1; done; true")
    assert tried.count("Read-only file system") == 4, tried


CONNECT: Final = "import socket, sys; socket.create_connection((sys.argv[1], int(sys.argv[2])), 10)"


def reaches(stack: Stack, container: str, host: str, port: int) -> bool:
    return "yes" in stack.run_in(container, "sh", "-c", f"python -c '{CONNECT}' {host} {port} && echo yes", check=False)


def address(stack: Stack, container: str, network: str) -> str:
    found = stack.inspect(container)["NetworkSettings"]["Networks"]
    return str(next(each["IPAddress"] for name, each in found.items() if name.endswith(f"_{network}")))


def test_only_the_api_is_reached_from_outside_and_the_renderer_reaches_nobody(stack: Stack) -> None:
    (api,), (worker,), (renderer,), (postgres,) = (stack.containers(service) for service in SERVICES)
    assert reaches(stack, worker, "renderer", 8085)
    assert reaches(stack, worker, "postgres", 5432)
    assert not reaches(stack, renderer, address(stack, postgres, "state"), 5432)
    assert not reaches(stack, renderer, "postgres", 5432)
    for port, target in ((8085, address(stack, renderer, "render")), (5432, address(stack, postgres, "state"))):
        stranger = ("run", "--rm", "--entrypoint", "python", stack.image("server"), "-c", CONNECT, target, str(port))
        with pytest.raises(AssertionError, match=r"TimeoutError|timed out|unreachable|refused"):
            docker(*stranger)
    assert reaches(stack, api, "renderer", 8085)


def received(stack: Stack, container: str) -> int:
    """Bytes that a container was sent so far."""
    return int(stack.run_in(container, "cat", "/proc/net/dev").split("eth0:")[1].split()[0])


def test_renderers_are_scaled_and_share_the_work_and_a_second_worker_waits(stack: Stack, client: Client) -> None:
    stack.up(worker=2, renderer=3)
    jobs = [client.attack("mug", **QUICK | {"seed": seed}) for seed in range(6)]
    for job in jobs:
        finish(job)
    assert len({job.refresh().worker for job in jobs}) == 1
    heard = [received(stack, each) for each in stack.containers("renderer")]
    assert len(heard) == 3
    assert min(heard) > 50_000, heard
    wait_until(lambda: [each.alive for each in client.renderers()] == [True] * 3)


def test_a_renderer_that_dies_in_mid_job_costs_only_time(stack: Stack, client: Client) -> None:
    job = client.attack("mug", **LONG | {"pool": 30})
    wait_until(lambda: job.refresh().progress.phase not in {"queued"}, seconds=PATIENCE)
    first = stack.containers("renderer")[0]
    docker("kill", first)
    finish(job)
    assert job.refresh().attempts == 1
    docker("start", first)


def test_a_worker_that_crashes_in_mid_job_is_started_again_and_the_job_ends_alike(
    stack: Stack, client: Client, undisturbed: Outcome, tmp_path: Path
) -> None:
    job = begin(client)
    container = host_of(client, job)
    kill_process(stack, container)
    assert outcome(job, tmp_path) == undisturbed
    assert job.refresh().attempts == 2
    wait_until(lambda: stack.inspect(container)["State"]["Running"])
    assert stack.inspect(container)["RestartCount"] == 1


def test_the_job_of_a_worker_that_is_gone_for_good_goes_to_another(
    stack: Stack, client: Client, undisturbed: Outcome, tmp_path: Path
) -> None:
    job = begin(client)
    gone = host_of(client, job)
    docker("kill", gone)
    assert outcome(job, tmp_path) == undisturbed
    assert job.refresh().attempts == 2
    assert job.status.worker is not None
    assert not job.status.worker.startswith(gone)
    docker("start", gone)


def test_a_restart_of_the_database_in_mid_job_loses_nothing(
    stack: Stack, client: Client, undisturbed: Outcome, tmp_path: Path
) -> None:
    job = begin(client)
    docker("kill", stack.containers("postgres")[0])
    time.sleep(2)
    stack.up(worker=2, renderer=3)
    assert outcome(job, tmp_path) == undisturbed
    assert job.refresh().attempts == 1


def test_the_api_may_die_while_a_client_waits(
    stack: Stack, client: Client, undisturbed: Outcome, tmp_path: Path
) -> None:
    job = begin(client)
    kill_process(stack, stack.containers("api")[0])
    assert outcome(job, tmp_path) == undisturbed
    assert job.refresh().attempts == 1


def test_nothing_is_lost_when_all_is_taken_down_and_brought_up_again(stack: Stack, tmp_path: Path) -> None:
    with stack.client() as client:
        before = {job.id: job.status for job in client.jobs()}
        newest = next(iter(client.jobs()))
        newest.download(tmp_path / "before")
        objects = client.objects()
    stack.compose("down", "--timeout", "30")
    stack.up()
    with stack.client() as client:
        assert {job.id: job.status for job in client.jobs()} == before
        assert client.objects() == objects
        client.job(newest.id).download(tmp_path / "after")
    files = sorted(path.name for path in (tmp_path / "before").iterdir())
    assert files
    for name in files:
        assert (tmp_path / "after" / name).read_bytes() == (tmp_path / "before" / name).read_bytes()


def test_the_same_stack_keeps_its_files_in_an_object_store(stack: Stack, tmp_path: Path) -> None:
    kept = stack.renewed(COMPOSE_PROFILES="s3", TROMPE_STORE="s3://trompe")
    kept.up()
    with kept.client() as client:
        job = client.attack("mug", **QUICK)
        finish(job)
        assert {path.name for path in job.download(tmp_path)} == set(job.refresh().artifacts)
    (worker,) = kept.containers("worker")
    assert job.id not in stack.run_in(worker, "find", "/data", "-name", "*")


def test_the_same_jobs_run_on_a_ray_cluster_and_outlive_one_of_its_nodes(
    stack: Stack, undisturbed: Outcome, tmp_path: Path
) -> None:
    cluster = stack.renewed(COMPOSE_PROFILES="cluster")
    cluster.up(worker=0)
    with cluster.client() as client:
        wait_until(lambda: sum(each.alive and each.fault is None for each in client.workers()) == 2, seconds=PATIENCE)
        job = begin(client)
        node = host_of(client, job)
        assert node in {container[:12] for container in cluster.containers("ray-node")}
        docker("kill", node)
        assert outcome(job, tmp_path) == undisturbed
        assert job.refresh().attempts == 2
        assert host_of(client, job) != node
