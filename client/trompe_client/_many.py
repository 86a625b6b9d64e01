"""Many jobs at once: submitted concurrently, followed by one list, returned as they end. Coroutines over a ``Port``.

All jobs of one call carry the label ``batch``. So one request for a list tells the state of 500 jobs, in place of 500
event streams.
"""

import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Final, Generic, TypeVar

from trompe_client import _core
from trompe_client._errors import ClientError
from trompe_client._following import AWAY, failure
from trompe_client._operations import pages, send, uploaded
from trompe_client._plan import Read, Upload, plan_attack, source_of
from trompe_client._port import Port
from trompe_shared.api import Job, JobRequest, JobSpec, Result
from trompe_shared.errors import SpecError, TrompeError

BATCH: Final = "batch"
"""Label of all jobs of one call."""
PATIENCE: Final = 600.0
"""Seconds without an answer of the server after which the jobs are given up."""
LEAST_PAUSE, LONGEST_PAUSE = 1.0, 30.0
"""Seconds between two requests for the list."""
SHARE: Final = 0.05
"""Largest share of the time for requests of the list; long lists are requested less often."""

Attack = Mapping[str, Any] | JobSpec
"""Arguments of ``Client.attack``, or a job with stored files."""
J = TypeVar("J")
K = TypeVar("K")


@dataclass(frozen=True)
class Outcome(Generic[J]):
    """Outcome of attack number ``index`` (from 0). A job that ends as n.a. has a result and no error.

    ``job`` is None if it could not be submitted. Without a ``result``, ``error`` is the reason.
    """

    index: int
    job: J | None = None
    result: Result | None = None
    error: TrompeError | OSError | None = None

    def of(self, handle: Callable[[J], K]) -> "Outcome[K]":
        """The same with a handle in place of the job."""
        return Outcome(self.index, None if self.job is None else handle(self.job), self.result, self.error)


async def run_all(
    port: Port, attacks: Sequence[Attack], *, batch: str | None, concurrency: int
) -> AsyncGenerator[Outcome[Job], None]:
    """Submit all, then yield each as it ends. The same ``batch`` and attacks again find the existing jobs."""
    if concurrency < 1:
        raise SpecError(f"`concurrency` must be 1 or more, got {concurrency}.")
    name = batch or _core.new_key()[:12]
    started = await _submit_all(port, attacks, name, concurrency)
    for outcome in started:
        if outcome.error is not None:
            yield outcome
    waiting = {outcome.job.id: outcome for outcome in started if outcome.job is not None}
    give_up = time.monotonic() + PATIENCE
    while waiting:
        began = time.monotonic()
        try:
            ended = await _ended(port, name, waiting)
            give_up = time.monotonic() + PATIENCE
        except ClientError as error:
            over = not isinstance(error, AWAY) or time.monotonic() > give_up
            ended = [replace(outcome, error=error) for outcome in waiting.values()] if over else []
        pause = min(max(LEAST_PAUSE, (time.monotonic() - began) / SHARE), LONGEST_PAUSE)
        calls = [partial(_with_result, port, outcome) for outcome in ended]
        for outcome in await port.together(calls, limit=concurrency):
            assert outcome.job is not None
            del waiting[outcome.job.id]
            yield outcome
        await port.sleep(pause if waiting else 0)


async def _submit_all(port: Port, attacks: Sequence[Attack], batch: str, concurrency: int) -> list[Outcome[Job]]:
    """Read and upload each file once, and submit; errors become outcomes."""
    ids: dict[Upload, str] = {}
    read = cache(source_of)
    requests: list[Outcome[JobRequest]] = [
        await _filled(Outcome(k), "job", partial(_request, port, attack, read, ids)) for k, attack in enumerate(attacks)
    ]
    return await port.together([partial(_submit, port, each, batch) for each in requests], limit=concurrency)


async def _request(port: Port, attack: Attack, read: Read, ids: dict[Upload, str]) -> JobRequest:
    if isinstance(attack, JobSpec):
        return JobRequest.model_validate(attack.model_dump())
    return await uploaded(port, await port.off(lambda: plan_attack(**attack, read=read)), ids)


async def _submit(port: Port, asked: Outcome[JobRequest], batch: str) -> Outcome[Job]:
    if asked.job is None:
        return Outcome(asked.index, error=asked.error)
    labelled = asked.job.model_copy(update={"labels": asked.job.labels | {BATCH: batch}})
    submission = _core.submit(labelled, key=f"{batch}/{asked.index}")
    return await _filled(Outcome(asked.index), "job", partial(send, port, submission))


async def _filled(outcome: Outcome[J], field: str, call: Callable[[], Awaitable[Any]]) -> Outcome[J]:
    """``outcome`` with the value of ``call`` as its ``field``, or else with its error."""
    try:
        return replace(outcome, **{field: await call()})
    except (TrompeError, OSError) as error:
        return replace(outcome, error=error)


async def _ended(port: Port, batch: str, waiting: Mapping[str, Outcome[Job]]) -> list[Outcome[Job]]:
    """Jobs of the batch that have ended or were deleted."""
    listed = {job.id: job async for job in pages(port, _core.job_filter({BATCH: batch}))}
    found = [replace(outcome, job=listed[name]) for name, outcome in waiting.items() if name in listed]
    missed = [name for name in waiting if name not in listed]  # probably deleted
    gone = [await _filled(waiting[name], "job", partial(send, port, _core.job(name))) for name in missed]
    return [outcome for outcome in found + gone if outcome.error or (outcome.job and outcome.job.state.final)]


async def _with_result(port: Port, outcome: Outcome[Job]) -> Outcome[Job]:
    if outcome.error is not None or outcome.job is None:
        return outcome
    error = failure(outcome.job)
    if error is not None:
        return replace(outcome, error=error)
    return await _filled(outcome, "result", partial(send, port, _core.result(outcome.job.id)))
