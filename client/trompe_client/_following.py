"""Events of a job to its end, over any number of connections. Coroutines over a ``Port``."""

import time
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing, suppress
from typing import TYPE_CHECKING, Final

from trompe_client import _core
from trompe_client._errors import JobCancelled, JobFailed, ServerFault, ServerUnreachable, TooMany, WaitTimeout
from trompe_client._operations import check, send_once
from trompe_client._port import Port
from trompe_shared.api import Event, Job, JobState

if TYPE_CHECKING:
    from trompe_client._client import AsyncClient, Client

PATIENCE: Final = 60.0
"""Seconds that a server may be unreachable (restarting) while a job is followed."""
SILENCE: Final = 30.0
"""Seconds without an event or comment before a stream is opened again."""
PAUSE: Final = 0.5
"""Seconds between two connections."""
LAST_LOOK: Final = 5.0
"""Seconds of silence after which the state of a job at the end of a wait stays unknown."""
AWAY: Final = (ServerUnreachable, ServerFault, TooMany)
"""Temporary errors of a server."""


class Followed:
    """A job of a client as last seen."""

    def __init__(self, client: "Client | AsyncClient", status: Job) -> None:
        self.client, self.status = client, status
        self._port: Port = client.port

    @property
    def server(self) -> str:
        """The server's address."""
        return self.client.server

    @property
    def id(self) -> str:
        """The job's id, for ``client.job(id)``."""
        return self.status.id

    @property
    def state(self) -> JobState:
        """The job's state as last seen."""
        return self.status.state

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.id} {self.state.value}>"


async def wait(port: Port, job: Followed, *, timeout: float | None, show: Callable[[Event], None]) -> None:
    """Follow a job to its end. Raises ``JobFailed``, ``JobCancelled``, ``WaitTimeout``, ``ServerUnreachable``."""
    try:
        await _wait(port, job, None if timeout is None else time.monotonic() + timeout, show)
    except _OverdueError:
        await _look_once_more(port, job)
    error = failure(job.status)
    if error is not None:
        raise error


async def _wait(port: Port, job: Followed, deadline: float | None, show: Callable[[Event], None]) -> None:
    async with aclosing(follow(port, job, deadline)) as events:
        async for event in events:
            show(event)
    while not (await refresh_patiently(port, job, deadline)).state.final:
        await port.sleep(PAUSE)


async def _look_once_more(port: Port, job: Followed) -> None:
    """The state of a job whose wait is over. Raises ``WaitTimeout`` unless it has ended."""
    try:
        job.status = await send_once(port, _core.job(job.id), silence=LAST_LOOK)
    except AWAY as error:
        last = f"Job {job.id} was {job.state.value} when it was last seen, and continues, but now: {error}"
        raise WaitTimeout(last, job=job.status) from error
    if not job.state.final:
        raise WaitTimeout(f"Job {job.id} is still {job.state.value}; it continues.", job=job.status)


async def follow(port: Port, job: Followed, deadline: float | None = None) -> AsyncGenerator[Event, None]:
    """Events as they happen, until the final one; each connection resumes after the last event seen."""
    last: int | None = None
    over = False
    while True:
        with suppress(*AWAY):
            async with aclosing(_stream(port, job, last, deadline)) as events:
                async for event in events:
                    last = event.id
                    yield event
                    if event.state.final:
                        return
        if over:
            return
        over = (await refresh_patiently(port, job, deadline)).state.final
        await port.sleep(0 if over else PAUSE)


async def _stream(port: Port, job: Followed, after: int | None, deadline: float | None) -> AsyncGenerator[Event, None]:
    """Events of one connection (https://html.spec.whatwg.org/multipage/server-sent-events.html)."""
    silence = SILENCE if deadline is None else min(SILENCE, max(deadline - time.monotonic(), PAUSE))
    request, data = _core.events(job.id, after=after), list[str]()
    async with port.open(request, silence=silence) as answer:
        await check(answer, request)
        async with aclosing(answer.lines()) as lines:
            async for line in lines:
                _check_time(deadline)
                if line.startswith("data:"):
                    data.append(line[5:].removeprefix(" "))
                elif data and not line:
                    yield _core.event("\n".join(data))
                    data.clear()


async def refresh_patiently(port: Port, job: Followed, deadline: float | None = None) -> Job:
    """The job's status, from a server that may be restarting."""
    give_up, attempt = time.monotonic() + PATIENCE, 0
    while True:
        _check_time(deadline)
        try:
            job.status = await send_once(port, _core.job(job.id))
            return job.status
        except AWAY as error:
            now, pause = time.monotonic(), port.retries.delay(error, attempt=attempt)
            if now + pause > give_up:
                raise
        await port.sleep(pause if deadline is None else max(0.0, min(pause, deadline - now)))
        attempt += 1


class _OverdueError(Exception):
    """The time of a wait is over."""


def _check_time(deadline: float | None) -> None:
    if deadline is not None and time.monotonic() > deadline:
        raise _OverdueError


def failure(job: Job) -> JobFailed | JobCancelled | None:
    """The error of a failed or cancelled job, else None."""
    if job.state is JobState.failed:
        return JobFailed(f"Job {job.id} failed: {job.error or 'no reason given'}", job=job)
    if job.state is JobState.cancelled:
        return JobCancelled(f"Job {job.id} was cancelled.", job=job)
    return None
