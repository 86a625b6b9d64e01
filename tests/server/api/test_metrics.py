"""Metrics for Prometheus."""

from collections.abc import Iterable

from prometheus_client.parser import text_string_to_metric_families

from tests.server.api.conftest import Api
from trompe_server.storage.tokens import Right
from trompe_shared.api import JobState


def scrape(api: Api) -> dict[tuple[str, ...], float]:
    """Samples by name and labels."""
    answer = api.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=")
    families = text_string_to_metric_families(answer.text)
    return {(s.name, *sorted(s.labels.values())): s.value for family in families for s in family.samples}


def test_jobs_are_counted_by_state_and_the_age_of_the_queue_is_told(stocked: Api) -> None:
    jobs = [stocked.job() for _ in range(3)]
    stocked.end(jobs[0], JobState.failed)
    samples = scrape(stocked)
    assert samples["trompe_jobs", "queued"] == 2
    assert samples["trompe_jobs", "failed"] == 1
    assert ("trompe_attack_steps_total",) in samples, "told before a worker has counted any"
    assert {key[1] for key in samples if key[0] == "trompe_jobs"} == {state.value for state in JobState}
    assert 0 < samples["trompe_queue_age_seconds",] < 60


def test_requests_are_counted_by_route_and_status_and_timed(stocked: Api) -> None:
    job = stocked.job()
    for path in (f"/v1/jobs/{job}", "/v1/jobs/a", "/v1/jobs/b", "/nothing", "/nowhere", "/v1/jobs?limit=0"):
        stocked.get(path)
    samples = scrape(stocked)
    counted = {key[1:]: value for key, value in samples.items() if key[0] == "trompe_http_requests_total"}
    assert counted["/v1/jobs/{job}", "200", "GET"] == 1
    assert counted["/v1/jobs/{job}", "404", "GET"] == 2
    assert counted["404", "GET", "none"] == 2
    assert counted["/v1/jobs", "422", "GET"] == 1
    assert samples["trompe_http_request_seconds_count", "/v1/jobs/{job}", "GET"] == 3


def test_a_request_that_is_turned_away_is_counted_too(api: Api) -> None:
    api.token("ci", Right.read)
    api.get("/v1/jobs")
    header = api.token("prometheus", Right.read)
    api.problem(api.get("/metrics"), 401)
    text = api.get("/metrics", headers=header).text
    assert 'trompe_http_requests_total{method="GET",route="none",status="401"} 2.0' in text


def test_made_up_methods_and_paths_make_no_new_series(api: Api) -> None:
    def make_up(numbers: Iterable[int]) -> int:
        for number in numbers:
            api.request("GET", f"/nothing/{number}")
            api.request(f"BREW{number}", "/v1/jobs")
            api.request("GET", f"/v1/jobs/{number}")
        return len(scrape(api))

    make_up([0])
    assert make_up([1]) == make_up(range(2, 9))
