"""What both clients promise, over a fake and a real ``trompe serve``, and the quickstart over the real one."""

import asyncio
import inspect
import json
import re
import secrets
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.documentation import blocks, readers_environment
from trompe_client import (
    AsyncClient,
    AsyncJobHandle,
    BadRequest,
    Client,
    Conflict,
    JobCancelled,
    JobHandle,
    NotFound,
    Outcome,
)
from trompe_shared.api import MANIFEST, MANIFEST_PAGE, JobRequest, JobSpec, JobState, Manifest
from trompe_shared.errors import SpecError

FEW: dict[str, Any] = {"grid": True, "azimuths": 2, "elevations": 1, "held_out": 1, "steps": 1, "surrogate": "diffuse"}
"""Options of a job of seconds."""
ENDLESS = FEW | {"steps": 10_000, "epsilon": 0.004}
"""With so little that it does not win all views and end early."""
QUICKSTART = {heading: code for language in ("python", "sh") for heading, code in blocks("quickstart.md", language)}


class Blocking:
    """An asynchronous client or handle, to be used like the blocking one."""

    def __init__(self, inner: Any, loop: asyncio.AbstractEventLoop) -> None:
        self.inner, self.loop = inner, loop

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.inner, name)
        return (lambda *args, **options: self.settle(found(*args, **options))) if callable(found) else found

    def settle(self, value: Any) -> Any:
        """What comes of an awaitable, or of an asynchronous iterator, handles wrapped."""
        if inspect.isawaitable(value):
            return self.wrap(self.loop.run_until_complete(value))
        return self.steps(value) if hasattr(value, "__aiter__") else value

    def steps(self, values: Any) -> Iterator[Any]:
        try:
            while True:
                yield self.wrap(self.loop.run_until_complete(anext(values)))
        except StopAsyncIteration:
            pass
        finally:
            self.loop.run_until_complete(values.aclose())

    def wrap(self, value: Any) -> Any:
        if isinstance(value, Outcome):
            return value.of(self.wrap)
        return Blocking(value, self.loop) if isinstance(value, AsyncJobHandle) else value


@pytest.fixture(params=["fake", "real"])
def address(request: pytest.FixtureRequest) -> str:
    if request.param == "real":
        return str(request.getfixturevalue("service"))
    fake = request.getfixturevalue("server")
    fake.when_listed = fake.finish_all
    return str(fake.url)


@pytest.fixture(params=[Client, AsyncClient])
def client(request: pytest.FixtureRequest, address: str) -> Iterator[Any]:
    if request.param is Client:
        with Client(address) as connected:
            yield connected
        return
    with asyncio.Runner() as runner:
        asynchronous = AsyncClient(address)
        yield Blocking(asynchronous, runner.get_loop())
        runner.run(asynchronous.close())


@pytest.fixture
def name() -> str:
    """A name that no other test on the same server has used."""
    return secrets.token_hex(8)


def test_a_job_from_its_submission_to_its_files(client: Any, tmp_path: Path) -> None:
    job = client.attack("mug", label="mug", epsilon=0.1, labels={"who": "me"}, priority="interactive", **FEW)
    assert job.state in {JobState.queued, JobState.running}
    job.wait(timeout=120)
    assert job.state is JobState.succeeded
    assert (job.status.labels, job.status.priority) == ({"who": "me"}, "interactive")
    result = job.result()
    assert (result.epsilon, result.target.views > 0) == (0.1, True)
    (tmp_path / "result.json").write_text("older")
    paths = job.download(tmp_path)
    assert [path.relative_to(tmp_path).as_posix() for path in paths] == job.status.artifacts
    assert json.loads((tmp_path / "result.json").read_text())["epsilon"] == 0.1
    with zipfile.ZipFile(job.archive(tmp_path / "all.zip")) as archive:
        assert archive.testzip() is None
    events = list(client.job(job.id).events())
    assert [event.id for event in events] == list(range(1, len(events) + 1))
    assert (events[0].state, events[-1].state) == (JobState.queued, JobState.succeeded)


def test_a_judgement_from_its_submission_to_its_manifest(client: Any, tmp_path: Path) -> None:
    job = client.judge("mug", "mug", label="mug", networks="tiny", epsilon=0.05, views=4, labels={"who": "me"})
    with pytest.raises(Conflict, match=r"queued|running|No result"):
        job.manifest()
    job.wait(timeout=120)
    manifest = job.manifest()
    found = manifest.cell("pyrender", "tiny")
    assert found is not None
    assert (manifest.epsilon, manifest.before.source, job.status.labels) == (0.05, "mug", {"who": "me"})
    paths = job.download(tmp_path)
    assert {MANIFEST, MANIFEST_PAGE} <= {path.name for path in paths}
    assert Manifest.model_validate_json((tmp_path / MANIFEST).read_bytes()) == manifest
    assert job.id in {each.id for each in client.jobs(labels={"who": "me"})}
    with pytest.raises(SpecError, match="fixes views and seed"):
        client.judge("mug", "mug", label="mug", suite="standard-1", views=4)


def test_a_key_makes_one_job(client: Any, name: str) -> None:
    first = client.attack("mug", label="mug", key=name, **FEW)
    assert client.submit(first.status.spec, key=name).id == first.id
    with pytest.raises(Conflict):
        client.attack("mug", label="mug", key=name, **FEW | {"seed": 5})
    first.wait(timeout=120)


def test_a_cancelled_job_can_be_submitted_anew_and_deleted(client: Any) -> None:
    job = client.attack("mug", label="mug", labels={"who": "them"}, **ENDLESS)
    with pytest.raises(Conflict):
        job.delete()
    with pytest.raises(Conflict, match=r"queued|running"):
        job.result()
    job.cancel()
    with pytest.raises(JobCancelled) as caught:
        job.wait(timeout=60)
    assert caught.value.job_id == job.id
    anew = job.retry()
    assert anew.id != job.id
    assert anew.status.spec == job.status.spec
    assert anew.status.labels == {"who": "them"}
    anew.cancel()
    job.delete()
    with pytest.raises(NotFound):
        job.refresh()


def test_jobs_are_found_by_state_label_object_and_classifier(client: Any, name: str) -> None:
    label = {"test": name}
    jobs = [client.attack("mug", label="mug", labels=label, seed=seed, **FEW) for seed in range(3)]
    assert [job.id for job in client.jobs(labels=label)] == [job.id for job in reversed(jobs)]
    assert [job.id for job in client.jobs(labels={"test": f"not {name}"})] == []
    for job in jobs:
        job.cancel()
        with pytest.raises(JobCancelled):
            job.wait(timeout=60)
    ended = client.jobs(labels=label, state="cancelled", object="mug", classifier="tiny")
    assert {job.id for job in ended} == {job.id for job in jobs}
    assert list(client.jobs(labels=label, state="failed")) == []


def test_many_jobs_come_back_with_results_and_errors(client: Any, name: str) -> None:
    one = {"object": "mug", "label": "mug", **FEW}
    request = JobRequest.of(**one, labels={"own": "label"}, priority="sweep")
    lost = JobSpec.of("mug", label="mug").model_copy(update={"object": "no such"})
    attacks = [one | {"seed": 1}, one | {"object": "no such"}, request, lost]
    outcomes = {outcome.index: outcome for outcome in client.map(attacks, batch=name)}
    assert sorted(outcomes) == [0, 1, 2, 3]
    assert isinstance(outcomes[1].error, NotFound)
    assert isinstance(outcomes[3].error, NotFound)
    assert [outcomes[index].result.seed for index in (0, 2)] == [1, 0]
    queued = outcomes[2].job.status
    assert (queued.labels, queued.priority) == ({"own": "label", "batch": name}, "sweep")
    again = {outcome.index: outcome for outcome in client.map(attacks, batch=name)}
    assert [again[index].job.id for index in (0, 2)] == [outcomes[index].job.id for index in (0, 2)]


def test_what_is_stored_and_what_does_the_work(client: Any, mug_folder: Path) -> None:
    assert "mug" in {one.name for one in client.objects()}
    assert "tiny" in {one.name for one in client.classifiers()}
    assert [worker.alive for worker in client.workers()] == [True]
    assert [renderer.alive for renderer in client.renderers()] == [True]
    assert isinstance(client.backgrounds(), list)


def test_what_is_wrong_says_so_with_the_ids(client: Any) -> None:
    with pytest.raises(NotFound) as caught:
        client.job("no-such-job")
    assert (caught.value.status, caught.value.job_id) == (404, "no-such-job")
    assert caught.value.request_id
    with pytest.raises((BadRequest, NotFound)):
        client.attack("no such object", label=0)


@pytest.mark.parametrize(("blocking", "asynchronous"), [(Client, AsyncClient), (JobHandle, AsyncJobHandle)])
def test_both_clients_have_the_same_methods_with_the_same_arguments(blocking: type, asynchronous: type) -> None:
    def arguments(kind: type) -> dict[str, list[str]]:
        members = inspect.getmembers(kind, inspect.isfunction)
        public = {name: member for name, member in members if not name.startswith("_")}
        return {name: list(map(str, inspect.signature(method).parameters.values())) for name, method in public.items()}

    assert arguments(blocking) == arguments(asynchronous)


def test_both_clients_are_made_alike() -> None:
    assert str(inspect.signature(Client)) == str(inspect.signature(AsyncClient))


def test_the_quickstart_starts_the_service_that_these_tests_start() -> None:
    first, second, *_ = (code for _, code in blocks("quickstart.md", "sh"))
    assert (first, second) == ("pip install 'trompe[server]'\n", "trompe serve\n")


PYTHON, BASH = [sys.executable, "-W", "error", "-c"], ["bash", "-euo", "pipefail", "-c"]


@pytest.mark.parametrize(
    ("heading", "program", "said"),
    [
        ("Python", PYTHON, r"\Arecognised in \d+% of the views before, in \d+% after\n\Z"),
        pytest.param("Command line", BASH, r"target \(own views\)", marks=pytest.mark.thorough),
        pytest.param("curl", BASH, "event: progress", marks=pytest.mark.thorough),
    ],
    ids=["Python", "command line", "curl"],
)
def test_the_quickstart_runs(heading: str, program: list[str], said: str, service: str, tmp_path: Path) -> None:
    environment = readers_environment(TROMPE_SERVER=service)
    options: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 240}
    done = subprocess.run([*program, QUICKSTART[heading]], cwd=tmp_path, env=environment, **options)
    assert done.returncode == 0, done.stderr
    assert re.search(said, done.stdout)
    (out,) = tmp_path.glob("out-*")
    assert (out / "mug-adversarial.zip").read_bytes()[:2] == b"PK"
    assert '"texels_altered"' in (out / "result.json").read_text()
