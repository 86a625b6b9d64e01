"""State of the service: attack workers, renderer workers, liveness, readiness, metrics."""

from typing import Final

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Gauge, generate_latest

from trompe_server.api import examples
from trompe_server.api.problems import PROBLEMS, RefusedError
from trompe_server.api.services import ServicesDep
from trompe_server.executor.metrics import WORK
from trompe_server.queue.store import JobStore
from trompe_shared.api import RendererInfo, WorkerInfo

router = APIRouter(responses=PROBLEMS)

_EXAMPLE: Final = '# TYPE trompe_jobs gauge\ntrompe_jobs{state="running"} 2.0\n'


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
def readiness(services: ServicesDep) -> dict[str, str]:
    """Database, worker and renderer are up; 503 names the missing ones."""
    services.store.page(limit=1)
    missing = services.missing()
    if missing:
        raise RefusedError(503, "not-ready", "; ".join(missing))
    return {"status": "ready"}


@router.get(
    "/metrics",
    tags=["health"],
    response_class=Response,
    responses={200: {"description": "Prometheus text.", "content": {"text/plain": {"example": _EXAMPLE}}}},
)
def metrics(services: ServicesDep) -> Response:
    """Metrics for Prometheus: requests of this process, the queue, and the work of its attack workers."""
    registries = services.metrics.registry, _of_queue(services.store), WORK
    return Response(b"".join(map(generate_latest, registries)), media_type=CONTENT_TYPE_LATEST)


def _of_queue(store: JobStore) -> CollectorRegistry:
    registry = CollectorRegistry()
    jobs = Gauge("trompe_jobs", "Jobs by state.", ["state"], registry=registry)
    for state, count in store.counts().items():
        jobs.labels(state.value).set(count)
    age = Gauge("trompe_queue_age_seconds", "Wait of the oldest queued job.", registry=registry)
    age.set(store.oldest_queued())
    return registry
