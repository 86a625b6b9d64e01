"""Routes for jobs: submit, list, read, cancel, follow, fetch what came out."""

import asyncio
from collections.abc import AsyncIterator
from mimetypes import guess_type
from typing import Annotated, Final

from fastapi import APIRouter, Header, Query
from fastapi.responses import FileResponse, Response
from sse_starlette import EventSourceResponse, ServerSentEvent

from trompe_server.api.problems import PROBLEMS
from trompe_server.api.services import Services, ServicesDep, StoreDep
from trompe_server.api.submission import checked_spec
from trompe_server.errors import ConflictError, NotFoundError
from trompe_server.jobs.store import JobStore
from trompe_shared.api import Event, Job, JobList, JobSpec, JobState, Result

__all__ = ["router"]

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=PROBLEMS)

EVENT_INTERVAL: Final = 0.25
"""Seconds between two looks for new events."""
RESULT: Final = "result.json"
_STREAM: Final = (
    'id: 3\nevent: progress\ndata: {"id": 3, "time": "2026-01-31T12:00:00Z", "state": "running", '
    '"progress": {"phase": "attack-000", "fraction": 0.4}}\n\n'
)


@router.post("", status_code=201)
def submit(services: ServicesDep, spec: JobSpec, response: Response) -> Job:
    """Queue an attack. What it names must exist; the job keeps the ids, so that later uploads do not change it."""
    job = services.store.create(checked_spec(spec, services.library), services.queue.enqueue)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job


@router.get("")
def list_jobs(
    store: StoreDep,
    state: JobState | None = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
    cursor: Annotated[str | None, Query(description="next_cursor of the page before")] = None,
) -> JobList:
    """Jobs, newest first."""
    return store.page(state=state, limit=limit, cursor=cursor)


@router.get("/{job}")
def read_job(store: StoreDep, job: str) -> Job:
    """One job."""
    return store.get(job)


@router.post("/{job}/cancel")
def cancel_job(services: ServicesDep, job: str) -> Job:
    """Cancel a job: a queued one at once, a running one within moments. A job that has ended stays as it is."""
    found = services.store.request_cancel(job)
    if found.state is JobState.cancelled:
        services.queue.forget(job)
    return found


@router.get(
    "/{job}/events",
    response_class=EventSourceResponse,
    responses={
        200: {
            "description": "Server-sent events named `progress`; the data of each is an Event.",
            "content": {"text/event-stream": {"example": _STREAM}},
        }
    },
)
def follow_job(
    store: StoreDep,
    job: str,
    last_event_id: Annotated[str | None, Header(description="go on after this event")] = None,
) -> EventSourceResponse:
    """Events of a job from its beginning, or after ``Last-Event-ID``, until it has ended."""
    store.get(job)
    after = int(last_event_id) if last_event_id is not None and last_event_id.isdecimal() else 0
    return EventSourceResponse(_events(store, job, after))


@router.get("/{job}/result", responses={200: {"model": Result}})
def read_result(services: ServicesDep, job: str) -> Response:
    """The result of a job that has ended well."""
    found = services.store.get(job)
    if not found.state.final:
        raise ConflictError(
            f"Job {job} is {found.state}; its result is there once it has ended. Follow /v1/jobs/{job}/events."
        )
    if not services.artifacts(job).exists(RESULT):
        raise ConflictError(
            f"Job {job} ended as {found.state} without a result: {found.error or found.note or 'no reason given'}"
        )
    return Response(services.artifacts(job).read(RESULT), media_type="application/json")


@router.get("/{job}/artifacts/{name}", response_class=FileResponse)
def read_artifact(services: ServicesDep, job: str, name: str) -> FileResponse:
    """A file that the job made, one of its ``artifacts``."""
    return _artifact(services, services.store.get(job), name)


def _artifact(services: Services, job: Job, name: str) -> FileResponse:
    if name not in job.artifacts:
        known = ", ".join(job.artifacts) or "none yet"
        raise NotFoundError(f"Job {job.id} has no artifact {name!r}. It has: {known}.")
    return FileResponse(
        services.artifacts(job.id).path(name),
        filename=name,
        media_type=guess_type(name)[0] or "application/octet-stream",
        content_disposition_type="inline",
    )


async def _events(store: JobStore, job: str, after: int) -> AsyncIterator[ServerSentEvent]:
    while True:
        events = await asyncio.to_thread(store.events, job, after=after)
        for event in events:
            after = event.id
            yield _message(event)
        if events and events[-1].state.final:
            return
        if not events and (await asyncio.to_thread(store.get, job)).state.final:
            return
        await asyncio.sleep(EVENT_INTERVAL)


def _message(event: Event) -> ServerSentEvent:
    return ServerSentEvent(data=event.model_dump_json(), id=str(event.id), event="progress")
