"""What Prometheus asks for: the requests of this process, and the jobs and workers of the whole service."""

from collections.abc import Callable, Iterator
from typing import Final

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector
from starlette.types import Scope

from trompe_server.api.problems import PROBLEMS
from trompe_server.api.services import ServicesDep
from trompe_server.jobs.store import Statistics

__all__ = ["HttpMetrics", "router"]

router = APIRouter(tags=["health"], responses=PROBLEMS)

METHODS: Final = frozenset({"DELETE", "GET", "HEAD", "POST"})
BUCKETS: Final = (0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.15, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 60.0)
_EXAMPLE: Final = '# TYPE trompe_jobs gauge\ntrompe_jobs{state="running"} 2.0\n'


class HttpMetrics:
    """Counts requests by route and status. One for each application, so that several can live in a process."""

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
        """Count one request, by the pattern of its route: paths themselves would be without number."""
        route = getattr(scope.get("route"), "path", "none")
        method = scope["method"] if scope["method"] in METHODS else "other"
        self._requests.labels(method, route, status).inc()
        self._seconds.labels(method, route).observe(seconds)


class _ServiceCollector(Collector):
    """Turns the figures of the service, asked for once, into metrics."""

    def __init__(self, statistics: Callable[[], Statistics]) -> None:
        self._statistics = statistics

    def describe(self) -> list[Metric]:
        """Nothing ahead of time: the database is asked at a scrape, not when the collector is registered."""
        return []

    def collect(self) -> Iterator[Metric]:
        """The metrics of this moment."""
        figures = self._statistics()
        jobs = GaugeMetricFamily("trompe_jobs", "Jobs by state.", labels=["state"])
        for state, count in figures.jobs.items():
            jobs.add_metric([state.value], count)
        yield jobs
        yield GaugeMetricFamily(
            "trompe_queue_age_seconds", "Seconds that the oldest queued job waits.", figures.oldest_queued
        )
        for name, words in _TOTALS.items():
            yield CounterMetricFamily(f"trompe_{name}", words, getattr(figures, name))


_TOTALS: Final = {
    "attack_steps": "Steps of attacks.",
    "step_seconds": "Seconds that steps of attacks took.",
    "classifier_images": "Images shown to classifiers.",
    "classifier_seconds": "Seconds that classifiers took.",
    "target_renders": "Images rendered by the target.",
    "target_seconds": "Seconds that the target took.",
}


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"description": "Prometheus text.", "content": {"text/plain": {"example": _EXAMPLE}}}},
)
def metrics(services: ServicesDep, request: Request) -> Response:
    """Figures for Prometheus: requests of this process; jobs, steps, classifiers and renders of all workers."""
    service = CollectorRegistry()
    service.register(_ServiceCollector(services.store.statistics))
    http: HttpMetrics = request.app.state.metrics
    return Response(generate_latest(http.registry) + generate_latest(service), media_type=CONTENT_TYPE_LATEST)
