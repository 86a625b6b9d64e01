"""Liveness and readiness."""

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse

from trompe_server.api import examples
from trompe_server.api.problems import PROBLEMS, problem_response
from trompe_server.api.services import ServicesDep

router = APIRouter(tags=["health"], responses=PROBLEMS)


@router.get("/healthz", responses=examples.found({"status": "ok"}))
def health() -> dict[str, str]:
    """The process answers."""
    return {"status": "ok"}


@router.get("/readyz", responses=examples.found({"status": "ready"}))
def readiness(services: ServicesDep, request: Request) -> Response:
    """Database, worker and renderer are up; 503 names the missing ones."""
    services.store.page(limit=1)
    missing = services.missing()
    if missing:
        return problem_response(request, 503, code="not-ready", detail="; ".join(missing))
    return JSONResponse({"status": "ready"})
