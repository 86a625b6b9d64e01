"""Routes for jobs: submit, list, read, cancel, retry, follow, download, delete; and for experiments.

An experiment is the jobs with the label ``experiment=<name>``.
"""

import re
from collections.abc import Mapping
from pathlib import PurePath
from typing import Annotated, Final

from fastapi import APIRouter, Body, Header, Query, Request
from fastapi.responses import Response, StreamingResponse
from sse_starlette import EventSourceResponse

from trompe_server.api import examples
from trompe_server.api.downloads import digest_of, lasting_digest, send_file, zip_stream
from trompe_server.api.following import follow
from trompe_server.api.problems import PROBLEMS
from trompe_server.api.services import Services, ServicesDep
from trompe_server.api.submission import checked_spec
from trompe_server.errors import ConflictError, NotFoundError
from trompe_server.queue import retention
from trompe_server.queue.store import EXPERIMENT
from trompe_shared.api import (
    ExperimentInfo,
    Job,
    JobList,
    JobRequest,
    JobState,
    JudgementRequest,
    JudgementSpec,
    Result,
)
from trompe_shared.errors import SpecError

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=PROBLEMS)
experiments = APIRouter(prefix="/v1/experiments", tags=["experiments"], responses=PROBLEMS)

RESULT: Final = "result.json"

KNOWN: Final = "The job of an earlier request with the same key"
NEW_OR_KNOWN: Final = examples.answer(200, KNOWN, examples.JOB, model=Job) | examples.made(examples.JOB)

AskedJob = Annotated[JobRequest, Body(openapi_examples=examples.JOB_REQUESTS)]
IdempotencyKey = Annotated[
    str | None,
    Header(
        description="a text of your choice; the same request with the same key makes one job",
        min_length=1,
        max_length=255,
    ),
]
Limit = Annotated[int, Query(ge=1, le=500)]
Cursor = Annotated[str | None, Query(description="next_cursor of the previous page", max_length=200)]
LabelFilters = Annotated[
    list[str], Query(alias="label", description="key:value; a job must have all labels", max_length=32)
]


@router.post("", status_code=201, responses=NEW_OR_KNOWN)
def submit(
    services: ServicesDep,
    request: AskedJob,
    response: Response,
    idempotency_key: IdempotencyKey = None,
) -> Job:
    """Queue an attack. Objects and networks must exist. The job keeps their ids: later uploads do not change it."""
    spec, names = checked_spec(request, services.library)
    return create(services, spec, names, response, idempotency_key)


@router.post("/check", status_code=204)
def check_job(services: ServicesDep, request: AskedJob) -> None:
    """Check a job without queueing it: 204, or the problem that submitting it would return."""
    checked_spec(request, services.library)


@router.get("", responses=examples.found(examples.JOB_LIST))
def list_jobs(
    services: ServicesDep,
    state: JobState | None = None,
    labels: LabelFilters = [],  # noqa: B006
    object: Annotated[str | None, Query(description="id of the object, or name of a shipped one")] = None,
    classifier: Annotated[str | None, Query(description="id of the classifier, or name of a shipped one")] = None,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> JobList:
    """Jobs, newest first."""
    wanted = labels_of(labels)
    return services.store.page(
        state=state, labels=wanted, object=object, classifier=classifier, limit=limit, cursor=cursor
    )


@router.get("/{job}", responses=examples.found(examples.JOB))
def read_job(services: ServicesDep, job: str) -> Job:
    """One job."""
    return services.store.get(job)


@router.delete("/{job}", status_code=204)
def delete_job(services: ServicesDep, job: str) -> None:
    """Delete an ended job with all its files."""
    retention.delete_job(services.store, services.files, job)


@router.post("/{job}/cancel", responses=examples.found(examples.JOB))
def cancel_job(services: ServicesDep, job: str) -> Job:
    """Cancel a job: a queued one at once, a running one within seconds. An ended job stays as it is."""
    return services.store.request_cancel(job)


@router.post("/{job}/retry", status_code=201, responses=NEW_OR_KNOWN)
def retry_job(services: ServicesDep, job: str, response: Response, idempotency_key: IdempotencyKey = None) -> Job:
    """Queue the same work as a new job. The old one must have ended, and stays."""
    old = services.store.get(job)
    if not old.state.final:
        raise ConflictError(f"Job {job} is {old.state} and has not ended; cancel it before a retry.")
    queued = {"priority": old.priority, "labels": old.labels, "needs": old.needs}
    kind = JudgementRequest if isinstance(old.spec, JudgementSpec) else JobRequest
    request = kind.model_validate(old.spec.model_dump() | queued)
    return create(services, request, old.names, response, idempotency_key)


@router.get(
    "/{job}/events",
    response_class=EventSourceResponse,
    responses={
        200: {
            "description": "Server-sent events named `progress`, each with an Event as data.",
            "content": {"text/event-stream": {"example": examples.EVENT_STREAM}},
        }
    },
)
def follow_job(
    services: ServicesDep,
    job: str,
    last_event_id: Annotated[str | None, Header(description="resume after this event")] = None,
) -> EventSourceResponse:
    """Events of a job from the first, or after ``Last-Event-ID``, to the last."""
    services.store.get(job)
    seen = re.fullmatch(r"\d+", last_event_id or "", re.ASCII)
    return follow(services.store, job, after=min(int(seen[0][:10]), 2**31 - 1) if seen else 0)


@router.get("/{job}/result", response_model=Result, responses=examples.found(examples.RESULT) | examples.PART_ANSWERS)
def read_result(services: ServicesDep, request: Request, job: str) -> Response:
    """Result of a successful attack."""
    return send(services, request, with_result(services, job, RESULT), RESULT)


@router.get("/{job}/artifacts/{name}", response_class=Response, responses=examples.FILE_ANSWERS)
def read_artifact(services: ServicesDep, request: Request, job: str, name: str) -> Response:
    """One of the job's ``artifacts``, or a range of its bytes. The ETag is the file's SHA-256."""
    found = services.store.get(job)
    if name not in found.artifacts:
        known = ", ".join(found.artifacts) or "none yet"
        raise NotFoundError(f"Job {job} has no artifact {name!r}. It has: {known}.")
    return send(services, request, found, name)


@router.get("/{job}/archive", response_class=StreamingResponse, responses={200: examples.ARCHIVE})
def read_archive(services: ServicesDep, job: str) -> StreamingResponse:
    """All artifacts of a job as one zip."""
    found = services.store.get(job)
    if not found.artifacts:
        raise NotFoundError(f"Job {job} is {found.state} and has no artifacts.")
    artifacts = services.artifacts(job)
    if gone := set(found.artifacts) - set(artifacts.names()):
        raise NotFoundError(
            f"Files of job {job} are no longer in the store: {', '.join(sorted(gone))}. Fetch the others one by one."
        )
    parts = zip_stream(artifacts, found.artifacts, time=found.finished or found.created)
    disposition = f'attachment; filename="trompe-{PurePath(job).name}.zip"'
    return StreamingResponse(parts, media_type="application/zip", headers={"Content-Disposition": disposition})


@experiments.get("", responses=examples.found([examples.EXPERIMENT]))
def list_experiments(services: ServicesDep) -> list[ExperimentInfo]:
    """Experiments with the number of their jobs by state, newest first."""
    return services.store.experiments()


@experiments.get("/{name:path}", responses=examples.found(examples.JOB_LIST))
def read_experiment(services: ServicesDep, name: str, limit: Limit = 50, cursor: Cursor = None) -> JobList:
    """Jobs of an experiment, newest first."""
    page = services.store.page(labels={EXPERIMENT: name}, limit=limit, cursor=cursor)
    if not page.jobs and cursor is None:
        raise NotFoundError(f"There is no experiment {name!r}. List the experiments to find its name.")
    return page


def create(
    services: Services,
    request: JobRequest | JudgementRequest,
    names: Mapping[str, str],
    response: Response,
    key: str | None,
) -> Job:
    """Queue a job, and answer with its place. Raises ``ServiceError`` if those who run it have another store."""
    services.check_store()
    job, new = services.store.create(request, names=names, idempotency_key=key)
    response.status_code = 201 if new else 200
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job


def with_result(services: Services, job: str, name: str) -> Job:
    """An ended job with the file ``name``. Raises ``ConflictError`` without it."""
    found = services.store.get(job)
    if not found.state.final:
        raise ConflictError(f"Job {job} is {found.state} and has no result yet. Wait for its end.")
    if name not in found.artifacts:
        raise ConflictError(
            f"Job {job} ended as {found.state} without {name}: {found.error or found.note or 'no reason given'}"
        )
    return found


def labels_of(texts: list[str]) -> dict[str, str]:
    """Labels written as ``key:value``. Raises ``SpecError``."""
    labels: dict[str, str] = {}
    for text in texts:
        name, _, value = text.partition(":")
        if not (name and value):
            raise SpecError(f"{text!r} is not a label; write key:value, such as label=experiment:mugs.")
        if labels.setdefault(name, value) != value:
            raise SpecError(f"The label {name!r} has two values, and a job has one value per label; give one of them.")
    return labels


def send(services: Services, request: Request, job: Job, name: str) -> Response:
    """Answer with a file of a job. Raises ``MissingFileError``."""
    artifacts = services.artifacts(job.id)
    digest = (lasting_digest if job.state.final else digest_of)(artifacts, name)
    return send_file(request, artifacts, name, digest=digest)
