"""State of the service: attack workers, renderer workers, liveness and readiness."""

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse

from trompe_server.api import examples
from trompe_server.api.problems import PROBLEMS, problem_response
from trompe_server.api.services import ServicesDep
from trompe_shared.api import RendererInfo, WorkerInfo

router = APIRouter(responses=PROBLEMS)


@router.get("/v1/workers", tags=["workers"], responses=examples.found([examples.WORKER]))
def list_workers(services: ServicesDep) -> list[WorkerInfo]:
    """Attack workers, by their latest heartbeats."""
    return services.store.workers()


@router.get("/v1/renderers", tags=["workers"], responses=examples.found([examples.RENDERER]))
def list_renderers(services: ServicesDep) -> list[RendererInfo]:
    """Renderer workers of this server: whether they accept connections, and their engines."""
    return services.renderers()


@router.get("/healthz", tags=["health"], responses=examples.found({"status": "ok"}))
def health() -> dict[str, str]:
    """The process answers."""
    return {"status": "ok"}


@router.get("/readyz", tags=["health"], responses=examples.found({"status": "ready"}))
def readiness(services: ServicesDep, request: Request) -> Response:
    """Database, worker and renderer are up; 503 names the missing ones."""
    services.store.page(limit=1)
    missing = services.missing()
    if missing:
        return problem_response(request, 503, code="not-ready", detail="; ".join(missing))
    return JSONResponse({"status": "ready"})
