"""``map``: many jobs, given as they end."""

from pathlib import Path
from typing import Any

import pytest

from tests.client.conftest import FakeServer
from trompe_client import Client, JobFailed, NotFound
from trompe_client._many import BATCH
from trompe_shared.api import JobSpec, JobState

GRID = [{"object": "mug", "label": "mug", "epsilon": epsilon, "seed": k} for k, epsilon in enumerate([0.02, 0.05, 0.1])]


@pytest.fixture
def working(server: FakeServer, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A server whose oldest waiting job ends with every look at the list."""
    ended: list[str] = []

    def finish_one() -> None:
        waiting = [job.id for job in server.jobs.values() if not job.state.final]
        if waiting:
            server.reach(waiting[0], server.history[waiting[0]][-1])
            ended.append(waiting[0])

    server.when_listed, server.page_size = finish_one, 50
    return ended


def test_results_come_as_the_jobs_end_and_know_which_attack_they_are_of(client: Client, working: list[str]) -> None:
    outcomes: list[Any] = list(client.map(GRID))
    assert [outcome.job.id for outcome in outcomes] == working
    for outcome in outcomes:
        assert outcome.error is None
        assert outcome.result.epsilon == GRID[outcome.index]["epsilon"]
        assert outcome.job.state is JobState.succeeded


@pytest.mark.usefixtures("working")
def test_errors_are_values(client: Client, server: FakeServer) -> None:
    wrong: list[Any] = [
        {"object": "muggg", "label": 0},
        {"object": "mug", "label": 0, "epsilon": 7.0},
        {"object": "nowhere.zip", "label": 0},
        {"label": 0},
        {"object": ["mug"], "label": 0},
        JobSpec.of("mug", label=0),
    ]
    found: dict[int, Any] = {outcome.index: outcome for outcome in client.map(wrong)}
    codes = ["not-found", "invalid-spec", "invalid-object", "invalid-spec", "invalid-spec"]
    assert [found[index].error.code for index in range(5)] == codes
    assert [found[index].job for index in range(5)] == [None] * 5
    assert "got ['mug']" in str(found[4].error)
    assert found[5].result.label == 3
    server.ending = JobState.failed
    (failed,) = client.map(wrong[5:])
    assert isinstance(failed.error, JobFailed)
    assert failed.job is not None
    assert failed.error.job_id == failed.job.id


@pytest.mark.parametrize("batch", ["b", "größe"])
def test_the_same_batch_again_finds_its_jobs(
    batch: str, client: Client, server: FakeServer, working: list[str]
) -> None:
    def ids(**options: Any) -> dict[int, str]:
        return {outcome.index: outcome.job.id for outcome in client.map(GRID, **options) if outcome.job}

    first = ids(batch=batch)
    assert len(first) == len(GRID)
    assert ids(batch=batch) == first
    assert len(server.jobs) == len(GRID)
    assert [job.id for job in client.jobs(labels={BATCH: batch})] == list(server.jobs)[::-1]
    assert not set(ids().values()) & set(first.values())


@pytest.mark.usefixtures("working")
def test_a_file_that_several_name_is_uploaded_once(
    client: Client, server: FakeServer, mug_folder: Path, tmp_path: Path
) -> None:
    net, picture = tmp_path / "net.pt2", tmp_path / "room.png"
    net.write_bytes(b"pt2")
    picture.write_bytes(b"png")
    one = {"object": mug_folder, "label": 0, "classifier": net, "judges": [net, "tiny"], "background": [picture]}
    outcomes = list(client.map([one | {"seed": seed} for seed in range(4)]))
    assert [outcome.error for outcome in outcomes] == [None] * 4
    uploads = [path for method, path, _ in server.requests if method == "POST" and path != "/v1/jobs"]
    assert sorted(uploads) == ["/v1/backgrounds", "/v1/classifiers", "/v1/objects"]
    specs = [job.spec.model_dump(exclude={"search"}) for job in server.jobs.values()]
    assert specs == [specs[0]] * 4
    assert specs[0]["judges"]["networks"] == [specs[0]["victim"]["classifier"], "tiny"]


def test_a_job_that_somebody_deletes_is_an_error_and_the_others_go_on(
    client: Client, server: FakeServer, working: list[str]
) -> None:
    outcomes = client.map(GRID)
    first = next(outcomes)
    gone = next(job.id for job in server.jobs.values() if not job.state.final)
    del server.jobs[gone]
    rest = list(outcomes)
    assert len(rest) == 2
    (lost,) = [outcome for outcome in rest if outcome.error]
    assert isinstance(lost.error, NotFound)
    assert lost.job is not None
    assert lost.job.id == gone
    assert first.error is None


@pytest.mark.usefixtures("working")
def test_a_server_that_is_away_for_a_moment_is_waited_for(client: Client, server: FakeServer) -> None:
    outcomes = client.map(GRID)
    next(outcomes)
    server.refusals = [(503, {})] * 12
    assert [outcome.error for outcome in outcomes] == [None, None]


def test_nothing_to_do_is_done_at_once(client: Client, server: FakeServer) -> None:
    assert list(client.map([])) == []
    assert server.requests == []
