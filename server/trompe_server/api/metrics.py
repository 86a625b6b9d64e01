"""Metrics: requests of this process, the queue, and counters of the workers."""

from pathlib import Path
from typing import Final

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.multiprocess import MultiProcessCollector
from prometheus_client.process_collector import ProcessCollector
from starlette.types import Scope

from trompe_server.api.problems import PROBLEMS
from trompe_server.api.services import ServicesDep
from trompe_server.queue.store import JobStore

router = APIRouter(tags=["health"], responses=PROBLEMS)

METHODS: Final = frozenset({"DELETE", "GET", "HEAD", "POST"})
BUCKETS: Final = (0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.15, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 60.0)
_EXAMPLE: Final = '# TYPE trompe_jobs gauge\ntrompe_jobs{state="running"} 2.0\n'


class HttpMetrics:
    """Counts requests by route and status. One per application, since a process may have several."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        self._requests = Counter(
            "trompe_http_requests", "Requests answered.", ["method", "route", "status"], registry=self.registry
        )
        self._seconds = Histogram(
            "trompe_http_request_seconds",
            "Seconds until the response began.",
            ["method", "route"],
            buckets=BUCKETS,
            registry=self.registry,
        )

    def count(self, scope: Scope, status: int, seconds: float) -> None:
        """Count one request by the pattern of its route, not by its path, so that labels stay few."""
        route = getattr(scope.get("route"), "path", "none")
        method = scope["method"] if scope["method"] in METHODS else "other"
        self._requests.labels(method, route, status).inc()
        self._seconds.labels(method, route).observe(seconds)


def _of_queue(store: JobStore) -> CollectorRegistry:
    registry = CollectorRegistry()
    jobs = Gauge("trompe_jobs", "Jobs by state.", ["state"], registry=registry)
    for state, count in store.counts().items():
        jobs.labels(state.value).set(count)
    age = Gauge("trompe_queue_age_seconds", "Wait of the oldest queued job.", registry=registry)
    age.set(store.oldest_queued())
    return registry


def _of_workers(folder: Path) -> CollectorRegistry:
    """Counters that the workers of this machine write to ``folder`` in Prometheus' multi-process mode."""
    registry = CollectorRegistry()
    if folder.is_dir():
        MultiProcessCollector(registry, path=str(folder))  # type: ignore[no-untyped-call]
    return registry


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"description": "Prometheus text.", "content": {"text/plain": {"example": _EXAMPLE}}}},
)
def metrics(services: ServicesDep, request: Request) -> Response:
    """Metrics for Prometheus: requests of this process, the queue, and the counters of this machine's workers."""
    http: HttpMetrics = request.app.state.metrics
    registries = (http.registry, _of_queue(services.store), _of_workers(services.settings.metrics_folder))
    return Response(b"".join(map(generate_latest, registries)), media_type=CONTENT_TYPE_LATEST)
