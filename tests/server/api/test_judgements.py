"""Judgements over REST: what is accepted, what is refused, and what an ended one gives."""

from typing import Any

from tests.server.api.conftest import Api
from trompe_shared.shipped import shipped_objects

SPEC = {"before": "mug", "after": "mug", "label": "mug"}


def submitted(api: Api, **spec: Any) -> dict[str, Any]:
    answer = api.post("/v1/judgements", json=SPEC | spec)
    assert answer.status_code == 201, answer.text
    job: dict[str, Any] = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    return job


def test_a_judgement_names_ids_and_is_a_job_among_others(stocked: Api) -> None:
    triangle = stocked.get("/v1/objects/triangle").json()["id"]
    job = submitted(stocked, after="triangle", networks=["net"], label=0, priority="sweep", labels={"a": "b"})
    network = stocked.get("/v1/classifiers/net").json()["id"]
    assert (job["spec"]["after"], job["spec"]["networks"], job["spec"]["label"]) == (triangle, [network], [0])
    assert job["names"] == {triangle: "triangle", network: "net"}
    assert (job["priority"], job["labels"]) == ("sweep", {"a": "b"})
    assert stocked.get("/v1/jobs?label=a:b").json()["jobs"] == [job]
    assert stocked.get(f"/v1/judgements/{job['id']}").json() == job
    stocked.post(f"/v1/jobs/{job['id']}/cancel")
    again = stocked.post(f"/v1/jobs/{job['id']}/retry")
    assert (again.status_code, again.json()["spec"]) == (201, job["spec"])


def test_the_result_of_a_job_is_judged_though_the_job_is_deleted(stocked: Api) -> None:
    attack = stocked.job()
    stocked.problem(stocked.post("/v1/judgements", json=SPEC | {"after": f"job:{attack}"}), 409)
    painted: dict[str, Any] = {"triangle-adversarial__zip": shipped_objects()["mug"].read()}
    stocked.end(attack, **painted)
    job = submitted(stocked, after=f"job:{attack}")
    assert stocked.delete(f"/v1/jobs/{attack}").status_code == 204
    assert stocked.get(f"/v1/objects/{job['spec']['after']}").json()["name"] == "triangle-adversarial"


def test_manifest_and_page_of_an_ended_judgement(api: Api) -> None:
    job = submitted(api)["id"]
    for what in ("manifest", "page"):
        assert "is queued" in api.problem(api.get(f"/v1/judgements/{job}/{what}"), 409)["detail"]
    api.end(job, judgement__json=b"{}", judgement__html=b"<p>page</p>")
    assert api.get(f"/v1/judgements/{job}/manifest").content == b"{}"
    page = api.get(f"/v1/judgements/{job}/page")
    assert (page.content, page.headers["content-type"]) == (b"<p>page</p>", "text/html; charset=utf-8")
    assert "sandbox" in page.headers["content-security-policy"]


def test_an_attack_is_no_judgement(stocked: Api) -> None:
    attack = stocked.job()
    for path in (attack, f"{attack}/manifest", f"{attack}/page"):
        assert "is an attack" in stocked.problem(stocked.get(f"/v1/judgements/{path}"), 404)["detail"]


WRONG: list[tuple[dict[str, Any], int, str]] = [
    ({"after": "nothing"}, 404, "nothing"),
    ({"after": "job:nothing"}, 404, "nothing"),
    ({"networks": ["nothing"]}, 404, "nothing"),
    ({"suite": "standard-0"}, 422, "There is no suite 'standard-0'; choose standard-1."),
    ({"steps": 5}, 422, "steps"),
]


def test_a_wrong_judgement_is_refused_in_words(api: Api) -> None:
    for spec, status, words in WRONG:
        problem = api.problem(api.post("/v1/judgements", json=SPEC | spec), status, spec)
        assert words in str(problem), spec
