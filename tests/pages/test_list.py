"""The list of jobs, without a browser: it shows a page at a time, however many there are."""

import asyncio
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.server.api.conftest import Api, running
from trompe_server.api.examples import JOB, RESULT
from trompe_server.api.services import Services
from trompe_server.library.shipped import list_shipped_classifiers
from trompe_server.pages import routes
from trompe_server.pages.orbit import orbit
from trompe_server.pages.present import JobRow, _accuracies
from trompe_server.pages.routes import follow_list
from trompe_server.pages.serving import _code
from trompe_server.settings import Settings
from trompe_shared.api import Job, JobRequest, JudgementRequest, Result

JOBS = 120
TAUS = [None, 0.05, 0.2]
"""Of the first jobs, which are an experiment."""
MUG = 5
"""The mug's class in the shipped classifier."""


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    with running(Settings(data=tmp_path_factory.mktemp("list"))) as api:
        for seed in range(JOBS):
            labels = {"sweep": "even" if seed % 2 == 0 else "odd"} | ({"experiment": "few"} if seed < len(TAUS) else {})
            tau = TAUS[seed] if seed < len(TAUS) else None
            chosen = JobRequest.of("mug", label=MUG if seed % 2 == 0 else "mug", tau=tau, seed=seed, labels=labels)
            api.services.store.create(chosen)
        yield api


def jobs_on(page: str) -> list[str]:
    return re.findall(r'<tr id="job-([0-9a-f]+)"', page)


def test_pages_follow_each_other_until_all_jobs_were_shown(client: Api) -> None:
    path, seen = "/jobs", []
    while path:
        page = client.get(path).text
        found = jobs_on(page)
        assert 0 < len(found) <= 50
        seen += found
        older = re.search(r'href="([^"]+)">Older</a>', page)
        path = older[1].replace("&amp;", "&") if older else ""
    assert len(seen) == len(set(seen)) == JOBS


def test_filters_go_along_to_the_next_page(client: Api) -> None:
    page = client.get("/jobs", params={"label": "sweep:odd"}).text
    (older,) = re.findall(r'href="([^"]+)">Older</a>', page)
    rest = client.get(older.replace("&amp;", "&")).text
    assert len(jobs_on(page)) + len(jobs_on(rest)) == JOBS / 2


def test_a_class_that_was_asked_for_by_its_number_has_its_name(client: Api) -> None:
    assert set(re.findall(r'<span class="quiet"> as ([^<]+)<', client.get("/jobs").text)) == {"mug"}


def test_an_experiment_shows_of_jobs_that_wait_the_options_in_which_they_differ(client: Api) -> None:
    page = client.get("/experiments/few").text
    columns = re.findall(r'<th scope="col"[^>]*>([^<]+)', page)
    assert columns == ["Job", "epsilon", "tau", "seed", "A_drop", "held-out A_drop", "seconds", "State"]
    cells = re.findall(r'<td class="number">([^<]*)', page)
    lines = [cells[start : start + len(columns) - 2] for start in range(0, len(cells), len(columns) - 2)]
    assert [line[:3] for line in lines] == [["0.05", "0.2", "2"], ["0.05", "0.05", "1"], ["0.05", "–", "0"]]


def test_one_of_several_pages_of_an_experiment_says_that_its_figures_are_of_its_own_jobs(
    client: Api, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = "Counts, chart and means are of the jobs on this page only"
    assert told not in client.get("/experiments/few").text
    monkeypatch.setattr(routes, "EXPERIMENT_PAGE", 2)
    page = client.get("/experiments/few").text
    assert f"{told} (2)" in page
    (older,) = re.findall(r'href="([^"]+)">Older</a>', page)
    assert f"{told} (1)" in client.get(f"/experiments/few{older}").text


def test_a_network_that_is_not_allowed_keeps_its_reference_in_commands_and_forms(tmp_path: Path) -> None:
    request = JobRequest.of("mug", label=["table", MUG], classifier="timm:x")
    result = RESULT | {"spec": request.spec().model_dump(mode="json")}
    with running(Settings(data=tmp_path)) as client:
        job = client.services.store.create(request, names={"timm:x": "x"})[0].id
        client.end(job, result__json=json.dumps(result).encode())
        assert "<td>x</td>" in (listed := client.get("/jobs").text)
        assert "as table or class 5" in listed
        assert "--classifier timm:x" in client.get(f"/jobs/{job}").text
        form = client.get("/judgements/new", params={"job": job}).text
    assert '<option value="timm:x" selected>timm:x<' in form
    assert re.findall(r'name="label" value="([^"]*)"', form) == ["table", "5"]


def test_the_job_s_own_network_is_asked_by_indices_and_others_by_names() -> None:
    result = Result.model_validate(RESULT | {"spec": RESULT["spec"] | {"victim": {"classifier": "timm:x"}}})
    given = orbit(result, "1", list_shipped_classifiers())
    assert given is not None
    assert [(one["reference"], one["labels"]) for one in given["classifiers"]] == [("timm:x", [2]), ("tiny", ["mug"])]


@pytest.mark.parametrize(
    ("phase", "words"),
    [("attack-003", "attacking"), ("queued", "opening"), ("showing to resnet-50", "showing to resnet-50")],
)
def test_a_phase_is_told_in_words(phase: str, words: str) -> None:
    job = Job.model_validate(JOB | {"progress": {"phase": phase, "fraction": 0.5}})
    assert JobRow.of(job, epsilon=None, object="mug", label="mug", classifier="tiny").phase == words


@pytest.mark.parametrize(
    ("path", "status", "words"),
    [
        ("?state=gone", 422, "state"),
        ("?state=nxax", 422, "state"),
        ("?label=nocolon", 422, "nocolon"),
        ("?cursor=x", 422, "cursor"),
        ("/0123456789abcdef", 404, "<h1>Not Found"),
        *(("/turntable/mug.png?distance=" + given, 422, "distance: Input should be") for given in ("0", "nan", "2000")),
        ("/turntable/mug.png", 503, "No renderer worker is up; start one"),
        ("/turntable/mug.png?renderer=a+b", 503, "No renderer worker with the engine &#39;a b&#39; is up; start one"),
    ],
)
def test_a_fault_is_told_on_a_page_with_its_own_headers(client: Api, path: str, status: int, words: str) -> None:
    answer = client.get(f"/jobs{path}", headers={"Accept": "text/html"})
    assert answer.status_code == status
    assert words in answer.text
    assert answer.headers["content-type"].startswith("text/html")
    assert int(answer.headers["content-length"]) == len(answer.content)
    assert "script-src 'self'" in answer.headers["content-security-policy"]
    assert {"x-request-id", "x-content-type-options", "cache-control"} <= answer.headers.keys()
    assert answer.headers.get("retry-after") == ("5" if status == 503 else None)


def test_a_judgement_alone_is_an_experiment_without_attacks_and_has_no_models(tmp_path: Path) -> None:
    with running(Settings(data=tmp_path)) as client:
        request = JudgementRequest.of("mug", "mug", label="mug", labels={"experiment": "only"})
        job, _ = client.services.store.create(request)
        experiment = client.get("/experiments/only")
        assert experiment.status_code == 200
        assert 'No attacks here yet. <a href="/jobs?label=experiment%3Aonly">' in experiment.text
        for side in ("before", "after"):
            answer = client.get(f"/jobs/{job.id}/models/{side}.glb")
            assert (answer.status_code, "is a judgement" in answer.text) == (404, True)


def test_the_live_list_tells_which_jobs_have_left_it_and_where_it_goes_on(tmp_path: Path) -> None:
    async def told(services: Services) -> list[Any]:
        stream: Any = follow_list(services, state="queued", label="a:b", limit=2).body_iterator
        events = [json.loads((await anext(stream)).data)]
        services.store.request_cancel(made[2])
        return [*events, json.loads((await anext(stream)).data)]

    with running(Settings(data=tmp_path)) as api:
        create = api.services.store.create
        made = [create(JobRequest.of("mug", label="mug", seed=k, labels={"a": "b"}))[0].id for k in range(3)]
        first, second = asyncio.run(told(api.services))
    assert [first["ids"], second["ids"]] == [[made[2], made[1]], [made[1], made[0]]]
    assert [jobs_on(each["html"]) for each in (first, second)] == [first["ids"], made[:1]]
    assert [each["older"] for each in (first, second)] == ["/jobs?state=queued&label=a%3Ab&cursor=2", None]


def test_a_result_shows_all_its_accuracies() -> None:
    judge = {"classifier": "net", "target": RESULT["target"], "held_out": RESULT["target"]}
    names = [row["name"] for row in _accuracies(Result.model_validate(RESULT | {"judges": [judge]}))]
    assert {"target (own views)", "judge net (own views)", "judge net (held-out views)"} <= set(names)


@pytest.mark.parametrize(
    ("goal", "told"),
    [({"target": "ball"}, "33.0% of the target views: taken for ball"), ({"top_k": 3}, "among the 3 best"), ({}, None)],
)
def test_a_result_says_how_often_its_goal_was_reached(tmp_path: Path, goal: dict[str, Any], told: str | None) -> None:
    request = JobRequest.of("mug", label="mug", **goal)
    result = RESULT | {"spec": request.spec().model_dump(mode="json"), "goal_reached": 0.33}
    with running(Settings(data=tmp_path)) as client:
        job = client.services.store.create(request)[0].id
        client.end(job, result__json=json.dumps(result).encode())
        page = client.get(f"/jobs/{job}").text
    assert ("Goal reached on" in page) == (told is not None)
    assert (told or "") in page


def test_names_of_options_are_shown_as_code(tmp_path: Path) -> None:
    assert _code("<b>: leave out `grid`") == "&lt;b&gt;: leave out <code>grid</code>"
    with running(Settings(data=tmp_path)) as client:
        job = client.services.store.create(JobRequest.of("mug", label="mug"))[0].id
        client.tell(job, "ended", state="failed", artifacts=[], error="None answers to `renderers: a`. There is b.")
        for path in ("/jobs", f"/jobs/{job}"):
            assert "to <code>renderers: a</code>" in (page := client.get(path).text)
            assert "`" not in page


def test_names_from_users_are_shown_as_text(client: Api) -> None:
    page = client.get("/jobs", params={"label": "a:<script>alert(1)</script>"}).text
    assert "<script>alert" not in page
