"""The record of jobs on both databases: submit, list, claim, report, end, and never twice."""

import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from trompe_server.errors import ConflictError, NotFoundError, ServiceError
from trompe_server.queue import migrations
from trompe_server.queue.claims import Claim, Claims, Ending, LostJobError
from trompe_server.queue.leases import take_lease
from trompe_server.queue.migrations import HEAD
from trompe_server.queue.store import JobStore
from trompe_server.queue.tables import jobs, metadata, workers
from trompe_server.queue.workers import WorkerRegistry
from trompe_server.storage import tokens
from trompe_server.storage.database import write
from trompe_shared.api import JobRequest, JobState, Progress
from trompe_shared.errors import SpecError

DONE = Ending(JobState.succeeded, note="done")
HALF = Progress(phase="attack", fraction=0.5)


def request(**options: Any) -> JobRequest:
    return JobRequest.of(**{"object": "mug", "label": "mug"} | options)


def create(store: JobStore, **options: Any) -> str:
    return store.create(request(**options))[0].id


def claims_of(store: JobStore, name: str = "w") -> Claims:
    return Claims(store.engine, name)


def claim(store: JobStore, name: str = "w", needs: tuple[str, ...] = ("any", "cpu")) -> Claim:
    found = claims_of(store, name).claim(needs)
    assert found is not None
    return found


def fall_silent(store: JobStore, name: str, *, seconds: float = 100.0) -> None:
    """Make the last heartbeat of a worker old."""
    with write(store.engine) as connection:
        connection.execute(workers.update().where(workers.c.id == name).values(seen=workers.c.seen - seconds))


def registry(store: JobStore, name: str) -> WorkerRegistry:
    return WorkerRegistry(store.engine, name, device="cpu")


def test_a_job_is_kept_as_it_was_asked_for(store: JobStore) -> None:
    asked = request(priority="sweep", labels={"a": "1", "b": "two words"}, needs="cuda", epsilon=0.1)
    job, new = store.create(asked)
    assert new
    assert job == store.get(job.id)
    assert (job.state, job.spec, job.priority, job.labels) == ("queued", asked.spec(), "sweep", asked.labels)
    assert (job.needs, job.attempts, job.worker, job.started) == ("cuda", 0, None, None)
    assert abs(job.created.timestamp() - time.time()) < 60


def test_an_unknown_job_is_refused(store: JobStore) -> None:
    for call in (store.get, store.request_cancel, store.delete):
        with pytest.raises(NotFoundError, match="no job 'x'"):
            call("x")


def test_the_same_idempotency_key_gives_the_same_job_however_many_ask_at_once(store: JobStore) -> None:
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda _: store.create(request(), idempotency_key="k"), range(16)))
    assert len({job.id for job, _ in made}) == 1
    assert [new for _, new in made].count(True) == 1
    with pytest.raises(ConflictError, match="'k' was used with another request"):
        store.create(request(epsilon=0.2), idempotency_key="k")
    assert store.create(request(), idempotency_key="l")[1]


def test_pages_walk_through_all_jobs_newest_first(store: JobStore) -> None:
    made = [create(store) for _ in range(5)]
    first = store.page(limit=2)
    second = store.page(limit=2, cursor=first.next_cursor)
    last = store.page(limit=2, cursor=second.next_cursor)
    assert [job.id for page in (first, second, last) for job in page.jobs] == made[::-1]
    assert last.next_cursor is None
    for wrong in ("x", "-1", "٣", "9" * 30):
        with pytest.raises(SpecError, match="not a cursor"):
            store.page(cursor=wrong)


def test_filters_are_met_all_at_once(store: JobStore) -> None:
    create(store, labels={"who": "ann"})
    both = create(store, labels={"who": "ann", "run": "7"}, classifier="net")
    create(store, labels={"who": "bob", "run": "7"}, object="cup")

    def found(**filters: Any) -> list[str]:
        return [job.id for job in store.page(**filters).jobs]

    assert found(labels={"who": "ann", "run": "7"}) == [both]
    assert len(found(labels={"run": "7"})) == len(found(labels={"who": "ann"})) == 2
    assert found(labels={"who": "7"}) == found(labels={"nobody": "x"}) == []
    assert found(classifier="net") == found(classifier="net", object="mug", state=JobState.queued) == [both]
    assert found(object="cup", state=JobState.running) == []


def test_groups_count_jobs_by_the_value_of_a_label(store: JobStore) -> None:
    for run in ("old", "new", "new"):
        create(store, labels={"run": run})
    create(store)
    taken = claim(store)
    groups = store.groups("run")
    assert [(group.value, sum(group.counts.values())) for group in groups] == [("new", 2), ("old", 1)]
    assert groups[1].counts == {JobState.running: 1}
    assert groups[1].created == taken.job.created


def test_jobs_are_taken_by_priority_then_by_age(store: JobStore) -> None:
    made = {name: create(store, priority=name) for name in ("sweep", "normal", "interactive")}
    later = create(store)
    order = [claim(store, f"w{number}").job.id for number in range(4)]
    assert order == [made["interactive"], made["normal"], later, made["sweep"]]


@pytest.mark.parametrize("change", [{"priority": 11}, {"spec": {"object": "mug", "glitter": 3}}])
def test_a_malformed_row_is_an_error(store: JobStore, change: dict[str, Any]) -> None:
    job = create(store)
    with write(store.engine) as connection:
        connection.execute(jobs.update().where(jobs.c.id == job).values(change))
    with pytest.raises(ValidationError):
        store.get(job)


def test_a_worker_takes_what_it_can_serve_and_no_more(store: JobStore) -> None:
    cuda, either, cpu = (create(store, needs=needs) for needs in ("cuda", "any", "cpu"))
    assert claim(store, "c", ("any", "cpu")).job.id == either
    assert claim(store, "d", ("any", "cpu")).job.id == cpu
    assert claims_of(store, "e").claim(("any", "cpu")) is None
    assert claim(store, "f", ("any", "cuda")).job.id == cuda


def test_many_workers_take_each_job_once(store: JobStore) -> None:
    made = {create(store) for _ in range(30)}
    taken: list[str] = []

    def work(name: str) -> None:
        mine = claims_of(store, name)
        while (found := mine.claim(("any",))) is not None:
            taken.append(found.job.id)
            mine.finish(found, DONE)

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(work, [f"w{number}" for number in range(6)]))
    assert len(taken) == 30
    assert set(taken) == made
    assert store.counts()[JobState.succeeded] == 30


def test_a_claim_whose_answer_was_lost_is_given_again(store: JobStore) -> None:
    create(store)
    create(store)
    assert claim(store) == claim(store)
    assert store.counts()[JobState.running] == 1


def test_events_tell_the_whole_story_and_their_ids_grow_by_one(store: JobStore) -> None:
    job = create(store)
    taken = claim(store)
    mine = claims_of(store)
    threads = [threading.Thread(target=lambda: [mine.advance(taken, HALF) for _ in range(5)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    mine.finish(taken, DONE)
    events = store.events(job)
    assert [event.id for event in events] == list(range(1, 24))
    assert [event.message for event in events if event.message] == ["queued", "started", "done"]
    assert [event.state for event in (events[0], events[1], events[-1])] == ["queued", "running", "succeeded"]
    assert [event.id for event in store.events(job, after=21)] == [22, 23]


def test_phases_that_are_done_are_remembered_with_their_artifacts(store: JobStore) -> None:
    job = create(store)
    mine, taken = claims_of(store), claim(store)
    mine.advance(taken, HALF, done=1, public=("a.png",))
    mine.advance(taken, HALF, done=2, public=("a.png", "b.png"))
    mine.give_back(taken)
    again = claim(store, "other")
    assert (again.done, again.attempt, again.job.worker) == (2, 2, "other")
    assert store.get(job).artifacts == ["a.png", "b.png"]


def test_whoever_lost_a_job_can_write_nothing_more(store: JobStore) -> None:
    job = create(store)
    registry(store, "frozen").register()
    frozen, old = claims_of(store, "frozen"), claim(store, "frozen")
    fall_silent(store, "frozen")
    assert registry(store, "healthy").reap(30) == [job]
    new = claim(store, "healthy")
    before = store.get(job), store.events(job)
    for write_late in (
        lambda: frozen.advance(old, Progress(phase="late", fraction=0.9), done=9),
        lambda: frozen.finish(old, DONE),
        lambda: frozen.give_back(old),
    ):
        with pytest.raises(LostJobError, match=r"Attempt 1 of job .* is over"):
            write_late()
    assert (store.get(job), store.events(job)) == before
    assert not frozen.holds(old)
    assert claims_of(store, "healthy").holds(new)
    claims_of(store, "healthy").finish(new, DONE)
    with pytest.raises(LostJobError):
        frozen.finish(old, Ending(JobState.failed, error="late"))
    assert store.get(job).state is JobState.succeeded


def test_ending_a_job_twice_is_as_good_as_once(store: JobStore) -> None:
    job = create(store)
    taken = claim(store)
    claims_of(store).finish(taken, DONE)
    ended = store.get(job), store.events(job)
    claims_of(store).finish(taken, DONE)
    assert (store.get(job), store.events(job)) == ended
    assert store.request_cancel(job) == ended[0]


def test_a_job_that_three_workers_died_of_is_failed_with_the_reason(store: JobStore) -> None:
    job = create(store)
    for _ in range(3):
        registry(store, "w").register()
        claim(store)
    registry(store, "w").register()
    found = store.get(job)
    assert (found.state, found.attempts) == (JobState.failed, 3)
    assert found.error is not None
    assert "3 workers died" in found.error
    assert "w died and was restarted" in found.error
    assert found.finished is not None


def test_a_job_that_gets_on_outlives_any_number_of_workers(store: JobStore) -> None:
    job = create(store)
    for done in range(1, 6):
        for _ in range(2):
            registry(store, "w").register()
            taken = claim(store)
        claims_of(store, "w").advance(taken, Progress(phase="attack", fraction=0.1), done=done)
    claims_of(store, "w").finish(taken, DONE)
    assert (store.get(job).state, store.get(job).attempts) == (JobState.succeeded, 10)


def test_a_job_given_back_does_not_count_as_lost(store: JobStore) -> None:
    job = create(store)
    for _ in range(5):
        claims_of(store).give_back(claim(store))
    claims_of(store).finish(claim(store), DONE)
    assert (store.get(job).state, store.get(job).attempts) == (JobState.succeeded, 6)


def test_only_the_silent_lose_their_jobs(store: JobStore) -> None:
    jobs = {name: create(store) for name in ("alive", "dead", "struck off")}
    for name in jobs:
        registry(store, name).register()
        claim(store, name)
    fall_silent(store, "dead")
    registry(store, "struck off").unregister()
    assert set(registry(store, "alive").reap(30)) == {jobs["dead"], jobs["struck off"]}
    assert store.get(jobs["alive"]).state is JobState.running
    assert registry(store, "alive").reap(30) == []


def test_two_reapers_at_once_count_a_lost_attempt_once(store: JobStore) -> None:
    job = create(store)
    registry(store, "dead").register()
    claim(store, "dead")
    fall_silent(store, "dead")
    with ThreadPoolExecutor(4) as pool:
        reaped = list(pool.map(lambda number: registry(store, f"r{number}").reap(30), range(4)))
    assert sorted(map(len, reaped)) == [0, 0, 0, 1]
    lost = [event for event in store.events(job) if event.message and "heartbeat" in event.message]
    assert len(lost) == 1


def test_a_job_that_was_to_be_cancelled_when_its_worker_died_is_cancelled(store: JobStore) -> None:
    job = create(store)
    registry(store, "w").register()
    taken = claim(store)
    assert store.request_cancel(job).state is JobState.running
    assert claims_of(store).advance(taken, HALF)
    fall_silent(store, "w")
    registry(store, "other").reap(30)
    assert store.get(job).state is JobState.cancelled


def test_workers_are_listed_with_what_they_do(store: JobStore) -> None:
    registry(store, "a").register()
    registry(store, "b").register()
    registry(store, "a").beat("job1")
    registry(store, "b").beat(None)
    fall_silent(store, "b")
    infos = store.workers()
    assert [(info.id, info.alive, info.job, info.device) for info in infos] == [
        ("a", True, "job1", "cpu"),
        ("b", False, None, "cpu"),
    ]
    registry(store, "b").beat(None)
    assert all(info.alive for info in store.workers())


def test_statistics_count_jobs_and_tell_how_long_the_oldest_waits(store: JobStore) -> None:
    assert store.statistics().oldest_queued == 0
    assert store.statistics().jobs == dict.fromkeys(JobState, 0)
    create(store)
    create(store)
    claim(store)
    statistics = store.statistics()
    assert (statistics.jobs[JobState.queued], statistics.jobs[JobState.running]) == (1, 1)
    assert 0 <= statistics.oldest_queued < 60


def test_only_jobs_that_have_ended_are_deleted_and_nothing_of_them_stays(store: JobStore) -> None:
    job = create(store, labels={"a": "b"})
    with pytest.raises(ConflictError, match="only ended jobs"):
        store.delete(job)
    claims_of(store).finish(claim(store), DONE)
    assert store.ended_before(3600) == []
    assert store.ended_before(-1) == [job]
    store.delete(job)
    with pytest.raises(NotFoundError):
        store.get(job)
    assert store.events(job) == []
    assert store.page(labels={"a": "b"}).jobs == []
    with store.engine.connect() as connection:
        assert connection.execute(sa.text("SELECT count(*) FROM job_labels")).scalar_one() == 0


def test_work_for_one_is_given_to_one_until_its_time_is_over(store: JobStore) -> None:
    with ThreadPoolExecutor(4) as pool:
        given = list(pool.map(lambda _: take_lease(store.engine, "retention", seconds=60), range(4)))
    assert given.count(True) == 1
    assert not take_lease(store.engine, "retention", seconds=0)
    with write(store.engine) as connection:
        connection.execute(sa.text("UPDATE leases SET until = 0"))
    assert take_lease(store.engine, "retention", seconds=60)


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(
    moves=st.lists(st.sampled_from(["claim", "advance", "finish", "give back", "die", "reap", "cancel"]), max_size=25)
)
def test_whatever_happens_a_job_is_held_by_one_and_ends_once(store: JobStore, moves: list[str]) -> None:
    """Two workers play with one job; the one whose claim is older never gets anything through."""
    job = create(store)
    names = ("left", "right")
    for name in names:
        registry(store, name).register()
    claims: dict[str, Claim] = {}
    endings = 0
    for number, move in enumerate(moves):
        name = names[number % 2]
        mine, held = claims_of(store, name), claims.get(name)
        current = held is not None and mine.holds(held)
        if move == "claim" and not current:
            taken = mine.claim(("any",))
            claims |= {name: taken} if taken is not None and taken.job.id == job else {}
        elif move in {"advance", "finish", "give back"} and held is not None:
            write_it: dict[str, Callable[[], object]] = {
                "advance": partial(mine.advance, held, HALF),
                "finish": partial(mine.finish, held, DONE),
                "give back": partial(mine.give_back, held),
            }
            if current:
                write_it[move]()
                endings += move == "finish"
            elif not (move == "finish" and store.get(job).attempts == held.attempt and store.get(job).state.final):
                with pytest.raises(LostJobError):
                    write_it[move]()
        elif move == "die":
            fall_silent(store, name)
        elif move == "reap":
            registry(store, name).reap(30)
            registry(store, name).beat(None)
        elif move == "cancel":
            store.request_cancel(job)
        holders = [each for each in names if each in claims and claims_of(store, each).holds(claims[each])]
        found = store.get(job)
        assert len(holders) == (found.state is JobState.running)
        assert endings <= 1
        assert [event.id for event in store.events(job)] == list(range(1, len(store.events(job)) + 1))


def test_the_migrated_tables_are_those_of_the_code(store: JobStore) -> None:
    with store.engine.connect() as connection:
        context = MigrationContext.configure(connection)
        assert compare_metadata(context, [metadata, tokens.metadata]) == []  # type: ignore[arg-type]
        assert context.get_current_revision() == HEAD
    assert ScriptDirectory(str(Path(migrations.__file__).parent)).get_current_head() == HEAD


def test_processes_that_migrate_at_once_make_the_tables_once(database_url: str) -> None:
    code = "import sys; from trompe_server.queue.store import JobStore; JobStore(sys.argv[1]).migrate()"
    processes = [subprocess.Popen([sys.executable, "-c", code, database_url], stderr=subprocess.PIPE) for _ in range(3)]
    assert [process.communicate()[1] for process in processes] == [b""] * 3
    store = JobStore(database_url)
    job = create(store)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: store.migrate(), range(4)))
    assert store.get(job).state is JobState.queued
    store.close()


def test_the_tables_of_an_earlier_version_are_upgraded_with_their_jobs(store: JobStore) -> None:
    job = create(store)
    with write(store.engine) as connection:
        for statement in ("ALTER TABLE jobs DROP COLUMN names", "UPDATE alembic_version SET version_num = '1'"):
            connection.exec_driver_sql(statement)
    store.migrate()
    assert store.get(job).names == {}
    assert store.get(store.create(request(), names={"0af3": "cup"})[0].id).names == {"0af3": "cup"}


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        pytest.param("DROP TABLE alembic_version", r"made by Trompe 0\.1.*--data.*keep Trompe 0\.1", id="0.1"),
        pytest.param("UPDATE alembic_version SET version_num = '99'", "cannot be upgraded.*'99'", id="newer"),
    ],
)
def test_tables_of_another_version_are_refused_and_stay(store: JobStore, statement: str, message: str) -> None:
    job = create(store)
    with write(store.engine) as connection:
        connection.exec_driver_sql(statement)
    with pytest.raises(ServiceError, match=message):
        store.migrate()
    assert store.get(job).id == job
