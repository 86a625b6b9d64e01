"""Many jobs at once: submitted side by side, followed by one list, given out as they end. Coroutines over a ``Port``.

All jobs of one call carry the label ``batch``, so that a list of jobs tells how all of them stand: one request for 500
jobs, where an event stream each would need 500 connections.
"""

import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from trompe_client import _core
from trompe_client._core import JobFilter
from trompe_client._errors import ClientError
from trompe_client._following import AWAY, failure
from trompe_client._operations import pages, send, uploaded
from trompe_client._plan import each_source, plan_attack
from trompe_client._port import Port
from trompe_shared.api import Job, JobRequest, JobSpec, Result
from trompe_shared.errors import TrompeError

__all__ = ["BATCH", "Attack", "Outcome", "run_all"]

BATCH: Final = "batch"
"""The label that all jobs of one call carry."""
PATIENCE: Final = 600.0
"""How long a server may be gone before the jobs are given up, seconds."""
LEAST_PAUSE, LONGEST_PAUSE = 1.0, 30.0
"""Time between two looks at the list, seconds."""
SHARE: Final = 0.05
"""Looking at the list takes no more than this share of the time, so that a long one is looked at less often."""

Attack = Mapping[str, Any] | JobSpec
"""What to do: the arguments of ``Client.attack``, or a job whose files are stored already."""
KINDS: Final = {
    "object": "object",
    "classifier": "classifier",
    "ensemble": "classifier",
    "judges": "classifier",
    "background": "background",
}
"""Arguments that can be files, and what they are stored as."""
T = TypeVar("T")
J = TypeVar("J")
K = TypeVar("K")


@dataclass(frozen=True)
class Outcome(Generic[J]):
    """What became of attack number ``index`` (from 0). A job that ends as n.a. has a result and no error.

    ``job`` is None where it could not be submitted; ``result`` where there is none; ``error`` says why.
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
    """Submit all, then give each as it ends. The same ``batch`` and attacks again find the jobs there already."""
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
            del waiting[_id(outcome)]
            yield outcome
        await port.sleep(pause if waiting else 0)


async def _submit_all(port: Port, attacks: Sequence[Attack], batch: str, concurrency: int) -> list[Outcome[Job]]:
    """Upload what has to be, each file once, and submit; what cannot be submitted has an error."""
    files = _Files(port)
    requests = [await _caught(partial(files.request, attack), index) for index, attack in enumerate(attacks)]
    calls = [partial(_submit, port, request, batch, index) for index, request in enumerate(requests)]
    return await port.together(calls, limit=concurrency)


async def _submit(port: Port, request: JobRequest | Outcome[Job], batch: str, index: int) -> Outcome[Job]:
    if isinstance(request, Outcome):
        return request
    labelled = request.model_copy(update={"labels": request.labels | {BATCH: batch}})
    job = await _caught(partial(send, port, _core.submit(labelled, key=f"{batch}/{index}")), index)
    return job if isinstance(job, Outcome) else Outcome(index, job)


async def _caught(call: Callable[[], Awaitable[T]], index: int) -> T | Outcome[Job]:
    """What ``call`` returns, or its error as a value."""
    try:
        return await call()
    except (TrompeError, OSError) as error:
        return Outcome(index, error=error)


class _Files:
    """Makes jobs of attacks, and remembers under which id a file was stored."""

    def __init__(self, port: Port) -> None:
        self._port = port
        self._ids: dict[tuple[str, str], str] = {}

    async def request(self, attack: Attack) -> JobRequest:
        """The job, its files uploaded."""
        if isinstance(attack, JobSpec):
            return JobRequest.of(attack)
        known = {name: self._known(name, value) for name, value in attack.items()}
        request = await uploaded(self._port, await self._port.off(lambda: plan_attack(**known)))
        for name in KINDS.keys() & attack.keys():
            for source, stored in zip(each_source(attack[name]), each_source(getattr(request, name)), strict=True):
                self._ids[KINDS[name], str(source)] = str(stored)
        return request

    def _known(self, name: str, value: Any) -> Any:
        """An argument with ids in place of the files that are stored."""
        if name not in KINDS:
            return value
        ids = [self._ids.get((KINDS[name], str(source)), source) for source in each_source(value)]
        return ids[0] if isinstance(value, str | Path) else ids


async def _ended(port: Port, batch: str, waiting: Mapping[str, Outcome[Job]]) -> list[Outcome[Job]]:
    """Those of the jobs that have ended or are gone, as they stand now."""
    listed = {job.id: job async for job in pages(port, JobFilter(labels={BATCH: batch}))}
    found = [replace(outcome, job=listed[name]) for name, outcome in waiting.items() if name in listed]
    gone = [await _missed(port, outcome) for name, outcome in waiting.items() if name not in listed]
    return [outcome for outcome in found + gone if outcome.error or (outcome.job and outcome.job.state.final)]


async def _missed(port: Port, outcome: Outcome[Job]) -> Outcome[Job]:
    """A job that the list has not: somebody deleted it."""
    job = await _caught(partial(send, port, _core.job(_id(outcome))), outcome.index)
    return replace(outcome, error=job.error) if isinstance(job, Outcome) else replace(outcome, job=job)


async def _with_result(port: Port, outcome: Outcome[Job]) -> Outcome[Job]:
    """The outcome with the job's result, or why there is none."""
    if outcome.error is not None or outcome.job is None:
        return outcome
    error = failure(outcome.job)
    if error is not None:
        return replace(outcome, error=error)
    result = await _caught(partial(send, port, _core.result(outcome.job.id)), outcome.index)
    return replace(outcome, error=result.error) if isinstance(result, Outcome) else replace(outcome, result=result)


def _id(outcome: Outcome[Job]) -> str:
    assert outcome.job is not None
    return outcome.job.id
