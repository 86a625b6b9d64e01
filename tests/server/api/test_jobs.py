"""Jobs over HTTP: submit once, find again, cancel, repeat, delete."""

import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from tests.server.api.conftest import CLASSES, GIF, Api
from tests.small_models import triangle_zip
from trompe_server.errors import ServiceError
from trompe_server.queue.leases import DISPATCHER, MARKS, end_lease, mark_store, take_lease
from trompe_server.storage.folders import JobArtifacts, open_folder
from trompe_shared.api import JobState
from trompe_shared.object3d import encode_png


def test_a_job_keeps_the_ids_of_what_it_names_and_shows_what_the_queue_knows_of_it(stocked: Api) -> None:
    member = stocked.upload_classifier(b"W2", "member.pt2").json()["id"]
    white = encode_png(np.full((8, 8, 3), 255, np.uint8))
    picture = stocked.post("/v1/backgrounds", files={"file": ("beach.png", white)}).json()["id"]
    named: dict[str, Any] = {"judges": ["net"], "ensemble": ["member"], "masks": {"paint.png": "beach"}}
    queued: dict[str, Any] = {
        "priority": "sweep",
        "needs": {"cpu": 1.0, "gpu": 0.5, "memory": 4.0},
        "labels": {"team": "a"},
    }
    named |= {"materials": ["paint"], "background": ["beach", "#00ff00"]}
    answer = stocked.submit(label="CUP", **named, **queued)
    job = answer.json()
    assert answer.status_code == 201
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    assert job["state"] == "queued"
    assert {name: job[name] for name in queued} == queued
    spec, net = job["spec"], stocked.get("/v1/classifiers/net").json()["id"]
    assert spec["object"] == stocked.get("/v1/objects/triangle").json()["id"]
    assert spec["victim"]["classifier"] == spec["judges"]["networks"][0] == net
    assert spec["victim"]["ensemble"] == [member]
    assert spec["paint"]["masks"] == {"paint.png": picture}
    assert spec["views"]["background"] == [picture, "#00ff00"]
    assert "priority" not in spec
    assert job["names"] == {spec["object"]: "triangle", net: "net", member: "member", picture: "beach"}
    assert stocked.get(f"/v1/jobs/{job['id']}").json() == job


def test_no_job_is_queued_for_those_who_run_it_with_another_store(stocked: Api, tmp_path: Path) -> None:
    engine, refusal = stocked.services.store.engine, "elsewhere runs the jobs of this database with another store"
    take_lease(engine, DISPATCHER, holder="elsewhere", seconds=60)
    mark_store(open_folder(tmp_path / "another"), "elsewhere")
    refused = stocked.submit()
    assert (refused.status_code, refusal in refused.text) == (409, True)
    assert stocked.get("/v1/jobs").json()["jobs"] == []
    mark_store(stocked.services.files, "elsewhere")
    assert stocked.submit().status_code == 201
    stocked.services.files.within(MARKS).delete("elsewhere")
    end_lease(engine, DISPATCHER, holder="elsewhere")
    assert stocked.submit().status_code == 201, "it is gone"


def test_a_classifier_without_gradients_can_be_attacked_by_its_scores(stocked: Api) -> None:
    stocked.upload_classifier(b"B", "judge.onnx")
    assert stocked.submit(classifier="judge", queries=10).status_code == 201


REFUSED: list[tuple[dict[str, Any], int, str]] = [
    ({"object": "trumpet"}, 404, "no object 'trumpet'"),
    ({"classifier": "resnet"}, 404, "no classifier 'resnet'"),
    ({"classifier": "timm:resnet50"}, 422, "does not allow the network"),
    ({"judges": ["resnet"]}, 404, "no classifier 'resnet'"),
    ({"label": "vaze"}, 422, "'net' has no class 'vaze'; did you mean 'vase'?"),
    ({"background": "sea"}, 404, "no background 'sea'"),
    ({"background": "#12345"}, 404, "no background '#12345'"),
    ({"ensemble": ["resnet"]}, 404, "no classifier 'resnet'"),
    ({"masks": {"paint.png": "sea"}}, 404, "no background 'sea'"),
    ({"masks": {"wood.png": "beach"}}, 422, "no texture ['wood.png'] to mask"),
    ({"materials": ["paint", "wood"]}, 422, "no material ['wood']"),
    ({"target": "vaze"}, 422, "did you mean 'vase'?"),
    ({"target": "mug"}, 422, "is the object's own class"),
    ({"top_k": 3}, 422, "other than the object's, 2; got 3"),
    ({"keep": 0.001}, 422, "leaves none of the 64 texels"),
    ({"queries": 10}, 422, "'net' gives them"),
    ({"classifier": "judge"}, 422, "no gradients (.onnx)"),
    ({"classifier": "judge", "queries": 4, "tau": 0.1}, 422, "need gradients"),
    ({"classifier": "judge", "queries": 4, "keep": 0.1}, 422, "need gradients"),
    ({"masks": {"paint.png": "beach"}}, 422, "is 1 x 1 pixels, the texture 8 x 8"),
    ({"ensemble": ["member"]}, 422, "class 1 is 'vase' for one and 'toilet tissue"),
    ({"ensemble": ["judge"]}, 422, "not by `ensemble`"),
    ({"label": "1", "judges": ["tiny"]}, 422, "is another class for the judge 'tiny'"),
    (
        {"label": "1", "judges": ["member"]},
        422,
        "another class for the judge 'member': 'toilet tissue, toilet paper', not",
    ),
    ({"label": "vase", "judges": ["shifted"]}, 422, "'shifted' has no class names to find 'vase' in; give"),
]


def test_a_job_that_names_what_is_not_there_is_refused_at_once(stocked: Api) -> None:
    for data, file in ((b"B", "judge.onnx"), (b"G", "shifted.onnx")):
        stocked.upload_classifier(data, file)
    stocked.upload_classifier(b"W2", "member.pt2", classes=json.dumps([CLASSES[0], *CLASSES[:0:-1]]))
    stocked.post("/v1/backgrounds", files={"file": ("beach.gif", GIF)})
    for spec, status, words in REFUSED:
        assert words in stocked.problem(stocked.submit(**spec), status, spec)["detail"], spec
    assert stocked.get("/v1/jobs").json()["jobs"] == []


def test_invalid_fields_are_listed_one_by_one(api: Api) -> None:
    refusal = api.problem(api.post("/v1/jobs", json={"object": "mug", "paint": {"epsilon": 2}, "colour": "red"}), 422)
    assert {error["field"] for error in refusal["errors"]} == {"goal", "paint.epsilon", "colour"}
    assert all(error["message"] for error in refusal["errors"])
    contradiction = api.problem(api.submit("mug", epsilon=0.01, alpha=0.5), 422)
    assert "`alpha` (0.5) is a step" in contradiction["detail"]


def test_jobs_are_listed_newest_first_in_pages_and_by_state(stocked: Api) -> None:
    ids = [stocked.submit().json()["id"] for _ in range(5)]
    stocked.post(f"/v1/jobs/{ids[2]}/cancel")
    seen, cursor = [], None
    while cursor != "":
        page = stocked.get("/v1/jobs", params={"limit": 2} | ({"cursor": cursor} if cursor else {})).json()
        assert len(page["jobs"]) <= 2
        seen += [job["id"] for job in page["jobs"]]
        cursor = page["next_cursor"] or ""
    assert seen == ids[::-1]
    cancelled = stocked.get("/v1/jobs", params={"state": "cancelled"}).json()
    assert [job["id"] for job in cancelled["jobs"]] == [ids[2]]


def test_cancelling_a_queued_job_ends_it_and_cancelling_again_changes_nothing(stocked: Api) -> None:
    job = stocked.submit().json()["id"]
    cancelled = stocked.post(f"/v1/jobs/{job}/cancel").json()
    assert cancelled["state"] == "cancelled"
    assert stocked.post(f"/v1/jobs/{job}/cancel").json() == cancelled


def test_the_same_request_with_the_same_key_makes_one_job(stocked: Api) -> None:
    first = stocked.submit(key="sweep 1", seed=1)
    again = stocked.submit(key="sweep 1", seed=1)
    assert (first.status_code, again.status_code) == (201, 200)
    assert again.json() == first.json()
    assert again.headers["location"] == first.headers["location"]
    assert stocked.submit(key="sweep 2", seed=1).json()["id"] != first.json()["id"]
    refusal = stocked.problem(stocked.submit(key="sweep 1", seed=2), 409)
    assert "was used with another request" in refusal["detail"]
    assert len(stocked.get("/v1/jobs").json()["jobs"]) == 2


@pytest.mark.parametrize("key", ["", "x" * 256])
def test_a_key_has_a_sensible_length(stocked: Api, key: str) -> None:
    refusal = stocked.problem(stocked.post("/v1/jobs", json={}, headers={"Idempotency-Key": key}), 422)
    assert "idempotency-key" in {error["field"] for error in refusal["errors"]}


def test_jobs_are_found_by_labels_object_and_classifier(stocked: Api) -> None:
    other = stocked.upload_object(triangle_zip(colour=(0, 0, 255)), "blue.zip").json()["id"]
    red = stocked.job(labels={"team": "a", "run": "1"})
    blue = stocked.job(object="blue", labels={"team": "a", "run": "x:y"})
    tiny = stocked.job(object="mug", classifier="tiny", labels={"team": "b"})

    def ids(**params: Any) -> list[str]:
        return [job["id"] for job in stocked.get("/v1/jobs", params=params).json()["jobs"]]

    assert ids(label="team:a") == [blue, red]
    assert ids(label=["team:a", "run:x:y"]) == [blue]
    assert ids(object=other) == [blue]
    assert ids(classifier="tiny") == [tiny]
    assert ids(object=other, classifier="tiny") == []
    assert ids(label=["team:a", "team:a"]) == [blue, red]
    twice = stocked.problem(stocked.get("/v1/jobs", params={"label": ["team:a", "team:b"]}), 422)
    assert "a job has one value per label" in twice["detail"]
    for wrong in ("team", ":a", "team:"):
        assert "key:value" in stocked.problem(stocked.get("/v1/jobs", params={"label": wrong}), 422)["detail"]


def test_a_job_that_has_ended_is_repeated_as_a_new_one(stocked: Api) -> None:
    old = stocked.job(label="CUP", seed=3, labels={"experiment": "e"}, priority="sweep")
    assert "is queued" in stocked.problem(stocked.post(f"/v1/jobs/{old}/retry"), 409)["detail"]
    stocked.end(old, JobState.failed)
    answer = stocked.post(f"/v1/jobs/{old}/retry", headers={"Idempotency-Key": "again"})
    new, before = answer.json(), stocked.get(f"/v1/jobs/{old}").json()
    assert (answer.status_code, answer.headers["location"]) == (201, f"/v1/jobs/{new['id']}")
    assert (new["state"], before["state"]) == ("queued", "failed")
    for same in ("spec", "names", "labels", "priority", "needs"):
        assert new[same] == before[same]
    assert new["id"] != old
    once_more = stocked.post(f"/v1/jobs/{old}/retry", headers={"Idempotency-Key": "again"})
    assert (once_more.status_code, once_more.json()["id"]) == (200, new["id"])


def test_a_job_that_has_ended_can_be_deleted_with_its_files(stocked: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    job = stocked.job()
    assert "is queued" in stocked.problem(stocked.delete(f"/v1/jobs/{job}"), 409)["detail"]
    stocked.end(job, result__json=b"{}")
    with monkeypatch.context() as away:
        away.setattr(JobArtifacts, "delete", Mock(side_effect=ServiceError("The store is down.")))
        stocked.problem(stocked.delete(f"/v1/jobs/{job}"), 503)
    assert stocked.delete(f"/v1/jobs/{job}").status_code == 204
    stocked.problem(stocked.get(f"/v1/jobs/{job}"), 404)
    stocked.problem(stocked.delete(f"/v1/jobs/{job}"), 404)
    assert stocked.services.artifacts(job).names() == []


def test_an_experiment_is_the_jobs_with_its_label(stocked: Api) -> None:
    assert stocked.get("/v1/experiments").json() == []
    mugs = [stocked.job(labels={"experiment": "mugs"}) for _ in range(3)]
    stocked.job()
    vases = stocked.job(labels={"experiment": "vases/2"})
    stocked.post(f"/v1/jobs/{mugs[0]}/cancel")
    listed = {each["name"]: each for each in stocked.get("/v1/experiments").json()}
    counts = {name: each["jobs"] for name, each in listed.items()}
    assert counts == {"mugs": {"cancelled": 1, "queued": 2}, "vases/2": {"queued": 1}}
    assert listed["mugs"]["created"] == stocked.get(f"/v1/jobs/{mugs[0]}").json()["created"]
    page = stocked.get("/v1/experiments/mugs", params={"limit": 2}).json()
    rest = stocked.get("/v1/experiments/mugs", params={"cursor": page["next_cursor"]}).json()
    assert [job["id"] for job in page["jobs"] + rest["jobs"]] == mugs[::-1]
    assert [job["id"] for job in stocked.get("/v1/experiments/vases%2F2").json()["jobs"]] == [vases]
    assert "no experiment 'cups'" in stocked.problem(stocked.get("/v1/experiments/cups"), 404)["detail"]


def test_workers_and_renderers_are_listed(api: Api) -> None:
    assert api.get("/v1/workers").json() == []
    assert api.get("/v1/renderers").json() == [
        {"address": "127.0.0.1:8085", "alive": True, "engine": None, "version": None, "settings": None}
    ]
