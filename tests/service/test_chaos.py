"""Chaos tests: processes are killed, frozen and stopped while jobs run; all jobs end with the same bytes as without.

Everything is real: processes, databases, renderers, the client, and one in 12 jobs is an attack. A seed draws the
faults, and each failure prints it.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.service.chaos import Digests, Faults, Run, Site, Submission, check_history, is_real
from tests.service.ray_nodes import RayNodes
from trompe_shared.api import JobState

pytestmark = pytest.mark.chaos

logger = logging.getLogger(__name__)

PATIENCE = 1800.0
"""Time limit of a run on a busy machine, seconds."""
SILENCE = 6.0
"""Seconds without a sign of life after which a dispatcher or a worker counts as dead."""
FEW = 40
"""Jobs of a short run."""
SHORT = pytest.mark.timeout(PATIENCE)
LONG = [pytest.mark.slow, pytest.mark.timeout(2 * PATIENCE)]

OpenSite = Callable[..., AbstractContextManager[Site]]


@pytest.fixture(autouse=True)
def _quiet(caplog: pytest.LogCaptureFixture) -> None:
    """Keep the client's requests out of the log."""
    caplog.set_level(logging.WARNING, "httpx")


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Digests]:
    """Digests of the first ``count`` jobs without faults."""

    @cache
    def digests(count: int) -> Digests:
        folder = tmp_path_factory.mktemp("undisturbed")
        url = f"sqlite:///{folder / 'trompe.sqlite'}"
        with Site(folder, url, scattered=False, silence=60, phase_seconds=0) as site:
            submission = Submission(site, count, pause=0)
            submission.wait(seconds=PATIENCE, story=site.log)
            return submission.run().digests

    return digests


@pytest.fixture
def open_site(database_url: str, tmp_path: Path) -> OpenSite:
    """Starts a service: `trompe serve` with children on SQLite, separate processes on PostgreSQL."""
    return lambda **options: Site(
        tmp_path, database_url, scattered=database_url.startswith("postgres"), **{"silence": SILENCE} | options
    )


def check(run: Run, undisturbed: Digests, faults: Faults) -> None:
    """Check that every job succeeded, ended once and made the same bytes as without faults."""
    logger.info("faults: %s", dict(faults.counts))
    wrong = {
        number: [event.message for event in run.events[number] if event.message]
        for number, job in run.jobs.items()
        if job.state is not JobState.succeeded
    }
    assert not wrong, f"not all succeeded: {wrong}\n{faults.story()}"
    histories = {number: check_history(job, run.events[number]) for number, job in run.jobs.items()}
    assert not any(histories.values()), f"{ {k: v for k, v in histories.items() if v} }\n{faults.story()}"
    assert run.jobs.keys() == undisturbed.keys()
    for number, expected in undisturbed.items():
        other = {name for name, _ in expected.items() ^ run.digests[number].items()}
        assert not other, f"job {number} (real: {is_real(number)}) made other {sorted(other)}\n{faults.story()}"


def survive(
    site: Site, faults: Faults, expected: Digests, *, meanwhile: AbstractContextManager[None], pause: float
) -> Run:
    """Submit jobs every ``pause`` seconds, with faults until the last one has ended."""
    with meanwhile:
        submission = Submission(site, len(expected), pause=pause)
        submission.wait(seconds=PATIENCE, story=faults.story)
    run = submission.run()
    check(run, expected, faults)
    return run


def survive_kills(site: Site, expected: Digests, *, every: float, seed: int) -> None:
    """Kill a process, or a node of a cluster, every few seconds until all jobs have ended."""
    faults = Faults(site, seed=seed)
    survive(site, faults, expected, meanwhile=faults.every(every, faults.kill), pause=0.5)
    assert faults.counts.total() >= 5, faults.story()


@pytest.mark.parametrize(
    ("count", "every", "seed"), [pytest.param(FEW, 3.0, 1, marks=SHORT), pytest.param(200, 5.0, 2, marks=LONG)]
)
def test_jobs_end_once_and_alike_whoever_is_killed(
    open_site: OpenSite, undisturbed: Callable[[int], Digests], count: int, every: float, seed: int
) -> None:
    expected = undisturbed(count)
    with open_site(phase_seconds=0.3) as site:
        survive_kills(site, expected, every=every, seed=seed)


@pytest.mark.parametrize(("count", "seed"), [pytest.param(FEW, 5, marks=SHORT), pytest.param(200, 6, marks=LONG)])
def test_jobs_on_a_ray_cluster_end_once_and_alike_whoever_is_killed(
    postgres: Any, tmp_path: Path, undisturbed: Callable[[int], Digests], count: int, seed: int
) -> None:
    """A phase of an attack takes longer there, and a third loss in one phase fails the job."""
    expected, phase_seconds = undisturbed(count), 0.3
    with RayNodes(TROMPE_FAKE_SECONDS=str(phase_seconds), OMP_NUM_THREADS="1") as nodes:
        options: dict[str, Any] = {"scattered": True, "silence": SILENCE, "phase_seconds": phase_seconds}
        with Site(tmp_path, postgres.database(), nodes=nodes, **options) as site:
            survive_kills(site, expected, every=5.0, seed=seed)


@pytest.mark.parametrize(
    ("beyond", "phase_seconds", "seed"),
    [pytest.param(8.0, 0.5, 3, marks=SHORT), pytest.param(45.0, 2.0, 4, marks=LONG)],
)
def test_workers_that_were_frozen_do_no_harm(
    open_site: OpenSite, undisturbed: Callable[[int], Digests], beyond: float, phase_seconds: float, seed: int
) -> None:
    """One worker after another is frozen, so long that its job goes to another worker."""
    expected = undisturbed(FEW)
    with open_site(phase_seconds=phase_seconds) as site:
        faults = Faults(site, seed=seed)
        freezing = faults.every(1.0, lambda: faults.freeze(seconds=SILENCE + beyond))
        run = survive(site, faults, expected, meanwhile=freezing, pause=phase_seconds)
        reasons = [event.message or "" for events in run.events.values() for event in events]
        assert any("no heartbeat for" in reason for reason in reasons), f"nobody lost a job\n{faults.story()}"


@pytest.mark.timeout(PATIENCE)
def test_nothing_is_lost_while_postgresql_is_away(
    postgres: Any, tmp_path: Path, undisturbed: Callable[[int], Digests]
) -> None:
    expected = undisturbed(FEW)
    with Site(tmp_path, postgres.database(), scattered=True, silence=60.0, phase_seconds=0.3) as site:
        faults = Faults(site, seed=0)
        run = survive(site, faults, expected, meanwhile=away(postgres, faults, seconds=10.0), pause=0.7)
        assert faults.counts["PostgreSQL stopped"] == 1
        assert {job.attempts for job in run.jobs.values()} == {1}, f"nobody had died\n{faults.story()}"


@contextmanager
def away(postgres: Any, faults: Faults, *, seconds: float) -> Iterator[None]:
    """Stop PostgreSQL for ``seconds`` during the block."""

    def stop() -> None:
        time.sleep(5.0)
        faults.tell("PostgreSQL stops at once")
        postgres.stop()
        time.sleep(seconds)
        postgres.start()
        faults.tell("PostgreSQL is back")
        faults.counts["PostgreSQL stopped"] += 1

    thread = threading.Thread(target=stop)
    thread.start()
    yield
    thread.join()
