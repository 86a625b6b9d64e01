"""What the form foresees: medians of jobs that are alike, and nothing without one."""

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from trompe_server.pages.estimate import estimate
from trompe_server.pages.results import Outcome
from trompe_shared.api import Job, JobSpec, JobState

EFFORT: dict[str, Any] = {"pool": 240, "steps": 25, "epsilon": 0.05}
START = datetime(2026, 1, 31, tzinfo=UTC)


def job(seconds: float, **options: object) -> Job:
    spec = JobSpec.of("mug", label="mug", **(EFFORT | options))
    end = START + timedelta(seconds=seconds)
    return Job(id="1", state=JobState.succeeded, spec=spec, worker=None, created=START, started=START, finished=end)


def test_it_tells_the_medians_of_jobs_that_are_alike() -> None:
    ended = [(job(20), Outcome(0.6, True)), (job(30), Outcome(0.9, True)), (job(70), Outcome(1.0, True))]
    other = [(job(900, steps=300), Outcome(0.1, True)), (job(900, epsilon=0.1), Outcome(0.1, True))]
    words = "About 30 s, A_drop about 0.90 (0.60 to 1.00), as in 3 earlier jobs of this effort."
    assert estimate(ended + other, **EFFORT) == words


@pytest.mark.parametrize(
    "ended",
    [
        pytest.param([], id="no job"),
        pytest.param([(job(9, pool=60), Outcome(0.9, True))], id="another effort"),
        pytest.param([(job(9, grid=True), Outcome(0.9, True))], id="the grid"),
        pytest.param([(job(9), Outcome(None, False))], id="nothing to attack"),
    ],
)
def test_it_tells_nothing_without_a_job_like_it(ended: list[tuple[Job, Outcome]]) -> None:
    assert estimate(ended, **EFFORT) is None
