"""The failure run: while jobs are handed in, processes are killed, frozen and stopped; all jobs end as if nothing were.

Everything is real: processes, databases, renderers, the client, and one job of 12 is an attack. What is killed when is
drawn from a seed, and each failure tells it.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from chaos import Digests, Mischief, Run, Site, Submission, check_history, is_real

from trompe_shared.api import JobState

pytestmark = pytest.mark.chaos

logger = logging.getLogger(__name__)

PATIENCE = 1800.0
"""Seconds that a run may take on a machine that is busy with other things."""
SILENCE = 6.0
"""Seconds after which a worker counts as dead."""
FEW = 40
"""Jobs of a short run."""

OpenSite = Callable[..., AbstractContextManager[Site]]


@pytest.fixture(autouse=True)
def _quiet(caplog: pytest.LogCaptureFixture) -> None:
    """What the client asks is no part of the story."""
    caplog.set_level(logging.WARNING, "httpx")


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Digests]:
    """What comes of so many jobs when nothing happens."""
    known: dict[int, Digests] = {}

    def digests(count: int) -> Digests:
        if count not in known:
            folder = tmp_path_factory.mktemp("undisturbed")
            url = f"sqlite:///{folder / 'trompe.sqlite'}"
            with Site(folder, url, scattered=False, silence=60, dawdle=0) as site:
                submission = Submission(site, count, pause=0)
                submission.wait(seconds=PATIENCE, story=site.log)
                known[count] = submission.run().digests
        return known[count]

    return digests


@pytest.fixture
def open_site(database_url: str, tmp_path: Path) -> OpenSite:
    """Starts a service: on SQLite `trompe serve` with its children, on PostgreSQL each process by itself."""
    return lambda **options: Site(
        tmp_path, database_url, scattered=database_url.startswith("postgres"), **{"silence": SILENCE} | options
    )


def check(run: Run, undisturbed: Digests, mischief: Mischief, site: Site) -> None:
    """Every job succeeded, ended once, and made what it makes when nothing happens."""
    figures = run.figures | dict(mischief.deeds) | {"tracebacks": site.said("Traceback (most recent call last)")}
    logger.info("the run in figures: %s", figures)
    wrong = {
        number: [event.message for event in run.events[number] if event.message]
        for number, job in run.jobs.items()
        if job.state is not JobState.succeeded
    }
    assert not wrong, f"not all succeeded: {wrong}\n{mischief.story()}"
    histories = {number: check_history(job, run.events[number]) for number, job in run.jobs.items()}
    assert not any(histories.values()), f"{ {k: v for k, v in histories.items() if v} }\n{mischief.story()}"
    assert run.jobs.keys() == undisturbed.keys()
    for number, expected in undisturbed.items():
        other = {
            name for name in {*expected, *run.digests[number]} if expected.get(name) != run.digests[number].get(name)
        }
        assert not other, f"job {number} (real: {is_real(number)}) made other {sorted(other)}\n{mischief.story()}"


def survive(
    site: Site, mischief: Mischief, expected: Digests, *, meanwhile: AbstractContextManager[None], pause: float
) -> Run:
    """Hand in jobs, one every ``pause`` seconds; from the first to the end of the last one things happen."""
    with meanwhile:
        submission = Submission(site, len(expected), pause=pause)
        submission.wait(seconds=PATIENCE, story=mischief.story)
    run = submission.run()
    check(run, expected, mischief, site)
    return run


def survive_kills(open_site: OpenSite, expected: Digests, *, every: float, seed: int) -> None:
    """A process is killed every few seconds until all jobs have ended."""
    with open_site(dawdle=0.3) as site:
        mischief = Mischief(site, seed=seed)
        survive(site, mischief, expected, meanwhile=mischief.every(every, mischief.kill), pause=0.5)
        assert mischief.deeds.total() >= 5, mischief.story()


def survive_freezing(open_site: OpenSite, expected: Digests, *, beyond: float, dawdle: float, seed: int) -> None:
    """One worker after the other is frozen, for so long beyond the limit that its job goes to another."""
    with open_site(dawdle=dawdle, silence=4.0) as site:
        mischief = Mischief(site, seed=seed)
        freezing = mischief.every(1.0, lambda: mischief.freeze(seconds=4.0 + beyond))
        run = survive(site, mischief, expected, meanwhile=freezing, pause=dawdle)
        reasons = [event.message or "" for events in run.events.values() for event in events]
        assert any("has been silent for" in reason for reason in reasons), f"nobody lost a job\n{mischief.story()}"
        assert site.said("goes on elsewhere"), f"nobody noticed\n{mischief.story()}"


@pytest.mark.timeout(PATIENCE)
def test_jobs_end_once_and_alike_whoever_is_killed(open_site: OpenSite, undisturbed: Callable[[int], Digests]) -> None:
    survive_kills(open_site, undisturbed(FEW), every=3.0, seed=1)


@pytest.mark.timeout(PATIENCE)
def test_workers_that_were_frozen_do_no_harm(open_site: OpenSite, undisturbed: Callable[[int], Digests]) -> None:
    survive_freezing(open_site, undisturbed(FEW), beyond=8.0, dawdle=0.5, seed=3)


@pytest.mark.timeout(PATIENCE)
def test_nothing_is_lost_while_postgresql_is_away(
    postgres: Any, tmp_path: Path, undisturbed: Callable[[int], Digests]
) -> None:
    expected = undisturbed(FEW)
    with Site(tmp_path, postgres.database(), scattered=True, silence=SILENCE, dawdle=0.3) as site:
        mischief = Mischief(site, seed=0)
        run = survive(site, mischief, expected, meanwhile=away(postgres, mischief, seconds=10.0), pause=0.7)
        assert mischief.deeds["PostgreSQL stopped"] == 1
        assert {job.attempts for job in run.jobs.values()} == {1}, f"nobody had died\n{mischief.story()}"


@contextmanager
def away(postgres: Any, mischief: Mischief, *, seconds: float) -> Iterator[None]:
    """During the block, PostgreSQL is away for so many seconds."""

    def stop() -> None:
        time.sleep(5.0)
        mischief.tell("PostgreSQL stops at once")
        postgres.stop()
        time.sleep(seconds)
        postgres.start()
        mischief.tell("PostgreSQL is back")
        mischief.deeds["PostgreSQL stopped"] += 1

    thread = threading.Thread(target=stop)
    thread.start()
    yield
    thread.join()


@pytest.mark.slow
@pytest.mark.timeout(2 * PATIENCE)
def test_200_jobs_end_once_and_alike_while_a_process_is_killed_every_5_seconds(
    open_site: OpenSite, undisturbed: Callable[[int], Digests]
) -> None:
    survive_kills(open_site, undisturbed(200), every=5.0, seed=2)


@pytest.mark.slow
@pytest.mark.timeout(2 * PATIENCE)
def test_workers_that_were_frozen_for_long_do_no_harm(
    open_site: OpenSite, undisturbed: Callable[[int], Digests]
) -> None:
    survive_freezing(open_site, undisturbed(FEW), beyond=45.0, dawdle=2.0, seed=4)
