"""Whether the service lives, and whether it can work."""

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse

from trompe_server.api import examples
from trompe_server.api.problems import PROBLEMS, problem_response
from trompe_server.api.services import ServicesDep

__all__ = ["router"]

router = APIRouter(tags=["health"], responses=PROBLEMS)


@router.get("/healthz", responses=examples.found(examples.HEALTHY))
def health() -> dict[str, str]:
    """The process answers."""
    return {"status": "ok"}


@router.get("/readyz", responses=examples.found(examples.READY))
def readiness(services: ServicesDep, request: Request) -> Response:
    """The database answers, the worker takes jobs and the renderer can be reached; 503 says what is missing."""
    services.store.page(limit=1)
    missing = services.missing()
    if missing:
        return problem_response(request, 503, code="not-ready", detail="; ".join(missing))
    return JSONResponse({"status": "ready"})
