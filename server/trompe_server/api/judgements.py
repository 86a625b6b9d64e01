"""Routes for judgements. A judgement is a job: it is followed, cancelled, listed and deleted as one."""

from typing import Annotated, Any, Final

from fastapi import APIRouter, Body, Request
from fastapi.responses import Response

from trompe_server.api import examples
from trompe_server.api.jobs import NEW_OR_KNOWN, IdempotencyKey, create, send, with_result
from trompe_server.api.problems import PROBLEMS
from trompe_server.api.services import ServicesDep
from trompe_server.api.submission import checked_judgement
from trompe_server.errors import NotFoundError
from trompe_shared.api import MANIFEST, MANIFEST_PAGE, Job, JudgementRequest, JudgementSpec, Manifest

router = APIRouter(prefix="/v1/judgements", tags=["judgements"], responses=PROBLEMS)

PAGE_HEADERS: Final = {
    "Content-Security-Policy": "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
    "frame-ancestors 'self'"
}
"""Of the page, which is shown in a frame of ours and may run nothing."""


@router.post("", status_code=201, responses=NEW_OR_KNOWN)
def submit_judgement(
    services: ServicesDep,
    request: Annotated[JudgementRequest, Body(openapi_examples=examples.JUDGEMENT_REQUESTS)],
    response: Response,
    idempotency_key: IdempotencyKey = None,
) -> Job:
    """Queue a judgement of stored objects. Follow it by the job's id at `/v1/jobs/{job}/events`."""
    checked, names = checked_judgement(request, services)
    return create(services, checked, names, response, idempotency_key)


@router.get("/{job}", responses=examples.found(examples.JUDGEMENT))
def read_judgement(services: ServicesDep, job: str) -> Job:
    """One judgement."""
    found = services.store.get(job)
    if not isinstance(found.spec, JudgementSpec):
        raise NotFoundError(f"Job {job} is an attack, not a judgement: see /v1/jobs/{job}.")
    return found


@router.get(
    "/{job}/manifest", response_model=Manifest, responses=examples.found(examples.MANIFEST) | examples.PART_ANSWERS
)
def read_manifest(services: ServicesDep, request: Request, job: str) -> Response:
    """Manifest of an ended judgement, `judgement.json`."""
    return send(services, request, with_result(services, read_judgement(services, job).id, MANIFEST), MANIFEST)


@router.get(
    "/{job}/page",
    response_class=Response,
    responses={200: {"description": "The page", "content": {"text/html": {"schema": {"type": "string"}}}}},
)
def read_page(services: ServicesDep, job: str) -> Any:
    """Page of an ended judgement, one self-contained HTML file."""
    found = with_result(services, read_judgement(services, job).id, MANIFEST_PAGE)
    return Response(services.artifacts(found.id).read(MANIFEST_PAGE), media_type="text/html", headers=PAGE_HEADERS)
