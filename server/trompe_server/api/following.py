"""A job's events as a resumable stream (SSE)."""

import asyncio
import logging
from collections.abc import AsyncIterator
from typing import Final

import anyio
from sse_starlette import EventSourceResponse, ServerSentEvent

from trompe_server.errors import NotFoundError
from trompe_server.queue.store import JobStore
from trompe_server.storage.database import DatabaseDownError
from trompe_shared.api import Event

logger = logging.getLogger(__name__)

INTERVAL: Final = 0.25
"""Seconds between two queries for new events of an active job."""
PATIENCE: Final = 2.0
"""Longest interval for an idle job; hundreds of queued jobs may be followed at once."""
KEEP_ALIVE: Final = 15
"""Seconds between two comments that keep the connection alive."""
GRACE: Final = 2.0
"""Seconds for streams to end when the server stops."""


def follow(store: JobStore, job: str, *, after: int) -> EventSourceResponse:
    """Stream events with ids above ``after`` until the job ends or is deleted, or the server stops."""
    stopping = anyio.Event()
    messages = _messages(store, job, after, stopping)
    return EventSourceResponse(messages, ping=KEEP_ALIVE, shutdown_event=stopping, shutdown_grace_period=GRACE)


async def _messages(store: JobStore, job: str, after: int, stopping: anyio.Event) -> AsyncIterator[ServerSentEvent]:
    interval = INTERVAL
    while not stopping.is_set():
        events, over = await asyncio.to_thread(_look, store, job, after)
        for event in events:
            after = event.id
            yield ServerSentEvent(data=event.model_dump_json(), id=str(event.id), event="progress")
        if over:
            return
        interval = INTERVAL if events else min(1.5 * interval, PATIENCE)
        with anyio.move_on_after(interval):
            await stopping.wait()


def _look(store: JobStore, job: str, after: int) -> tuple[list[Event], bool]:
    """New events, and whether they are the last. If the database is down, none.

    The state is read first: a job that has ended by then has all its events.
    """
    try:
        over = store.get(job).state.final
        return store.events(job, after=after), over
    except NotFoundError:
        return [], True
    except DatabaseDownError:
        logger.warning("cannot read the events of job %s; retrying", job)
        return [], False
