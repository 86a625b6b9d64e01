"""The list of jobs, without a browser: it shows a page at a time, however many there are."""

import asyncio
import re
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from fastapi import FastAPI

from tests.pages.conftest import app_on
from trompe_server.pages.serving import _code
from trompe_shared.api import JobRequest

JOBS = 120
TAUS = [None, 0.05, 0.2]
"""Of the first jobs, which are an experiment."""
MUG = 5
"""The mug's class in the shipped classifier."""


class Browserless:
    """Asks the application itself, with no browser and no socket between."""

    def __init__(self, app: FastAPI) -> None:
        self._app = app

    def get(self, path: str, **options: Any) -> httpx.Response:
        return asyncio.run(self._get(path, options))

    async def _get(self, path: str, options: dict[str, Any]) -> httpx.Response:
        transport = httpx.ASGITransport(self._app)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return await client.get(path, **options)


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browserless]:
    with app_on(tmp_path_factory.mktemp("list")) as (app, store):
        for seed in range(JOBS):
            labels = {"sweep": "even" if seed % 2 == 0 else "odd"} | ({"experiment": "few"} if seed < len(TAUS) else {})
            tau = TAUS[seed] if seed < len(TAUS) else None
            store.create(JobRequest.of("mug", label=MUG if seed % 2 == 0 else "mug", tau=tau, seed=seed, labels=labels))
        yield Browserless(app)


def jobs_on(page: str) -> list[str]:
    return re.findall(r'<tr id="job-([0-9a-f]+)"', page)


def test_pages_follow_each_other_until_all_jobs_were_shown(client: Browserless) -> None:
    path, seen = "/jobs", []
    while path:
        page = client.get(path).text
        found = jobs_on(page)
        assert 0 < len(found) <= 50
        seen += found
        older = re.search(r'<a href="([^"]+)">Older</a>', page)
        path = older[1].replace("&amp;", "&") if older else ""
    assert len(seen) == len(set(seen)) == JOBS


def test_filters_go_along_to_the_next_page(client: Browserless) -> None:
    page = client.get("/jobs", params={"label": "sweep:odd"}).text
    (older,) = re.findall(r'<a href="([^"]+)">Older</a>', page)
    rest = client.get(older.replace("&amp;", "&")).text
    assert len(jobs_on(page)) + len(jobs_on(rest)) == JOBS / 2


def test_a_class_that_was_asked_for_by_its_number_has_its_name(client: Browserless) -> None:
    assert set(re.findall(r'<span class="quiet"> as ([^<]+)<', client.get("/jobs").text)) == {"mug"}


def test_an_experiment_shows_of_jobs_that_wait_the_options_in_which_they_differ(client: Browserless) -> None:
    page = client.get("/experiments/few").text
    columns = re.findall(r'<th scope="col"[^>]*>([^<]+)', page)
    assert columns == ["Job", "epsilon", "tau", "seed", "A_drop", "held-out A_drop", "seconds", "State"]
    cells = re.findall(r'<td class="number">([^<]*)', page)
    lines = [cells[start : start + len(columns) - 2] for start in range(0, len(cells), len(columns) - 2)]
    assert [line[:3] for line in lines] == [["0.05", "0.2", "2"], ["0.05", "0.05", "1"], ["0.05", "–", "0"]]


@pytest.mark.parametrize("wrong", ["?state=gone", "?label=nocolon", "?cursor=x", "/0123456789abcdef"])
def test_a_filter_that_makes_no_sense_and_a_job_that_is_not_there_are_told_on_a_page(
    client: Browserless, wrong: str
) -> None:
    answer = client.get(f"/jobs{wrong}", headers={"Accept": "text/html"})
    assert answer.status_code in ({404} if wrong.startswith("/") else {400, 422})
    assert answer.headers["content-type"].startswith("text/html")
    assert ("<h1>Not Found" if wrong.startswith("/") else "<h1>") in answer.text


def test_names_of_options_are_shown_as_code() -> None:
    assert _code("<b>: leave out `grid`") == "&lt;b&gt;: leave out <code>grid</code>"


def test_names_from_users_are_shown_as_text(client: Browserless) -> None:
    page = client.get("/jobs", params={"label": "a:<script>alert(1)</script>"}).text
    assert "<script>alert" not in page
