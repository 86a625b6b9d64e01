"""The record of jobs on both databases: submit, list, claim, report, end, and never twice."""

import subprocess
import sys
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

from tests.service.records import DONE, claim, claims_of, create, request
from trompe_server.errors import ConflictError, NotFoundError, ServiceError
from trompe_server.queue import migrations
from trompe_server.queue.claims import ALONE_AFTER, MAX_ORPHANED, START_ALLOWANCE, Claim, Claims, Ending, LostJobError
from trompe_server.queue.leases import end_lease, take_lease
from trompe_server.queue.migrations import HEAD
from trompe_server.queue.store import JobStore
from trompe_server.queue.tables import events, jobs, metadata, workers
from trompe_server.queue.workers import Worker, forget_workers, record_workers
from trompe_server.storage import tokens
from trompe_server.storage.database import DatabaseDownError, write
from trompe_shared.api import JobState, Needs, Progress
from trompe_shared.errors import SpecError

HALF = Progress(phase="attack", fraction=0.5)


def test_a_job_is_kept_as_it_was_asked_for(store: JobStore) -> None:
    asked = request(priority="sweep", labels={"a": "1", "b": "two words"}, needs={"gpu": 0.5}, epsilon=0.1)
    job, new = store.create(asked)
    assert new
    assert job == store.get(job.id)
    assert (job.state, job.spec, job.priority, job.labels) == ("queued", asked.spec(), "sweep", asked.labels)
    assert (job.needs, job.attempts, job.worker, job.started) == (Needs(gpu=0.5), 0, None, None)
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


def test_experiments_count_jobs_by_state(store: JobStore) -> None:
    for name in ("old", "new", "new"):
        create(store, labels={"experiment": name})
    create(store)
    taken = claim(store)
    groups = store.experiments()
    assert [(group.name, sum(group.jobs.values())) for group in groups] == [("new", 2), ("old", 1)]
    assert groups[1].jobs == {JobState.running: 1}
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


def test_each_need_is_told_once_first_that_of_the_next_job_and_claimed_by_itself(store: JobStore) -> None:
    many = [create(store, needs={"gpu": 1}, priority="sweep") for _ in range(3)]
    plain = create(store)
    half = create(store, needs={"gpu": 0.5, "cpu": 0}, priority="interactive")
    claims, gpu, share = claims_of(store), Needs(gpu=1), Needs(gpu=0.5, cpu=0)
    assert claims.waiting() == {gpu: 3, Needs(): 1, share: 1}
    assert claims.upcoming() == [share, Needs(), gpu]
    taken = [claims.claim(needs, "w") for needs in (gpu, gpu, Needs(), share)]
    assert [each.job.id for each in taken if each] == [*many[:2], plain, half]
    assert claims.claim(share, "w") is None
    assert claims.upcoming() == [gpu]


def test_many_claimers_take_each_job_once(store: JobStore) -> None:
    made = {create(store) for _ in range(30)}
    taken: list[str] = []

    def work(name: str) -> None:
        mine = claims_of(store)
        while mine.upcoming():
            if (found := mine.claim(Needs(), name)) is not None:
                taken.append(found.job.id)
                mine.finish(found, DONE)

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(work, [f"w{number}" for number in range(6)]))
    assert len(taken) == 30
    assert set(taken) == made
    assert store.counts()[JobState.succeeded] == 30


def test_a_claim_whose_answer_was_lost_is_a_running_job_that_nobody_knows(store: JobStore) -> None:
    forgotten, known = create(store), create(store)
    claim(store)
    mine = {known: claim(store)}
    assert claims_of(store).lose_unknown(mine, "nobody runs it") == [forgotten]
    assert claims_of(store).lose_unknown(mine, "nobody runs it") == []
    assert store.get(forgotten).state is JobState.queued
    assert store.get(known).state is JobState.running


def test_queued_jobs_are_told_once_why_they_wait_and_forget_it_when_they_run(store: JobStore) -> None:
    large, small = create(store, needs={"gpu": 8}), create(store)
    for _ in range(2):
        claims_of(store).explain({Needs(gpu=8): "too large"})
    assert [event.message for event in store.events(large)] == ["queued", "too large"]
    assert (store.get(large).note, store.get(small).note) == ("too large", None)
    assert claims_of(store).claim(Needs(gpu=8), "w") is not None
    assert store.get(large).note is None


def test_a_running_job_without_events_stands_still(store: JobStore) -> None:
    still, lively = create(store), create(store)
    claim(store)
    taken = claim(store)
    with write(store.engine) as connection:
        connection.execute(events.update().values(time=events.c.time - 100))
    claims_of(store).advance(taken, HALF)
    assert claims_of(store).still(50) == {still: 1}
    assert claims_of(store).still(200) == {}
    assert lively == taken.job.id


def test_an_attempt_whose_heartbeats_stop_is_silent_and_the_next_one_begins_anew(store: JobStore) -> None:
    create(store)
    taken = claim(store)
    assert claims_of(store).silent(0) == {}, "it has not begun"
    claims_of(store).beat(taken)
    assert claims_of(store).silent(50) == {}
    pass_seconds(store, 100)
    assert claims_of(store).silent(50) == {taken.job.id: 1}
    claims_of(store).lose(taken, "frozen")
    assert claims_of(store).silent(50) == {}
    claim(store)
    claims_of(store).beat(taken)
    assert claims_of(store).silent(-50) == {}, "the heartbeat of an earlier attempt counts for nothing"


def test_an_attempt_that_never_begins_is_silent_after_its_start_allowance(store: JobStore) -> None:
    create(store)
    taken = claim(store)
    pass_seconds(store, START_ALLOWANCE + 40)
    assert claims_of(store).silent(50) == {}
    pass_seconds(store, 20)
    assert claims_of(store).silent(50) == {taken.job.id: 1}
    claims_of(store).beat(taken)
    assert claims_of(store).silent(50) == {}


def pass_seconds(store: JobStore, seconds: float) -> None:
    """Let the last heartbeats be older by ``seconds``."""
    with write(store.engine) as connection:
        connection.execute(jobs.update().values(seen=jobs.c.seen - seconds))


def test_events_tell_the_whole_story_and_their_ids_grow_by_one(store: JobStore) -> None:
    job = create(store)
    taken = claim(store)
    mine = claims_of(store)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: mine.advance(taken, HALF), range(20)))
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
    frozen, old = claims_of(store), claim(store, "frozen")
    claims_of(store).lose(old, "no progress")
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
    claims_of(store).lose(old, "no progress")
    assert store.get(job) == before[0]
    claims_of(store).finish(new, DONE)
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


def test_a_job_that_was_deleted_before_its_worker_s_death_is_known_is_not_lost(store: JobStore) -> None:
    job, taken = create(store), claim(store)
    claims_of(store).finish(taken, DONE)
    store.delete(job)
    claims_of(store).lose(taken, "w died")
    assert store.page().jobs == []


def test_a_job_that_three_workers_died_of_is_failed_with_the_reason(store: JobStore) -> None:
    job = create(store)
    for _ in range(3):
        claims_of(store).lose(claim(store), "w died (signal 9)")
    found = store.get(job)
    assert (found.state, found.attempts) == (JobState.failed, 3)
    assert "3 workers died" in str(found.error)
    assert "w died (signal 9)" in str(found.error)
    assert found.finished is not None


def orphan(store: JobStore, *, times: int) -> None:
    """Claim all queued jobs at once, and lose them together with their dispatcher."""
    for _ in range(times):
        while claims_of(store).upcoming():
            claim(store)
        claims_of(store).lose_unknown({}, "its dispatcher died")


def test_a_dispatcher_s_death_fails_no_job_before_the_tenth_in_one_phase(store: JobStore) -> None:
    job = create(store)
    orphan(store, times=MAX_ORPHANED - 1)
    claims_of(store).lose(claim(store), "w died")
    claims_of(store).lose(claim(store), "w died")
    taken = claim(store)
    claims_of(store).advance(taken, HALF, done=1)
    claims_of(store).give_back(taken)
    orphan(store, times=MAX_ORPHANED - 1)
    assert store.get(job).state is JobState.queued
    orphan(store, times=1)
    assert store.get(job).state is JobState.failed
    assert "10 dispatchers died while running this job" in str(store.get(job).error)


def test_a_job_orphaned_often_runs_alone_until_it_gets_on(store: JobStore) -> None:
    first, second = create(store), create(store)
    orphan(store, times=ALONE_AFTER)
    behind, urgent = create(store, needs={"gpu": 1}), create(store, priority="interactive")
    other = claim(store)
    assert other.job.id == urgent
    assert claims_of(store).upcoming() == [], "another job runs"
    claims_of(store).finish(other, DONE)
    suspect = claim(store)
    assert suspect.job.id == first
    assert claims_of(store).upcoming() == [], "it runs"
    claims_of(store).advance(suspect, HALF, done=1)
    assert claims_of(store).upcoming() == [], "the next one runs alone too"
    claims_of(store).finish(suspect, DONE)
    suspect = claim(store)
    assert suspect.job.id == second
    claims_of(store).advance(suspect, HALF, done=1)
    assert claim(store).job.id == behind


def test_a_job_that_gets_on_outlives_any_number_of_workers(store: JobStore) -> None:
    job = create(store)
    for done in range(1, 6):
        claims_of(store).lose(claim(store), "it died")
        taken = claim(store)
        claims_of(store).advance(taken, Progress(phase="attack", fraction=0.1), done=done)
        claims_of(store).lose(taken, "it died")
    claims_of(store).finish(claim(store), DONE)
    assert (store.get(job).state, store.get(job).attempts) == (JobState.succeeded, 11)


def test_a_job_given_back_does_not_count_as_lost(store: JobStore) -> None:
    job = create(store)
    for _ in range(5):
        claims_of(store).give_back(claim(store))
    claims_of(store).finish(claim(store), DONE)
    assert (store.get(job).state, store.get(job).attempts) == (JobState.succeeded, 6)


@pytest.mark.parametrize("end", [Claims.give_back, partial(Claims.lose, reason="it died")], ids=["stops", "dies"])
def test_a_job_to_be_cancelled_ends_with_its_worker(store: JobStore, end: Callable[[Claims, Claim], object]) -> None:
    job, taken = create(store), claim(store)
    assert store.request_cancel(job).state is JobState.running
    assert claims_of(store).advance(taken, HALF)
    end(claims_of(store), taken)
    assert (store.get(job).state, store.get(job).finished is None) == (JobState.cancelled, False)


def test_a_word_that_the_database_cannot_hold_is_a_wrong_word(store: JobStore) -> None:
    with pytest.raises((NotFoundError, SpecError)):
        store.get("job\0")


def test_a_database_that_may_only_be_read_is_not_available(store: JobStore) -> None:
    create(store)
    reading = {"sqlite": "PRAGMA query_only=on", "postgresql": "SET default_transaction_read_only=on"}
    with store.engine.connect() as connection:
        connection.exec_driver_sql(reading[store.engine.dialect.name])
        connection.commit()
        with pytest.raises(DatabaseDownError, match=r"read-?only"):
            connection.execute(jobs.delete())
        connection.invalidate()


def test_a_loss_is_counted_once_whoever_notices_it(store: JobStore) -> None:
    job, taken = create(store), claim(store)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: claims_of(store).lose_unknown({}, "nobody runs it"), range(4)))
        list(pool.map(lambda _: claims_of(store).lose(taken, "it died"), range(4)))
    assert [job] in found
    assert len([event for event in store.events(job) if event.message == "nobody runs it"]) == 1
    assert not [event for event in store.events(job) if event.message == "it died"]


def test_workers_are_listed_with_what_they_do(store: JobStore) -> None:
    mine = [create(store), create(store)]
    for _ in mine:
        claim(store, "a")
    a, b = Worker("a", "here", "16 CPU"), Worker("b", "there", "cpu", "no store")
    record_workers(store.engine, [a, b])
    with write(store.engine) as connection:
        connection.execute(workers.update().values(seen=workers.c.seen - 100))
    record_workers(store.engine, [a])
    infos = store.workers()
    assert [(info.id, info.alive, info.jobs, info.device, info.fault) for info in infos] == [
        ("a", True, mine, "16 CPU", None),
        ("b", False, [], "cpu", "no store"),
    ]
    record_workers(store.engine, [a, b])
    assert all(info.alive for info in store.workers())
    forget_workers(store.engine)
    assert store.workers() == []


def test_the_store_counts_jobs_and_tells_how_long_the_oldest_waits(store: JobStore) -> None:
    assert store.oldest_queued() == 0
    assert store.counts() == dict.fromkeys(JobState, 0)
    create(store)
    create(store)
    claim(store)
    counts = store.counts()
    assert (counts[JobState.queued], counts[JobState.running]) == (1, 1)
    assert 0 <= store.oldest_queued() < 60


def test_only_jobs_that_have_ended_are_deleted_and_nothing_of_them_stays(store: JobStore) -> None:
    job = create(store, labels={"a": "b"})
    with pytest.raises(ConflictError, match="only ended jobs"):
        store.delete(job)
    claims_of(store).finish(claim(store), DONE)
    assert store.ended_before(3600, limit=9) == []
    assert store.ended_before(-1, limit=9) == [job]
    store.delete(job)
    with pytest.raises(NotFoundError):
        store.get(job)
    assert store.events(job) == []
    assert store.page(labels={"a": "b"}).jobs == []
    with store.engine.connect() as connection:
        assert connection.execute(sa.text("SELECT count(*) FROM job_labels")).scalar_one() == 0


def test_work_for_one_is_given_to_one_until_its_lease_is_over(store: JobStore) -> None:
    def take(holder: str) -> bool:
        return take_lease(store.engine, "dispatcher", holder=holder, seconds=60)

    names = ["a", "b", "c", "d"]
    with ThreadPoolExecutor(4) as pool:
        given = dict(zip(names, pool.map(take, names), strict=True))
    (holder,) = [name for name in names if given[name]]
    assert [name for name in names if take(name)] == [holder]
    end_lease(store.engine, "dispatcher", holder="nobody")
    assert not take("e")
    end_lease(store.engine, "dispatcher", holder=holder)
    assert take("e")
    with write(store.engine) as connection:
        connection.execute(sa.text("UPDATE leases SET until = 0"))
    assert take("f")


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(moves=st.lists(st.sampled_from(["claim", "advance", "finish", "give back", "lose", "cancel"]), max_size=25))
def test_whatever_happens_a_job_is_held_by_one_and_ends_once(store: JobStore, moves: list[str]) -> None:
    """Two attempts play with one job; the older one never gets anything through."""
    job, claims = create(store), claims_of(store)
    held: dict[int, Claim] = {}
    endings = 0
    for number, move in enumerate(moves):
        side = number % 2
        mine, found = held.get(side), store.get(job)
        current = mine is not None and found.state is JobState.running and found.attempts == mine.attempt
        if move == "claim" and not current:
            taken = claims.claim(Needs(), "w")
            held |= {side: taken} if taken is not None and taken.job.id == job else {}
        elif move == "lose" and mine is not None:
            claims.lose(mine, "it died")
            assert current or store.get(job) == found
        elif move in {"advance", "finish", "give back"} and mine is not None:
            write_it: dict[str, Callable[[], object]] = {
                "advance": partial(claims.advance, mine, HALF),
                "finish": partial(claims.finish, mine, DONE),
                "give back": partial(claims.give_back, mine),
            }
            if current:
                write_it[move]()
                endings += move == "finish"
            elif not (move == "finish" and found.attempts == mine.attempt and found.state.final):
                with pytest.raises(LostJobError):
                    write_it[move]()
        elif move == "cancel":
            store.request_cancel(job)
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
    large, small = create(store, needs={"gpu": 1}), create(store)
    with write(store.engine) as connection:
        for statement in (
            "ALTER TABLE jobs DROP COLUMN names",
            "ALTER TABLE jobs DROP COLUMN seen",
            "ALTER TABLE jobs DROP COLUMN orphaned",
            "UPDATE jobs SET needs = CASE needs WHEN '{}' THEN 'any' ELSE 'cuda' END",
            "ALTER TABLE leases DROP COLUMN holder",
            "DELETE FROM leases WHERE name = 'dispatcher'",
            "ALTER TABLE workers DROP COLUMN fault",
            "ALTER TABLE workers ADD COLUMN job VARCHAR",
            "UPDATE alembic_version SET version_num = '1'",
        ):
            connection.execute(sa.text(statement))
    store.migrate()
    assert store.get(large).names == {}
    assert (store.get(large).needs, store.get(small).needs) == (Needs(gpu=1), Needs())
    assert take_lease(store.engine, "dispatcher", holder="a", seconds=60)
    assert store.get(store.create(request(), names={"0af3": "cup"})[0].id).names == {"0af3": "cup"}


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        pytest.param("DROP TABLE alembic_version", r"made by Trompe 0\.1.*--data.*keep Trompe 0\.1", id="0.1"),
        pytest.param("UPDATE alembic_version SET version_num = '99'", "made by a newer Trompe.*'99'", id="newer"),
    ],
)
def test_tables_of_another_version_are_refused_and_stay(store: JobStore, statement: str, message: str) -> None:
    job = create(store)
    with write(store.engine) as connection:
        connection.exec_driver_sql(statement)
    with pytest.raises(ServiceError, match=message):
        store.migrate()
    assert store.get(job).id == job


def test_a_database_that_lost_a_table_is_not_available_and_not_up_to_date(store: JobStore) -> None:
    with write(store.engine) as connection:
        connection.exec_driver_sql("DROP TABLE job_labels")
    with pytest.raises(DatabaseDownError, match="job_labels"):
        store.page(labels={"a": "1"})
    with pytest.raises(ServiceError, match="lacks the tables job_labels: restore a backup"):
        store.migrate()
